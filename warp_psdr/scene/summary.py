"""A scene in one line, and as tables for notebooks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from warp_psdr import html

if TYPE_CHECKING:
    from warp_psdr.scene.description import BsdfDescription
    from warp_psdr.scene.scene import Scene

#: Of a table.
MOST_ROWS = 20


def summary(scene: Scene) -> str:
    """Return what a scene holds, and where: shapes, triangles, lights, films, device."""
    description = scene.description
    films = dict.fromkeys(f"{s.film.crop_width} x {s.film.crop_height}" for s in description.sensors)
    parts = [
        _counted(len(description.shapes), "shape"),
        _counted(scene.face_count, "triangle"),
        _counted(len(description.emitters), "light"),
        f"{_counted(len(description.sensors), 'sensor')} of {' and '.join(films)} pixels",
        f"on {scene.device}",
    ]
    return f"<psdr.Scene {Path(description.source).name!r}: {', '.join(parts)}>"


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def tables(scene: Scene) -> str:
    """Return what a notebook shows of a scene: its shapes, lights and sensors."""
    description = scene.description
    shapes = [(s.path, s.kind, str(len(s.faces)), _model(s.bsdf)) for s in description.shapes]
    lights = [(light.path, light.kind) for light in description.emitters]
    sensors = [
        (s.path, s.kind, f"{s.film.crop_width} x {s.film.crop_height}", str(s.sample_count))
        for s in description.sensors
    ]
    parts = [html.preformatted(summary(scene))]
    for header, rows in (
        (("shape", "kind", "triangles", "bsdf"), shapes),
        (("light", "kind"), lights),
        (("sensor", "kind", "pixels", "samples a pixel"), sensors),
    ):
        if rows:
            more = [(f"and {len(rows) - MOST_ROWS} more", *[""] * (len(header) - 1))] if len(rows) > MOST_ROWS else []
            parts.append(html.table(header, [*rows[:MOST_ROWS], *more]))
    return "".join(parts)


def _model(bsdf: BsdfDescription) -> str:
    name = " of ".join((bsdf.model, *([" and ".join(bsdf.children)] if bsdf.children else [])))
    return f"{name}, two-sided" if bsdf.two_sided else name

"""A scene in one line."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


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

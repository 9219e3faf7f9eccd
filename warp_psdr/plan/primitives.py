"""Shapes without triangles in the plan: the kinds that a scene holds, their lines, and what is not supported yet."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

from warp_psdr.kernels.bsdf.dispatch import has_chain_lobes, has_delta_lobes
from warp_psdr.kernels.primitive.curve_kinds import CURVES
from warp_psdr.kernels.primitive.dispatch import has_sliding
from warp_psdr.kernels.primitive.kind import FLOWS
from warp_psdr.options.boundary import Reparametrised
from warp_psdr.options.words import Word
from warp_psdr.plan.motion import motion
from warp_psdr.scene.kinds import table
from warp_psdr.scene.kinds.kind import geometry_of
from warp_psdr.scene.kinds.neuralsdf import network_and_cells
from warp_psdr.scene.materials.bsdfs import model_of
from warp_psdr.topology.crossing_curves import touched
from warp_psdr.topology.crossing_pairs import crossed_light, touching_pair
from warp_psdr.topology.grid_contacts import in_box, is_open, passed_by, pierced_grid
from warp_psdr.topology.kinds.exact_shapes import reaching
from warp_psdr.topology.kinds.grid_silhouettes import grid_shapes, grid_values, is_smooth_grid
from warp_psdr.topology.kinds.joined_rims import joined_rims
from warp_psdr.topology.kinds.network_silhouettes import is_open_network, network_shapes
from warp_psdr.topology.kinds.tube_overlaps import tube_overlaps
from warp_psdr.topology.tube_contacts import pierced_tubes
from warp_psdr.topology.tube_crossings import resting_end
from warp_psdr.topology.unchanged import kept

if TYPE_CHECKING:
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.scene.scene import Scene


def kinds(scene: Scene) -> tuple[int, ...]:
    """Return the numbers of the kinds of a scene, for the path loop."""
    return tuple(sorted({scene.geometry(i).device.number for i in scene.builder.primitives}))


def shining(scene: Scene) -> tuple[int, ...]:
    """Return those kinds of a scene that shine."""
    shapes = [scene.description.shapes[i] for i in scene.builder.primitives]
    return tuple(sorted({geometry_of(s).device.number for s in shapes if s.emitter is not None}))


def describe(scene: Scene) -> list[tuple[str, str, str]]:
    """Return the plan's lines."""
    return table.describe(scene.description.shapes)


def words_of(scene: Scene) -> dict[str, Word]:
    """Return the words of the kinds of shapes without triangles that a scene holds, each with a shape of its own."""
    found: dict[str, Word] = {}
    shapes = [scene.description.shapes[i] for i in scene.builder.primitives]
    for s in sorted(shapes, key=lambda s: s.emitter is None):  # what shines first
        geometry = geometry_of(s)
        word = "material_points" if geometry.is_material else "slides"
        found.setdefault(word, Word(f"{s.path!r}, {geometry.title}", geometry.instead))
    return found


def _told(scene: Scene, pair: tuple[int, int] | None, sentence: str) -> str:
    """Return a sentence about two shapes, {a} and {b}; empty: there are none."""
    a, b = (scene.description.shapes[i].path for i in pair) if pair is not None else ("", "")
    return sentence.format(a=repr(a), b=repr(b)) if pair is not None else ""


def _of_exact(scene: Scene, config: PathConfig, integrator: PathIntegrator, names: list[str]) -> str:
    """Say what exact shapes run through, or touch, along a curve without a term; empty: nothing."""
    moves = motion(scene, names)
    moved, joined = None if moves.camera else moves.shapes, joined_rims(scene)
    bared, rims = (next(iter(pairs), None) for pairs in (joined.bared, joined.pairs))
    rims = rims if has_chain_lobes(config.surfaces.bsdfs, config.media is not None) else None
    hidden = integrator.hide_emitters
    return (
        _told(scene, bared, "{a} lies in the surface of {b}, which closes the cylinder by itself; leave it out")
        or _told(
            scene,
            reaching(scene, moved),
            "{b} reaches into the box around {a}, whose curves of intersection are not known; move them apart",
        )
        or _told(
            scene,
            touching_pair(scene, moved) or touched(scene, moved),
            "{b} touches {a} along a line that moves; lift one off the other, or let one reach into the other",
        )
        or _told(
            scene,
            rims,
            "{a} and {b} join at a rim, which is not followed through smooth mirrors and glass; make them rough",
        )
        or _told(
            scene,
            crossed_light(scene) if hidden else None,
            "{b}, a light that hide_emitters hides, runs through the surface of {a}; move them apart",
        )
    )


def _of_mirrors(scene: Scene) -> str:
    """Say which shape is not followed as, or through, smooth mirrors and glass; empty: all are."""
    for s in (scene.description.shapes[i] for i in scene.builder.primitives):
        knows = geometry_of(s).knows
        for model in (model_of(b) for b in s.bsdf.sides if model_of(b).has_delta):
            mixed = model.has_smooth or model.has_null
            if ("mixed" if mixed else "glass" if model.transmits else "mirror") not in knows:
                what = f"what moves is not followed through the {model.plugin!r} of {s.path!r}"
                fit = "'conductor' or a 'dielectric'" if "glass" in knows else "'conductor'"
                return f"{what}; give it a {fit}, or make it rough"
        if "mirrors" not in knows:
            turned = f"the 'smooth' normals of {s.path!r} turn away from the viewer beside its silhouettes"
            curves = "curves that are not followed through smooth mirrors and glass"
            return f"{turned}, along {curves}; say 'normals': 'analytic'"
    return ""


def refused(scene: Scene, config: PathConfig, integrator: PathIntegrator, names: list[str], sensor: int) -> str:
    """Say what shapes without triangles keep the boundary term from being estimated; empty: nothing."""
    moves_rays = isinstance(integrator.boundary, Reparametrised)
    resting = has_sliding(config.surfaces.primitives)
    if not config.surfaces.primitives or (resting and moves_rays):  # ``rows/reparametrised.py`` says what these do
        return ""
    reason = _of_mirrors(scene) if has_delta_lobes(config.surfaces.bsdfs) and not moves_rays else ""
    if reason or not resting:
        return reason or _of_exact(scene, config, integrator, names)
    shapes = scene.description.shapes
    for i in grid_shapes(scene):
        if is_open(grid_values(scene, i), is_smooth_grid(scene, i)):
            opened = f"the surface of {shapes[i].path!r} ends at its box, along a curve that moves"
            return f"{opened}; give positive values all around"
    reason = _of_exact(scene, config, integrator, names)
    if reason:
        return reason
    for i in network_shapes(scene):
        if kept(scene, ("open network", i), functools.partial(_is_open, scene, i)):
            opened = f"the surface of {shapes[i].path!r} may end at its box, along a curve that moves"
            return f"{opened}; keep phi positive all around"
        if set(config.surfaces.primitives) & set(CURVES):
            return f"beside {shapes[i].path!r} curves have no boundary term; leave them out"
    moves = motion(scene, names)
    moved = None if moves.camera else moves.shapes
    for find, surface in ((pierced_grid, "surface"), (pierced_tubes, "tubes")):
        pair = kept(scene, (surface, moved), functools.partial(find, scene, moved))
        if pair is not None:
            through = f"{{b}} runs through the {surface} of {{a}}"
            return _told(scene, pair, f"{through}, along a curve that moves; move them apart")
    over = tube_overlaps(scene, sensor) if moves.camera or moves.shapes else None
    if over is not None and over.problem():
        return over.problem()
    pair = kept(scene, ("resting end", moved), lambda: resting_end(scene, moved))
    return _told(scene, pair, "an open end of {a} lies on {b}, along a line that moves; sink it in or lift it off")


def _is_open(scene: Scene, shape: int) -> bool:
    """Whether the surface of a network may end at its box."""
    return is_open_network(*network_and_cells(scene, shape))


def refuse_flow(scene: Scene, config: PathConfig) -> None:
    """Raise where vertices cannot flow along normals.

    Raises:
        ValueError: with the shape, and what to do.
    """
    instead = "say interior.Replay(flow='ray')"
    if has_delta_lobes(config.surfaces.bsdfs):
        raise ValueError(f"vertices that flow along normals have no terms beside smooth mirrors and glass; {instead}")
    for i in scene.builder.primitives:
        s = scene.description.shapes[i]
        geometry = geometry_of(s)
        if geometry.is_material:
            continue
        if geometry.device.moves != FLOWS:
            raise ValueError(
                f"vertices on the {s.kind!r} {s.path!r} have no normals to flow along, but normals that jump at "
                f"{geometry.jumps}; {instead}"
            )
        surface = passed_by(scene, i)
        if surface.box is None:
            continue
        other = in_box(scene, i, surface.box[0] / surface.cells, surface.box[1] / surface.cells)
        if other is not None:
            path = scene.description.shapes[other].path
            raise ValueError(
                f"{path!r} reaches into the box around the surface of {s.path!r}, and may run through it along a curve "
                f"of which there is no boundary term where vertices flow along normals; {instead}"
            )

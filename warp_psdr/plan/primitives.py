"""Shapes without triangles in the plan: the kinds that a scene holds, their lines, and what is not supported yet."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

from warp_psdr.kernels.bsdf.dispatch import has_delta_lobes
from warp_psdr.kernels.constants import METERS
from warp_psdr.kernels.primitive.curve_kinds import CURVES
from warp_psdr.kernels.primitive.kind import FLOWS
from warp_psdr.options import interior
from warp_psdr.options.boundary import Method, PathSpace, Projective, Reparametrised
from warp_psdr.plan.motion import motion
from warp_psdr.scene.bsdfs import model_of
from warp_psdr.scene.kinds import table
from warp_psdr.scene.kinds.kind import geometry_of
from warp_psdr.scene.kinds.neuralsdf import network_and_cells
from warp_psdr.scene.kinds.sdfgrid import SdfGrid
from warp_psdr.scene.kinds.table import MATERIAL
from warp_psdr.topology.crossing_curves import touched
from warp_psdr.topology.crossing_pairs import crossed_light, touching_pair
from warp_psdr.topology.exact_shapes import reaching
from warp_psdr.topology.grid_contacts import in_box, is_open, passed_by, pierced_grid
from warp_psdr.topology.grid_silhouettes import grid_shapes, grid_values, is_smooth_grid
from warp_psdr.topology.joined_rims import joined_rims
from warp_psdr.topology.network_silhouettes import is_open_network, network_shapes
from warp_psdr.topology.tube_contacts import pierced_tubes
from warp_psdr.topology.tube_crossings import resting_end
from warp_psdr.topology.unchanged import kept

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.scene.description import ShapeDescription
    from warp_psdr.scene.scene import Scene

#: Methods of the interior term that know such shapes.
CLAIMED = (interior.Replay, interior.Textbook, interior.Radiative)
#: Kinds of shapes that may be of models which are mirrors or glass and more, where others may be the one or the other.
MIXED = MATERIAL
#: What the errors offer.
ALONE = "say PathIntegrator(boundary=None) to get the interior term alone"
INSTEAD = "leave out 'exact', and it is made of triangles, which do"


def kinds(scene: Scene) -> tuple[int, ...]:
    """Return the numbers of the kinds of a scene, for the path loop."""
    return tuple(sorted({scene.geometry(i).device.number for i in scene.builder.primitives}))


def are_exact(config: PathConfig) -> bool:
    """Return whether all shapes without triangles are exact ones, whose points are material."""
    return set(config.primitives) <= set(MATERIAL)


def shining(scene: Scene) -> tuple[int, ...]:
    """Return those kinds of a scene that shine."""
    shapes = [scene.description.shapes[i] for i in scene.builder.primitives]
    return tuple(sorted({geometry_of(s).device.number for s in shapes if s.emitter is not None}))


def describe(scene: Scene) -> list[tuple[str, str, str]]:
    """Return the plan's lines."""
    return table.describe(scene.description.shapes)


def refuse(
    scene: Scene,
    config: PathConfig,
    integrator: PathIntegrator,
    wanted: GradientRequest | None,
    names: list[str],
    moving: tuple[str, ...],
) -> None:
    """Raise for what is not done beside shapes without triangles.

    Raises:
        ValueError: with the shape, and what to do.
    """
    if not config.primitives:
        return
    shapes = [scene.description.shapes[i] for i in scene.builder.primitives]
    light = next((s for s in shapes if geometry_of(s).is_material and s.emitter is not None), None)
    resting = next((s for s in shapes if not geometry_of(s).is_material), None)
    if resting is not None:
        reason = _beside_resting(scene, config, integrator, wanted, names, moving)
        if reason:
            raise ValueError(f"{resting.path!r} is a {resting.kind!r}, and {reason}; or {geometry_of(resting).instead}")
        return
    shape = light or shapes[0]
    reason = ""
    if config.media is not None:
        reason = "participating media do not know it"
    else:
        reason = _of_method(integrator.interior, wanted)
        if not reason and moving and integrator.boundary is not None:
            reason = _beside_motion(scene, config, integrator, names)
    if reason:
        raise ValueError(f"{shape.path!r} is an exact {shape.kind!r}, and {reason}; or {INSTEAD}")


def _of_method(method: interior.Method | str, wanted: GradientRequest | None) -> str:
    """Say why a method of the interior does not do beside shapes without triangles; empty: it does."""
    if isinstance(method, interior.FROM_LIGHTS):
        return "paths from the lights do not meet it; use interior.Replay()"
    if wanted is not None and not isinstance(method, CLAIMED):
        return f"interior.{type(method).__name__}() does not know it; use interior.Replay()"
    return ""


def _beside_resting(
    scene: Scene,
    config: PathConfig,
    integrator: PathIntegrator,
    wanted: GradientRequest | None,
    names: list[str],
    moving: tuple[str, ...],
) -> str:
    """Say what is not done beside grids of distances and curves; empty: nothing of what is asked for."""
    if config.media is not None:
        return "participating media do not know it; leave out the media"
    reason = _of_method(integrator.interior, wanted)
    if reason:
        return reason
    if wanted is not None and wanted.geometry and not isinstance(integrator.interior, interior.Replay):
        what = type(integrator.interior).__name__
        return f"interior.{what}() does not follow what slides along rays; use interior.Replay()"
    if moving and integrator.boundary is not None:
        return _beside_moving_kinds(scene, config, integrator, names)
    return ""


def _beside_motion(scene: Scene, config: PathConfig, integrator: PathIntegrator, names: list[str]) -> str:
    """Say which boundary term is missing where something moves; empty: none."""
    reason = _of_boundary(scene, config, integrator)
    if reason:
        return reason
    return _of_exact(scene, config, integrator, names)


def _of_exact(scene: Scene, config: PathConfig, integrator: PathIntegrator, names: list[str]) -> str:
    """Say what exact shapes run through, or touch, along a curve without a term; empty: nothing."""
    moves = motion(scene, names)
    moved, joined = None if moves.camera else moves.shapes, joined_rims(scene)
    if joined.bared:
        a, b = (scene.description.shapes[i] for i in joined.bared[0])
        return f"{a.path!r} lies in the surface of {b.path!r}, which closes the cylinder by itself; leave it out"
    pair = reaching(scene, moved)
    if pair is not None:
        a, b = (scene.description.shapes[i] for i in pair)
        return (
            f"{b.path!r} reaches into the box around {a.path!r}, whose curves of intersection are not known; move them "
            "apart"
        )
    pair = touching_pair(scene, moved) or touched(scene, moved)
    if pair is not None:
        a, b = (scene.description.shapes[i] for i in pair)
        return (
            f"{b.path!r} touches {a.path!r} along a line that moves; lift one off the other, or let one reach into the "
            "other"
        )
    if joined.pairs and has_delta_lobes(config.bsdfs):
        a, b = (scene.description.shapes[i] for i in joined.pairs[0])
        where = f"{a.path!r} and {b.path!r} join at a rim"
        return f"{where}, which is not followed through smooth mirrors and glass; make them rough"
    pair = crossed_light(scene) if integrator.hide_emitters else None
    if pair is not None:
        a, b = (scene.description.shapes[i] for i in pair)
        return f"{b.path!r}, a light that hide_emitters hides, runs through the surface of {a.path!r}; move them apart"
    return ""


def _of_boundary(scene: Scene, config: PathConfig, integrator: PathIntegrator) -> str:
    """Say why no boundary term is estimated beside shapes without triangles; empty: one is."""
    method = integrator.boundary
    if isinstance(method, Reparametrised) and config.shining:
        return f"{method.label}() does not move rays where exact shapes shine; use boundary.PathSpace()"
    if isinstance(method, Reparametrised):
        pass  # it knows them alone (``plan/reparametrised.py``)
    elif isinstance(method, Projective) and are_exact(config):
        pass
    elif isinstance(method, Method) and type(method) is not PathSpace:
        return f"{method.label}() has no terms of it; use boundary.PathSpace()"
    if config.camera in METERS:
        return "what moves is not followed from a sensor of one pixel; use a camera"
    if has_delta_lobes(config.bsdfs):
        if isinstance(method, Reparametrised):
            return f"{method.label}() does not move rays behind smooth mirrors and glass; use boundary.PathSpace()"
        return _of_mirrors(scene)
    return ""


def _as_a_mirror(shape: ShapeDescription) -> str:
    """Say why what moves is not followed through a shape that is a smooth mirror or glass; empty: it is, or is none."""
    kind = geometry_of(shape).device.number
    models = [model_of(b) for b in shape.bsdf.sides if model_of(b).has_delta]
    if not models or kind in MIXED:
        return ""
    curved = kind in CURVES
    other = next((m.plugin for m in models if m.has_smooth or m.has_null or (curved and m.transmits)), "")
    if not other:
        return ""
    fit = "'conductor', as light that enters a curve leaves it unseen," if curved else "'conductor' or a 'dielectric',"
    return f"what moves is not followed through the {other!r} of {shape.path!r}; give it a {fit} or make it rough"


def _of_mirrors(scene: Scene) -> str:
    """Say which shape is not followed through smooth mirrors and glass; empty: all are."""
    shapes = [scene.description.shapes[i] for i in scene.builder.primitives]
    for s in shapes:
        reason = _as_a_mirror(s)
        if reason:
            return reason
        if isinstance(s.geometry, SdfGrid) and s.geometry.smooth:
            turned = f"the 'smooth' normals of {s.path!r} turn away from the viewer beside its silhouettes"
            curves = "curves that are not followed through smooth mirrors and glass"
            return f"{turned}, along {curves}; say 'normals': 'analytic'"
    return ""


def _beside_moving_kinds(scene: Scene, config: PathConfig, integrator: PathIntegrator, names: list[str]) -> str:
    """The same beside grids of distances and curves, and exact shapes among them."""
    reason = _of_boundary(scene, config, integrator)
    if reason:
        return f"{reason}, or {ALONE}"
    if isinstance(integrator.boundary, Reparametrised):
        return ""  # ``plan/reparametrised.py`` says what it does
    shapes = scene.description.shapes
    for i in grid_shapes(scene):
        if is_open(grid_values(scene, i), is_smooth_grid(scene, i)):
            opened = f"the surface of {shapes[i].path!r} ends at its box, along a curve that moves"
            return f"{opened}; give positive values all around, or {ALONE}"
    reason = _of_exact(scene, config, integrator, names)
    if reason:
        return f"{reason}, or {ALONE}"
    for i in network_shapes(scene):
        if kept(scene, ("open network", i), functools.partial(_is_open, scene, i)):
            opened = f"the surface of {shapes[i].path!r} may end at its box, along a curve that moves"
            return f"{opened}; keep phi positive all around, or {ALONE}"
        if set(config.primitives) & set(CURVES):
            return f"beside {shapes[i].path!r} curves have no boundary term; leave them out, or {ALONE}"
    moves = motion(scene, names)
    moved = None if moves.camera else moves.shapes
    for find, surface in ((pierced_grid, "surface"), (pierced_tubes, "tubes")):
        pair = kept(scene, (surface, moved), functools.partial(find, scene, moved))
        if pair is not None:
            a, b = (shapes[i].path for i in pair)
            what = f"{b!r} runs through the {surface} of {a!r}" if a != b else f"tubes of {a!r} run through each other"
            return f"{what}, along a curve that moves; move them apart, or {ALONE}"
    pair = kept(scene, ("resting end", moved), lambda: resting_end(scene, moved))
    if pair is not None:
        a, b = (shapes[i].path for i in pair)
        return f"an open end of {a!r} lies on {b!r}, along a line that moves; sink it in or lift it off, or {ALONE}"
    return ""


def _is_open(scene: Scene, shape: int) -> bool:
    """Whether the surface of a network may end at its box."""
    return is_open_network(*network_and_cells(scene, shape))


def refuse_flow(scene: Scene, config: PathConfig) -> None:
    """Raise where vertices cannot flow along normals.

    Raises:
        ValueError: with the shape, and what to do.
    """
    instead = "say interior.Replay(flow='ray')"
    if has_delta_lobes(config.bsdfs):
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

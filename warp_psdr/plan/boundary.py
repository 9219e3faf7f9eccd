"""The method that estimates the boundary term of a scene, and what no method covers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.bsdf.dispatch import has_chain_lobes, has_delta_lobes
from warp_psdr.kernels.bsdf.model import key_of
from warp_psdr.kernels.emitter.spot import MIN_FALLOFF
from warp_psdr.options.boundary import EdgeSampling, Method, PathSpace
from warp_psdr.plan import discontinuities, media, primitives, steps
from warp_psdr.plan.discontinuities import FRAME, LIGHT_FRAME, Asked
from warp_psdr.plan.motion import motion
from warp_psdr.plan.needs import needs, unknown_to_boundary
from warp_psdr.rows import reparametrised
from warp_psdr.scene.layout import NORMALS, POSITIONS, SHAPE_POSE, TEXCOORDS, TO_UV
from warp_psdr.scene.materials.bsdfs import model_of
from warp_psdr.topology.intersection_curves import scene_curves
from warp_psdr.topology.light_frames import has_hard_frame, unknown_steps

if TYPE_CHECKING:
    from warp_psdr.kernels.structs import Emitter
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.scene.scene import Scene


def choose(
    scene: Scene, config: PathConfig, integrator: PathIntegrator, names: list[str], moving: tuple, sensor: int
) -> Method:
    """Return the method that estimates the boundary term of the named parameters.

    Args:
        scene: the scene.
        config: what its path loop compiles.
        integrator: names the method, or "auto".
        names: what is differentiated.
        moving: which discontinuities move, in words.
        sensor: before which camera.

    Raises:
        ValueError: no method covers the case.
    """
    by_itself: Method = EdgeSampling() if config.camera == c.CAMERA_RADIANCEMETER else PathSpace()
    method = integrator.boundary if isinstance(integrator.boundary, Method) else by_itself
    needed, depth = needs(scene, config, None), integrator.max_depth
    reason = (
        unknown_to_boundary(method, needed)
        or _metered(scene, config, depth)
        or media.refused(scene, config, names)
        or primitives.refused(scene, config, integrator, names, sensor)
        or _uncovered(scene, config, names, method)
        or discontinuities.unknown(Asked(scene, config, motion(scene, names), sensor, depth), method, needed)
        or reparametrised.refused(scene, config, integrator, method, names, sensor)
    )
    if reason:
        raise ValueError(
            f"the requested gradient has a boundary term ({'; '.join(moving)}), which {method.label}() cannot "
            f"estimate here: {reason}; or say PathIntegrator(boundary=None) to get the interior term alone"
        )
    return method


def _metered(scene: Scene, config: PathConfig, max_depth: int) -> str:
    """Say what keeps a radiance meter from a boundary term; empty: nothing.

    It has one ray: what moves across it has measure zero, and what is left are the edges that vertices of its paths
    see.
    """
    if config.camera != c.CAMERA_RADIANCEMETER or max_depth == 2:
        return ""
    if set(config.lights.others) & c.DELTA_LIGHTS:
        return "before a radiancemeter, hard shadows are not covered beyond max_depth=2; use a narrow camera"
    if len(scene_curves(scene).length):
        return "before a radiancemeter, shapes that run through each other are not covered; use a narrow camera"
    return ""


def refuse_own_shape(scene: Scene, sensor: int, names: list[str]) -> None:
    """Refuse to move the shape that an irradiance meter, or a directional area light, lies on.

    Raises:
        ValueError: it is requested.
    """
    meter = scene.description.sensors[sensor]
    for name in names:
        p = scene.parameters[name]
        light = scene.description.shapes[p.owner].emitter if p.uses & {POSITIONS, SHAPE_POSE} else None
        if light is not None and light.kind == "directionalarea":
            raise ValueError(
                f"{name} moves the shape of the directional area light {light.path!r}, whose outline has no derivative "
                "here; use a 'directional' light, or an 'area' light"
            )
        if p.uses & {POSITIONS, SHAPE_POSE} and scene.description.shapes[p.owner].sensor is meter:
            raise ValueError(
                f"{name} moves the shape of the irradiancemeter {meter.path!r}, whose points have no derivative here; "
                "move everything else, or measure on another shape"
            )


def _uncovered(scene: Scene, config: PathConfig, names: list[str], method: Method) -> str:
    """Say why the boundary term cannot be estimated; empty: it can."""
    if config.shown:  # of what lights, materials and textures do nothing is seen
        return ""
    if has_chain_lobes(config.surfaces.bsdfs, config.media is not None):
        crowded = [
            (shape.path, key_of(bsdf.model, bsdf.variant, bsdf.children))
            for shape in scene.description.shapes
            for bsdf in shape.bsdf.sides
            if model_of(bsdf).has_delta and len(model_of(bsdf).lobes) > 2
        ]
        if crowded:
            return (
                f"shape {crowded[0][0]!r}, a {crowded[0][1]!r}, scatters smoothly, reflects as a mirror and lets light "
                "pass, and discontinuities are searched through two of these; split it up"
            )
    moving = steps.refused(scene, config, names, method)
    if moving:
        return moving
    for e in scene.builder.emitters:
        edge = _unknown_edge_of_light(scene, config, e)
        if edge:
            return edge
    return ""


def sliding_heights(scene: Scene, config: PathConfig, names: list[str], geometry: bool) -> str:
    """Say what slides a bump map, or turns the surface that it lies on; empty: nothing does.

    ``geometry``: path vertices move at all.
    """
    b, moves = scene.builder, motion(scene, names)
    for name in names:
        parameter = scene.parameters[name]
        if TO_UV in parameter.uses and any(b.textures[n].to_uv == parameter.offset for n in b.heights):
            return f"{name} slides a bump map"
    if not geometry:
        return ""
    bumped = {i for i, s in enumerate(b.shapes) if {s.bsdf, b.bsdfs[s.bsdf].back} & b.bumped}
    if not bumped:
        return ""
    first = scene.description.shapes[min(bumped)].path
    if moves.camera:
        return f"the camera moves before the bump map of {first!r}"
    if has_delta_lobes(config.surfaces.bsdfs):
        return f"things move in smooth mirrors or glass, in which the bump map of {first!r} may be seen"
    for name in names:
        parameter = scene.parameters[name]
        if parameter.owner in bumped and parameter.uses & {POSITIONS, SHAPE_POSE, NORMALS, TEXCOORDS}:
            return f"{name} moves the bump map of {scene.description.shapes[parameter.owner].path!r}"
    return ""


def edge_of_light(scene: Scene, e: Emitter) -> str:
    """Say which hard edge the light of a light of no area ends in, and what to do; empty: it has none."""
    if e.kind in c.SPOTS:
        cutoff, beam = scene.values.numpy()[e.cutoff : e.cutoff + 2].tolist()
        if math.radians(cutoff - beam) <= MIN_FALLOFF:
            return "a spot light's cone has a hard edge; make beam_width smaller than cutoff_angle"
    if e.kind == c.EMITTER_DIRECTIONAL_AREA:
        return "the light of a directionalarea ends in a hard edge; use a 'directional' light, or an 'area' light"
    if e.kind == c.EMITTER_PROJECTOR and has_hard_frame(scene, e):
        return f"{FRAME}; {LIGHT_FRAME.instead}"
    return ""


def _unknown_edge_of_light(scene: Scene, config: PathConfig, e: Emitter) -> str:
    """Say which hard edge of a light has no term here, and what to do; empty: none."""
    edge = edge_of_light(scene, e)
    if not edge or e.kind != c.EMITTER_PROJECTOR:
        return edge
    mirrors = has_delta_lobes(config.surfaces.bsdfs)
    of_texels = unknown_steps(scene, e, mirrors)
    if of_texels:
        return of_texels
    for there, what in (
        (config.media is not None, "participating media"),
        (
            mirrors and len(scene_curves(scene).length) > 0,
            "smooth mirrors or glass where shapes run through each other",
        ),
        (config.camera in c.METERS, "a sensor without a film"),
    ):
        if there:
            return f"{FRAME}, which is not known beside {what}; {LIGHT_FRAME.instead}"
    return ""

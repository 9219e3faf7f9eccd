"""The radiance along a ray through media, beside an edge that the camera sees and at x_1 of a boundary segment.

The path tracer of ``path_media.py`` estimates it. ``detector.py`` is the counterpart without media.

Derivation: ``docs/theory/media.md#boundaries-in-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.detector import NEVER, ROW_COUNT, ROWS, Incident, IncidentRadiance
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import FAR, LOBE_NULL
from warp_psdr.kernels.emitter.area import make_area
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.medium.interface import make_interface
from warp_psdr.kernels.path_media import make_media_step, media_path_from, radiance_of_step
from warp_psdr.kernels.primitive.dispatch import make_position
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import LightConfig, PathConfig, path_from


@functools.cache
def make_media_radiance(config: PathConfig):
    """Return ``media_radiance(scene, sampler, medium, o, d, t_max, max_depth, rr_depth) -> IncidentRadiance``.

    Its surface is the first one that is there.
    """
    is_interface, behind = make_interface(config)
    media_step = make_media_step(config, False)
    position, _cross_of = make_position(config.surfaces.primitives)

    @wp.func
    def media_radiance(
        scene: Scene,
        sampler: Sampler,
        medium: wp.int32,
        o: wp.vec3,
        d: wp.vec3,
        t_max: wp.float32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> IncidentRadiance:
        r = IncidentRadiance()
        r.face = -1
        straight = wp.bool(True)
        state = media_path_from(path_from(o, d, t_max, 0), medium)
        while state.path.alive == 1:
            step, state = media_step(scene, sampler, state, max_depth, rr_depth)
            r.radiance += radiance_of_step(step)
            passes = not step.collides and step.surface.lobe == LOBE_NULL and is_interface(scene, step.surface.face)
            if straight and not passes:
                # The path met the surface, or turned in front of it.
                straight = wp.bool(False)
                hit = RayHit()
                hit.face = step.surface.face
                hit.u = step.surface.u
                hit.v = step.surface.v
                if is_interface(scene, hit.face):
                    hit = behind(scene, hit, d, t_max, 0)
                r.face = hit.face
                if hit.face >= 0:
                    r.x = position(scene.triangles[hit.face], hit.u, hit.v)
        return r

    return media_radiance


@functools.cache
def make_end_radiance(lights: LightConfig):
    """Return ``end_radiance(scene, face, u, v, w) -> vec3``: what a surface, -1: the environment, emits against w."""
    emitted = make_area(lights.area, lights.shining).emitted if lights.area else None
    others = make_lights(lights.others, None, ()) if lights.others else None
    environment_eval = others.environment_eval if others else None

    @wp.func
    def end_radiance(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32, w: wp.vec3) -> wp.vec3:
        r = wp.vec3(0.0, 0.0, 0.0)
        if face >= 0:
            if wp.static(emitted is not None):
                emitter = scene.shapes[scene.triangles[face].shape].emitter
                if emitter >= 0:
                    r = emitted(scene, scene.emitters[emitter], face, u, v, w)
        else:
            if wp.static(environment_eval is not None):
                r = environment_eval(scene, w)
        return r

    return end_radiance


@functools.cache
def make_media_incident(config: PathConfig, whole: bool = False):
    """Return ``media_incident(scene, sampler, medium, o, d, depth, max_depth, rr_depth) -> Incident``.

    As ``detector.make_incident``, but without what the first surface that is there, or the environment, emits unless
    the path has turned in front of it. ``whole``: with that.
    """
    media_step = make_media_step(config, False)
    is_interface, _behind = make_interface(config)
    emitted = make_interaction(config.surfaces, config.lights).emitted
    emissive = config.media is not None and config.media.emissive

    @wp.func
    def media_incident(
        scene: Scene,
        sampler: Sampler,
        medium: wp.int32,
        o: wp.vec3,
        d: wp.vec3,
        depth: wp.int32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> Incident:
        r = Incident()
        r.first = depth
        r.cut = NEVER
        rows = ROWS()
        turned = wp.bool(False)
        state = media_path_from(path_from(o, d, FAR, depth), medium)
        while state.path.alive == 1:
            # Behind first + cut vertices the path ends here.
            if max_depth >= 0:
                r.cut = max_depth - 1 - state.path.depth
            step, state = media_step(scene, sampler, state, max_depth, rr_depth)
            vertex = step.surface
            value = radiance_of_step(step)
            own = wp.vec3(0.0, 0.0, 0.0)
            if not step.collides:
                if vertex.face < 0:
                    own = wp.cw_mul(vertex.throughput, vertex.direct)
                else:
                    if wp.static(emitted is not None):
                        shines = emitted(scene, vertex.face, vertex.u, vertex.v, vertex.d)
                        own = vertex.e_weight * wp.cw_mul(vertex.throughput, shines)
            if wp.static(not whole) and not turned:
                value -= own
                own = wp.vec3(0.0, 0.0, 0.0)
            passes = not step.collides and vertex.lobe == LOBE_NULL and is_interface(scene, vertex.face)
            turned = turned or not passes
            if max_depth >= 0 and r.cut < ROW_COUNT:
                last = r.total + own
                if wp.static(emissive):
                    last += wp.cw_mul(step.before, step.emitted)
                for c in range(3):
                    rows[r.cut, c] = last[c]
            r.total += value
        r.rows = rows
        return r

    return media_incident

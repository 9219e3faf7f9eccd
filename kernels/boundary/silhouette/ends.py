"""The two ends of a segment that touches a shape without triangles: its first hits towards the source and the sensor.

A kind of shape gives the touching point and its density; this file finds both ends for all kinds.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.crossing.curve import OFF
from warp_psdr.kernels.boundary.path_space.direction import make_pdf_light
from warp_psdr.kernels.boundary.path_space.edge_segment import moves
from warp_psdr.kernels.boundary.silhouette.aim import TangentAim
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.emitter.area import make_area
from warp_psdr.kernels.emitter.dispatch import is_delta_light, make_delta_sample, make_lights
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.medium.line import AHEAD, ClearLine, make_line
from warp_psdr.kernels.primitive.curve_kinds import TUBES
from warp_psdr.kernels.primitive.curves import is_spline
from warp_psdr.kernels.primitive.dispatch import make_point_at
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig, RayConfig
from warp_psdr.kernels.visibility import visibility_of

#: How far from the point of a light that a segment was aimed at it may meet the light: over the distance, and in steps.
NEAR_LIGHT, STEPS = 1.0e-3, 20.0


@wp.struct
class SourceEnd:
    """What a segment meets towards the source."""

    valid: wp.int32
    segment: Segment
    any_moves: wp.int32  # of the shapes met so far, that which is touched included
    delta: wp.bool  # a light without area, which the segment was aimed at
    aimed: wp.bool  # the segment was aimed at a light
    y: wp.vec3  # the point that is met, that of the light without area, or the direction of what lies behind the scene
    distant: wp.bool  # y is a direction
    towards: wp.float32  # density of the direction as of a point of a light, 0: no technique aims there, 1: ``delta``
    to_eye: wp.float32  # distance to what the segment was aimed at
    passed: wp.vec3  # transmittance up to x_2; only in media


@functools.cache
def make_source_end(config: PathConfig):
    """Return ``source_end(scene, sampler, medium, moving, s, face, x, aim, aims, direct) -> SourceEnd``.

    ``s`` holds w, step, x and source; ``face`` and ``x`` are those of the touched point, ``medium``: that at the point,
    which is read in media alone, ``aims``: its item is aimed at lights as well, ``direct`` as in
    ``path_space/secondary.py``; in media: nothing but what x_2 emits counts.
    """
    among_media = config.media is not None
    line = make_line(config)[0] if among_media else None
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    pdf_light = make_pdf_light(config.lights, uniform=True)
    point_at = make_point_at(config.surfaces.primitives)
    emitted = make_area(config.lights.area, config.lights.shining).emitted if config.lights.area else None
    lights = make_lights(config.lights.others, None, ()) if config.lights.others else None
    environment_eval = lights.environment_eval if lights else None
    has_environment = environment_eval is not None
    delta_sample = make_delta_sample(config.lights.others)

    @wp.func
    def source_end(
        scene: Scene,
        sampler: Sampler,
        medium: wp.int32,
        moving: wp.array(dtype=wp.int32),
        s: Segment,
        face: wp.int32,
        x: wp.vec3,
        aim: TangentAim,
        aims: wp.bool,
        direct: wp.bool,
    ) -> SourceEnd:
        end = SourceEnd()
        r = s
        r.face2 = -1
        r.light = -1
        end.any_moves = moves(scene, moving, face)
        end.to_eye = wp.length(aim.eye - r.x)
        end.aimed = aim.light >= 0
        ahead = ClearLine()
        if wp.static(delta_sample is not None):
            if aim.light >= 0:
                emitter = scene.emitters[aim.light]
                if is_delta_light(emitter.kind):
                    end.delta = True
                    end.y = aim.eye
                    end.distant = aim.distant
                    end.towards = 1.0
                    ls = delta_sample(scene, emitter, x, wp.vec2(0.0, 0.0))
                    if ls.pdf <= 0.0 or vanishes(ls.radiance):
                        return end
                    way = wp.where(aim.distant, FAR, end.to_eye)
                    if wp.static(among_media):
                        ahead = line(scene, sampler, AHEAD, r.source, r.w, way, medium, 1)
                        if ahead.lost or ahead.face >= 0:
                            return end
                    else:
                        if visibility.occluded(scene, r.source, r.w, way):
                            return end
                    r.light = aim.light
                    r.known = 1
                    r.radiance = ls.radiance / emitter.probability
        if not end.delta:
            hit2 = RayHit()
            if wp.static(among_media):
                ahead = line(scene, sampler, AHEAD, r.source, r.w, FAR, medium, 1)
                if ahead.lost:
                    return end
                hit2.face = ahead.face
                hit2.u = ahead.u
                hit2.v = ahead.v
                hit2.t = ahead.t
            else:
                hit2 = visibility.closest(scene, r.source, r.w, FAR)
            r.face2 = hit2.face
            r.u2 = hit2.u
            r.v2 = hit2.v
            r.t2 = hit2.t
            if aim.light >= 0:
                # A segment that something cuts off from its light is not one that was aimed at what is in the way.
                if aim.distant != (hit2.face < 0):
                    return end
                if hit2.face >= 0:
                    if scene.shapes[scene.triangles[hit2.face].shape].emitter != aim.light:
                        return end
                    if wp.static(bool(config.lights.shining)):
                        # An exact shape has one point at most that faces the segment.
                        if wp.dot(aim.cross, r.w) > 0.0:
                            return end
                    near = wp.abs(hit2.t - end.to_eye) <= NEAR_LIGHT * end.to_eye + STEPS * r.step
                    if not near and wp.length_sq(aim.cross) == 0.0:
                        return end
            end.y = r.w
            end.distant = r.face2 < 0
            if r.face2 >= 0:
                end.any_moves += moves(scene, moving, r.face2)
                end.y = point_at(scene, scene.triangles[r.face2], r.u2, r.v2)
                if wp.static(bool(config.lights.area)):
                    own = scene.shapes[scene.triangles[r.face2].shape].emitter
                    if own >= 0:
                        r.radiance = emitted(scene, scene.emitters[own], r.face2, r.u2, r.v2, r.w)
            else:
                if wp.static(has_environment):
                    r.radiance = environment_eval(scene, r.w)
            if (direct or (wp.static(not among_media) and r.face2 < 0)) and vanishes(r.radiance):
                return end
            if aims:
                end.towards = pdf_light(scene, r.face2, r.u2, r.v2, r.w, r.t2)
                if aim.light >= 0 and not end.towards > 0.0:
                    return end
        end.segment = r
        end.passed = ahead.transmittance
        end.valid = 1
        return end

    return source_end


@functools.cache
def make_sensor_end(rays: RayConfig, primitives: tuple[int, ...]):
    """Return ``sensor_end(scene, moving, s, any_moves) -> Segment``, valid if it ends on a surface and anything moves.

    ``any_moves`` counts what moves of all that was met before.
    """
    visibility = visibility_of(rays, primitives)

    @wp.func
    def sensor_end(scene: Scene, moving: wp.array(dtype=wp.int32), s: Segment, any_moves: wp.int32) -> Segment:
        r = s
        hit1 = visibility.closest(scene, r.x, -r.w, FAR)
        if hit1.face < 0:
            return r
        if any_moves + moves(scene, moving, hit1.face) == 0:
            return r
        r.t1 = hit1.t
        if r.t1 <= r.step:
            return r
        r.face1 = hit1.face
        r.u1 = hit1.u
        r.v1 = hit1.v
        r.valid = 1
        return r

    return sensor_end


@wp.func
def is_beside_curve(scene: Scene, s: Segment, face: wp.int32, curvature: wp.float32) -> wp.bool:
    """Whether x_1, on another shape, is closer to the touched one than where the terms of their common curve look.

    Those count all that changes up to there (``docs/theory/implicit.md#curves-of-intersection``).
    """
    if scene.triangles[s.face1].shape == scene.triangles[face].shape:
        return False
    return 0.5 * curvature * s.t1 * s.t1 < OFF * s.step


@functools.cache
def make_beside_curve(primitives: tuple[int, ...]):
    """Return ``is_beside_curve``; of B-splines, which may run through themselves, x_1 may be on the same shape."""
    if TUBES.number not in primitives:
        return is_beside_curve

    @wp.func
    def is_beside_any_curve(scene: Scene, s: Segment, face: wp.int32, curvature: wp.float32) -> wp.bool:
        tri = scene.triangles[face]
        if scene.triangles[s.face1].shape == tri.shape and not is_spline(tri):
            return False
        return 0.5 * curvature * s.t1 * s.t1 < OFF * s.step

    return is_beside_any_curve


@wp.func
def with_density(s: Segment, end: SourceEnd, aim: TangentAim, density: wp.float32) -> Segment:
    """A segment with both ends, its scale one over the density, and the share of it that lies before the shape."""
    r = s
    r.scale = 1.0 / density
    if end.delta:
        if not aim.distant:
            r.tau = r.t1 / (r.t1 + end.to_eye)
    elif r.face2 >= 0:
        r.tau = r.t1 / (r.t1 + r.t2)
    return r

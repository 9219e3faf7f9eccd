"""Secondary boundary of curves with a radius: segments between two path vertices that touch one, or one's open end.

Two techniques are joined by the balance heuristic: an item with a direction of its own, and a point of a light with the
silhouettes that it sees. Of point, spot and directional lights the direction is given. Vertices slide along the rays
that find them (form S), so what a curve sends past its own silhouette counts as well (``tube_foreground.py``).

Derivation: ``docs/theory/implicit.md#silhouettes-of-tubes``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.depth import make_indirect
from warp_psdr.kernels.boundary.path_space.direction import make_pdf_light
from warp_psdr.kernels.boundary.path_space.secondary import make_source_sink, moves
from warp_psdr.kernels.boundary.silhouette.secondary import (
    NEAR_LIGHT,
    SLOT_DIRECTION,
    SLOT_SILHOUETTE,
    STEPS,
    TangentAim,
    make_light_aim,
)
from warp_psdr.kernels.boundary.silhouette.tube_points import (
    TubeItems,
    TubePoint,
    beside_tube,
    choose_tube,
    in_front,
    tube_coordinates,
    tube_curvature,
    tube_seen,
)
from warp_psdr.kernels.boundary.silhouette.tube_sampling import (
    TubeTouch,
    own_touch,
    own_touch_density,
    seen_touch_density,
)
from warp_psdr.kernels.boundary.silhouette.tube_sink import make_tube_sink
from warp_psdr.kernels.boundary.transport import Segment, make_source, make_transport
from warp_psdr.kernels.constants import FAR, PRIMITIVE_LINEARCURVE
from warp_psdr.kernels.emitter.area import make_area
from warp_psdr.kernels.emitter.dispatch import is_delta_light, make_delta_sample, make_lights
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.dispatch import make_point_at
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Sample slot of the root around a circle.
SLOT_ROOT = 2
#: Share of the way from x_1 on which the segment is followed forwards.
FORWARDS = 0.999


@functools.cache
def make_sees(config: PathConfig):
    """Return ``sees(scene, x, w, t1) -> bool``: whether a ray comes along w, from the distance t1, to a point.

    Straight segments run into each other at joints, and rays that start in one leave it unseen.
    """
    visibility = visibility_of(config)
    has_linear = PRIMITIVE_LINEARCURVE in config.primitives

    @wp.func
    def sees(scene: Scene, x: wp.vec3, w: wp.vec3, t1: wp.float32) -> wp.bool:
        if wp.static(has_linear):
            way = FORWARDS * t1
            return not visibility.occluded(scene, x - way * w, w, way)
        return True

    return sees


@functools.cache
def make_tube_segment(config: PathConfig):
    """Return ``segment(scene, moving, point, aim, chance, share, direct) -> Segment``; chance: that of the item.

    ``aim.light`` is -1 where its direction is its own, as of the fraction ``share`` of the segments; ``direct`` as in
    ``path_space/secondary.py``. The scale is one over the density of what was drawn.
    """
    visibility = visibility_of(config)
    sees = make_sees(config)
    pdf_light = make_pdf_light(config)
    point_at = make_point_at(config.primitives)
    emitted = make_area(config.area).emitted if config.area else None
    lights = make_lights(config.lights, None, ()) if config.lights else None
    environment_eval = lights.environment_eval if lights else None
    has_environment = environment_eval is not None
    delta_sample = make_delta_sample(config.lights)

    @wp.func
    def tube_segment(
        scene: Scene,
        moving: wp.array(dtype=wp.int32),
        point: TubePoint,
        aim: TangentAim,
        chance: wp.float32,
        share: wp.float32,
        direct: wp.bool,
    ) -> Segment:
        r = Segment()
        r.face2 = -1
        r.light = -1
        r.w = aim.w
        curvature = tube_curvature(point, r.w)
        if not in_front(point, r.w, curvature):
            return r
        r.boundary_normal = -point.out
        r.step = beside_tube(point, step_off_primitive(scene, scene.triangles[point.face]))
        r.x = point.x + r.step * point.out
        r.source = r.x
        any_moves = moves(scene, moving, point.face)
        density = wp.float32(0.0)
        to_eye = wp.length(aim.eye - r.x)
        delta = wp.bool(False)
        # ---- Towards the source ----
        if wp.static(delta_sample is not None):
            if aim.light >= 0:
                emitter = scene.emitters[aim.light]
                if is_delta_light(emitter.kind):
                    delta = True
                    ls = delta_sample(scene, emitter, point.x, wp.vec2(0.0, 0.0))
                    if ls.pdf <= 0.0 or vanishes(ls.radiance):
                        return r
                    if visibility.occluded(scene, r.source, r.w, wp.where(aim.distant, FAR, to_eye)):
                        return r
                    r.light = aim.light
                    r.known = 1
                    r.radiance = ls.radiance / emitter.probability
                    density = (1.0 - share) * chance * seen_touch_density(point, aim.eye, aim.distant, r.w)
        if not delta:
            hit2 = visibility.closest(scene, r.source, r.w, FAR)
            r.face2 = hit2.face
            r.u2 = hit2.u
            r.v2 = hit2.v
            r.t2 = hit2.t
            if aim.light >= 0:
                # A segment that something cuts off from its light is not one that was aimed at what is in the way.
                if aim.distant != (hit2.face < 0):
                    return r
                if hit2.face >= 0:
                    if scene.shapes[scene.triangles[hit2.face].shape].emitter != aim.light:
                        return r
                    if wp.abs(hit2.t - to_eye) > NEAR_LIGHT * to_eye + STEPS * r.step:
                        return r
            y = r.w
            if r.face2 >= 0:
                any_moves += moves(scene, moving, r.face2)
                y = point_at(scene, scene.triangles[r.face2], r.u2, r.v2)
                if wp.static(bool(config.area)):
                    own = scene.shapes[scene.triangles[r.face2].shape].emitter
                    if own >= 0:
                        r.radiance = emitted(scene, scene.emitters[own], r.face2, r.u2, r.v2, r.w)
            else:
                if wp.static(has_environment):
                    r.radiance = environment_eval(scene, r.w)
            if (direct or r.face2 < 0) and vanishes(r.radiance):
                return r
            density = share * chance * own_touch_density(point, r.w, curvature)
            if share < 1.0:
                towards = pdf_light(scene, r.face2, r.w, r.t2)
                if aim.light >= 0 and not towards > 0.0:
                    return r
                if towards > 0.0:
                    density += (1.0 - share) * chance * towards * seen_touch_density(point, y, r.face2 < 0, r.w)
        # ---- Towards the sensor ----
        hit1 = visibility.closest(scene, r.x, -r.w, FAR)
        if hit1.face < 0 or not density > 0.0:
            return r
        if any_moves + moves(scene, moving, hit1.face) == 0:
            return r
        r.t1 = hit1.t
        if r.t1 <= r.step or not sees(scene, r.x, r.w, r.t1):
            return r
        r.face1 = hit1.face
        r.u1 = hit1.u
        r.v1 = hit1.v
        r.scale = 1.0 / density
        if delta:
            if not aim.distant:
                r.tau = r.t1 / (r.t1 + to_eye)
        elif r.face2 >= 0:
            r.tau = r.t1 / (r.t1 + r.t2)
        r.valid = 1
        return r

    return tube_segment


@functools.cache
def make_secondary_tube_kernel(
    config: PathConfig, role: str, camera_moves: bool, light_pose: bool, indirect: bool = False
):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    light_aim = make_light_aim(config) if config.area or config.lights else None
    segment_at = make_tube_segment(config)
    accumulate_tube = make_tube_sink(role, config.primitives)
    accumulate_source = make_source_sink(role, light_pose, config.primitives)
    source = make_source(config, True)
    source = make_indirect(source) if indirect else source
    transport = make_transport(config, role, camera_moves, source)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d
    note_place = make_note(config.noted)

    @wp.func
    def accumulate(
        scene: Scene, target: wp.array(dtype=wp.float32), point: TubePoint, s: Segment, w: wp.float32
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = accumulate_tube(scene, target, point, w * s.boundary_normal)
        return accumulate_source(scene, target, s, w, total)

    @wp.kernel(module="unique", enable_backward=False)
    def secondary_tube(
        # Scene:
        scene: Scene,
        camera: Camera,
        found: TubeItems,
        moving: wp.array(dtype=wp.int32),
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        u4 = sample_4d(sampler, SLOT_DIRECTION)
        jitter = sample_1d(sampler, SLOT_SILHOUETTE)
        u = (wp.float64(number) + wp.float64(jitter)) / wp.float64(job.samples)
        by_itself = u < wp.float64(found.share)
        if by_itself:
            u = u / wp.float64(found.share)
        else:
            u = (u - wp.float64(found.share)) / wp.float64(1.0 - found.share)
        n, along, chance = choose_tube(found, u)
        item = found.items[n]
        tri = scene.triangles[item[0]]
        aim = TangentAim()
        aim.light = -1
        touch = TubeTouch()
        if by_itself:
            touch = own_touch(scene, tri, item[0], item[1], along, wp.vec3(u4[0], u4[1], u4[2]))
            aim.w = touch.w
        if wp.static(light_aim is not None):
            if not by_itself:
                aim = light_aim(scene, tri.normal, u4)
                if aim.valid == 0:
                    return
                root = sample_1d(sampler, SLOT_ROOT)
                touch.point = tube_seen(scene, tri, item[0], item[1], aim.eye, aim.distant, along, root)
                aim.w = aim.eye
                if not aim.distant:
                    aim.w = wp.normalize(aim.eye - touch.point.x)
        point = touch.point
        if point.valid == 0:
            return
        s = segment_at(scene, moving, point, aim, chance, found.share, job.max_depth == 2)
        if s.valid == 0:
            return
        uv = tube_coordinates(point)
        note_place(scene, NOTE_POINT, point.face, uv[0], uv[1], point.x, s.w, s.radiance)
        s.scale /= wp.float32(job.samples)
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate(scene, target, point, s, 1.0)
        weight = transport(scene, camera, sampler, s, s.scale, rest, job, target, image_out)
        if wp.static(role != "forward"):
            if weight != 0.0:
                if accumulate(scene, target, point, s, weight) != 0.0:
                    count_invalid(scene, sampler)

    return secondary_tube

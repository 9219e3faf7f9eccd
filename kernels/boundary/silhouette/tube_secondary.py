"""Secondary boundary of curves with a radius: segments between two path vertices that touch a curve or its open end.

The balance heuristic joins two techniques: an item with a direction of its own, and a point of a light with the
silhouettes that it sees. Point, spot and directional lights give the direction. Vertices slide along the rays that find
them (form S, ``docs/theory/implicit.md#form-s``), so light that a curve sends past its own silhouette counts as well
(``tube_foreground.py``).

Derivation: ``docs/theory/implicit.md#silhouettes-of-tubes``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.depth import make_indirect
from warp_psdr.kernels.boundary.forwards import make_sees
from warp_psdr.kernels.boundary.guiding.cube import make_cube, make_ends
from warp_psdr.kernels.boundary.guiding.slots import choose_slot
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.boundary.path_space.secondary import make_source_sink
from warp_psdr.kernels.boundary.silhouette.aim import (
    SLOT_DIRECTION,
    SLOT_SILHOUETTE,
    TangentAim,
    make_light_aim,
    make_square_aim,
)
from warp_psdr.kernels.boundary.silhouette.delivery import make_delivery
from warp_psdr.kernels.boundary.silhouette.ends import is_beside_curve, make_sensor_end, make_source_end, with_density
from warp_psdr.kernels.boundary.silhouette.tube_points import (
    TubeItems,
    TubePoint,
    beside_tube,
    choose_tube,
    in_front,
    tube_coordinates,
    tube_curvature,
    tube_outline,
    tube_seen,
)
from warp_psdr.kernels.boundary.silhouette.tube_sampling import (
    TubeTouch,
    drawn_touch_density,
    own_touch,
    own_touch_density,
    seen_touch_density,
)
from warp_psdr.kernels.boundary.silhouette.tube_sink import make_tube_sink
from warp_psdr.kernels.boundary.transport import Segment, make_source, make_transport
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.curve_kinds import CONES
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig

#: Sample slot of the root around a circle.
SLOT_ROOT = 2


@functools.cache
def make_tube_segment(config: PathConfig):
    """Return ``segment(scene, moving, point, aim, chance, share, direct) -> Segment``; chance: that of the item.

    ``aim.light`` is -1 where its direction is its own, as of the fraction ``share`` of the segments; ``direct`` as in
    ``path_space/secondary.py``. The scale is one over the density of what was drawn.
    """
    sees = make_sees(config, (CONES.number,))
    source_end = make_source_end(config)
    sensor_end = make_sensor_end(config)

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
        r.w = aim.w
        curvature = tube_curvature(point, r.w)
        if not in_front(point, r.w, curvature):
            return r
        r.boundary_normal = -point.out
        r.step = beside_tube(point, step_off_primitive(scene, scene.triangles[point.face]))
        r.x = point.x + r.step * point.out
        r.source = r.x
        end = source_end(scene, moving, r, point.face, point.x, aim, share < 1.0, direct)
        if end.valid == 0:
            return r
        density = wp.float32(0.0)
        if end.delta:
            density = (1.0 - share) * chance * drawn_touch_density(point, r.w)
        else:
            density = share * chance * own_touch_density(point, r.w, curvature)
            if end.towards > 0.0:
                # A segment that was aimed at a light ends where its point was seen from.
                seen = wp.float32(0.0)
                if aim.light >= 0:
                    seen = drawn_touch_density(point, r.w)
                else:
                    seen = seen_touch_density(point, end.y, end.segment.face2 < 0, r.w)
                density += (1.0 - share) * chance * end.towards * seen
        if not density > 0.0:
            return r
        r = with_density(sensor_end(scene, moving, end.segment, end.any_moves), end, aim, density)
        if r.valid == 1:
            beside = point.rim == 0 and is_beside_curve(scene, r, point.face, curvature)
            if beside or not sees(scene, r.x, r.w, r.t1):
                r.valid = 0
        return r

    return tube_segment


@functools.cache
def make_secondary_tube_kernel(
    config: PathConfig,
    role: str,
    camera_moves: bool,
    light_pose: bool,
    guided: bool = False,
    indirect: bool = False,
):
    """Return the kernel: one thread a sample (arguments as in ``silhouette/secondary.py``)."""
    evaluates = role in ("target", "ends")
    in_cube = guided or evaluates
    lit = bool(config.area or config.lights)
    light_aim = make_light_aim(config) if lit and not in_cube else None
    square_aim = make_square_aim(config) if lit and in_cube else None
    cube = make_cube(evaluates) if in_cube else None
    write_ends = make_ends(config.primitives) if role == "ends" else None
    segment_at = make_tube_segment(config)
    accumulate_tube = None if evaluates else make_tube_sink(role, config.primitives)
    accumulate_source = None if evaluates else make_source_sink(role, light_pose, config.primitives)
    source = make_source(config, True)
    source = make_indirect(source) if indirect else source
    transport = make_transport(config, role, camera_moves, source) if role != "ends" else None
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d
    note_place = make_note(config.noted)

    deliver = make_delivery(role, TubePoint, transport, accumulate_tube, accumulate_source, write_ends)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def secondary_tube(
        # Scene:
        scene: Scene,
        camera: Camera,
        found: TubeItems,
        moving: wp.array(dtype=wp.int32),
        guide: Guide,
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
        # The direction on rims and creases, theta and an angle or a height elsewhere.
        uvw = wp.vec3(u4[0], u4[1], u4[2])
        factor = wp.float32(1.0)
        if wp.static(in_cube):
            at = cube(guide, found.share, number, job.samples, u4)
            by_itself = at.own
            uvw = wp.vec3(wp.float32(at.u[1]), wp.float32(at.u[2]), wp.float32(at.u[1]))
            n, along, size = choose_slot(found.slots, by_itself, at.u[0])
            chance = wp.float32(found.cdf[n + 1] - found.cdf[n])
            factor = at.weight * chance / size
        else:
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
            touch = own_touch(scene, tri, item[0], item[1], along, uvw)
            aim.w = touch.w
        if wp.static(lit):
            if not by_itself:
                if wp.static(in_cube):
                    aim = square_aim(scene, tri.normal, at.u[1], at.u[2])
                else:
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
        if wp.static(evaluates):
            s.scale *= factor * wp.length(s.boundary_normal)
        else:
            s.scale /= wp.float32(job.samples)
        if wp.static(guided):
            s.scale *= factor
        tangent = point.along
        if wp.static(role == "samples"):
            tangent = tube_outline(point, s.w)
        deliver(scene, camera, sampler, number, job, point, tangent, s, target, image_out)

    return secondary_tube

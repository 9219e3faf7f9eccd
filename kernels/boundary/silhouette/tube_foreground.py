"""The foreground of curves with a radius: light that they send to path vertices past silhouettes, ends and creases.

A vertex of a curve slides along the ray that finds it, and the ray starts at x_1, whose surface it follows (form S,
``docs/theory/implicit.md#form-s``). The border of the visible part therefore moves against the curve: past a silhouette
the term L_- (x_b' - c_1') counts, where L_- is the light of the curve and c_1' the velocity at x_1. At a crease of a
joint the jump of L_- counts.

Derivation: ``docs/theory/implicit.md#silhouettes-of-grids``, ``#joints``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import Incident, difference, make_incident
from warp_psdr.kernels.boundary.film_edge import AHEAD, BESIDE
from warp_psdr.kernels.boundary.forwards import make_sees
from warp_psdr.kernels.boundary.path_space.secondary import moves
from warp_psdr.kernels.boundary.pull_record import record_pull
from warp_psdr.kernels.boundary.silhouette.aim import SLOT_DIRECTION, SLOT_SILHOUETTE
from warp_psdr.kernels.boundary.silhouette.ends import is_beside_curve, make_sensor_end
from warp_psdr.kernels.boundary.silhouette.touch import FRONT, MARGIN, WIDER
from warp_psdr.kernels.boundary.silhouette.tube_points import (
    LOOKS,
    PART_CREASE,
    TubeItems,
    TubePoint,
    ahead_of_tube,
    beside_tube,
    choose_tube,
    in_front,
    tube_coordinates,
    tube_curvature,
    tube_outline,
)
from warp_psdr.kernels.boundary.silhouette.tube_sampling import own_touch, own_touch_density
from warp_psdr.kernels.boundary.silhouette.tube_sink import make_tube_sink
from warp_psdr.kernels.boundary.transport import Segment, make_transport
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.curve_kinds import CONES
from warp_psdr.kernels.primitive.dispatch import make_adjoint_sink
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@functools.cache
def make_foreground_tube_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    visibility = visibility_of(config)
    sensor_end = make_sensor_end(config)
    sees = make_sees(config, (CONES.number,))
    accumulate_tube = make_tube_sink(role, config.primitives)
    accumulate_vertex = make_adjoint_sink(role, False, False, False, False, False, True, config.primitives)
    incident = make_incident(config)
    has_linear = CONES.number in config.primitives

    @wp.func
    def tube_source(
        scene: Scene, sampler: Sampler, s: Segment, k: wp.int32, max_depth: wp.int32, rr_depth: wp.int32
    ) -> Incident:
        """What arrives from below a silhouette; of a crease (``known``), less that from above, where x starts."""
        below = incident(scene, sampler, s.source, s.w, FAR, k, max_depth, rr_depth)
        if wp.static(has_linear):
            if s.known == 1:
                return difference(below, incident(scene, sampler, s.x, s.w, FAR, k, max_depth, rr_depth))
        return below

    transport = make_transport(config, role, camera_moves, tube_source, 2)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d
    note_place = make_note(config.noted)

    @wp.func
    def start_at(
        scene: Scene, point: TubePoint, out: wp.vec3, side: wp.float32, s: Segment, curvature: wp.float32
    ) -> tuple[wp.vec3, wp.bool]:
        """Where a ray along the segment starts that meets the curve beside the point, and whether there is one."""
        apart = beside_tube(point, BESIDE * s.step)
        k = wp.int32(0)
        while k < LOOKS:
            ahead = wp.max(AHEAD * s.step, MARGIN * ahead_of_tube(point, s.w, out, apart, curvature))
            ahead = wp.min(ahead, s.t1)
            o = point.x + (side * apart) * out - ahead * s.w
            hit = visibility.closest(scene, o, s.w, FAR)
            if hit.face == point.face and hit.t < 2.0 * ahead:
                return o, True
            apart = wp.min(WIDER * apart, 0.25 * point.f.r)
            k += 1
        return s.x, False

    @wp.func
    def accumulate(
        scene: Scene, target: wp.array(dtype=wp.float32), point: TubePoint, s: Segment, w: wp.float32
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = accumulate_tube(scene, target, point, w * s.boundary_normal)
        start = VertexAdjoint()
        start.x = -w * s.boundary_normal
        started = accumulate_vertex(scene, target, s.face1, s.u1, s.v1, start, False, s.x, s.w)
        return total + started.dot

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def foreground_tube(
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
        u = (wp.float64(number) + wp.float64(sample_1d(sampler, SLOT_SILHOUETTE))) / wp.float64(job.samples)
        n, along, chance = choose_tube(found, u)
        item = found.items[n]
        tri = scene.triangles[item[0]]
        touch = own_touch(scene, tri, item[0], item[1], along, wp.vec3(u4[0], u4[1], u4[2]))
        point = touch.point
        if point.valid == 0:
            return
        s = Segment()
        s.face2 = -1
        s.light = -1
        s.tau = 1.0
        s.w = touch.w
        curvature = tube_curvature(point, s.w)
        if not in_front(point, s.w, curvature):
            return
        s.step = step_off_primitive(scene, tri)
        out = point.out
        crease = point.part == PART_CREASE
        s.x = point.x + beside_tube(point, s.step) * out
        if crease:
            out = wp.normalize(wp.cross(point.along, s.w))
            s.x = point.x - FRONT * s.step * s.w
            s.known = 1
        s.boundary_normal = out
        # ---- Towards the sensor ----
        density = chance * own_touch_density(point, s.w, curvature)
        if not density > 0.0:
            return
        s = sensor_end(scene, moving, s, moves(scene, moving, point.face))
        if s.valid == 0 or not sees(scene, s.x, s.w, s.t1):
            return
        if point.rim == 0 and not crease and is_beside_curve(scene, s, point.face, curvature):
            return
        # ---- Towards the source ----
        below, met = start_at(scene, point, out, -1.0, s, curvature)
        s.source = below
        if wp.static(has_linear):
            if crease:
                above, also = start_at(scene, point, out, 1.0, s, curvature)
                s.x = above
                met = met and also
        if not met:
            return
        s.scale = 1.0 / (density * wp.float32(job.samples))
        uv = tube_coordinates(point)
        note_place(scene, NOTE_POINT, point.face, uv[0], uv[1], point.x, s.w, s.radiance)
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate(scene, target, point, s, 1.0)
        weight = transport(scene, camera, sampler, s, s.scale, rest, job, target, image_out)
        if wp.static(role != "forward"):
            if weight != 0.0:
                dropped = accumulate(scene, target, point, s, weight)
                if wp.static(role == "samples"):
                    tangent = tube_outline(point, s.w)
                    dropped += record_pull(target, number, point.x, tangent, weight * s.boundary_normal)
                if dropped != 0.0:
                    count_invalid(scene, sampler)

    return foreground_tube

"""The foreground of grids and curves: light that they send to path vertices past silhouettes, ends and creases.

A vertex of such a shape slides along the ray that finds it, and the ray starts at x_1, whose surface it follows (form
S, ``docs/theory/implicit.md#form-s``). The border of the visible part therefore moves against the shape: past a
silhouette the term L_- (x_b' - c_1') counts, where L_- is the light of the shape and c_1' the velocity at x_1. At
creases that are seen from the front the jump of L_- counts, because the normal jumps. A family of shapes gives points
and densities (``touch.py``); exact shapes, whose points are material, have no foreground.

Derivation: ``docs/theory/implicit.md#silhouettes-of-grids``, ``#joints``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import Incident, difference, make_incident
from warp_psdr.kernels.boundary.film_edge import AHEAD
from warp_psdr.kernels.boundary.forwards import make_sees
from warp_psdr.kernels.boundary.path_space.edge_segment import moves
from warp_psdr.kernels.boundary.pull_record import record_pull
from warp_psdr.kernels.boundary.silhouette.aim import SLOT_DIRECTION, SLOT_SILHOUETTE
from warp_psdr.kernels.boundary.silhouette.ends import make_beside_curve, make_sensor_end
from warp_psdr.kernels.boundary.silhouette.table import touch_of
from warp_psdr.kernels.boundary.silhouette.touch import MARGIN, WIDER, Passing
from warp_psdr.kernels.boundary.transport import Segment, make_transport
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.dispatch import make_adjoint_sink
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@functools.cache
def make_foreground_kernel(config: PathConfig, role: str, camera_moves: bool, family: str):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``); ``family``: a touch's."""
    touch = touch_of(family, config.surfaces.primitives, config.sampler)
    items, point_type, choice_of, draw, own_at = touch.items, touch.point, touch.choice, touch.draw, touch.own
    passing_at, ahead_of, meets, own_scale = touch.passing, touch.ahead, touch.meets, touch.own_scale
    outline_at, held_at = touch.outline, touch.held
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    sensor_end = make_sensor_end(config.rays, config.surfaces.primitives)
    sees = make_sees(config.rays, config.surfaces.primitives, touch.hides)
    is_beside_curve = make_beside_curve(config.surfaces.primitives)
    accumulate_point = touch.make_sink(role)
    accumulate_vertex = make_adjoint_sink(role, False, False, False, False, False, True, config.surfaces.primitives)
    incident = make_incident(config)
    numbers = make_sampler(config.sampler)
    sample_1d = numbers.sample_1d
    sample_4d = numbers.sample_4d
    note_place = make_note(config.noted)

    @wp.func
    def foreground_source(
        scene: Scene, sampler: Sampler, s: Segment, k: wp.int32, max_depth: wp.int32, rr_depth: wp.int32
    ) -> Incident:
        """What arrives from below a silhouette; of a crease (``known``), less that from above, where x starts."""
        below = incident(scene, sampler, s.source, s.w, FAR, k, max_depth, rr_depth)
        if wp.static(touch.creases):
            if s.known == 1:
                return difference(below, incident(scene, sampler, s.x, s.w, FAR, k, max_depth, rr_depth))
        return below

    transport = make_transport(config, role, camera_moves, foreground_source, 2)

    @wp.func
    def start_beside(
        scene: Scene, point: point_type, passing: Passing, side: wp.float32, s: Segment
    ) -> tuple[wp.vec3, wp.bool]:
        """Where a ray along the segment starts that meets the shape beside the point, and whether there is one."""
        apart = passing.apart
        k = wp.int32(0)
        while k < wp.static(touch.tries):
            ahead = wp.max(AHEAD * s.step, MARGIN * ahead_of(point, passing, s.w, apart))
            ahead = wp.min(ahead, s.t1)
            o = point.x + (side * apart) * passing.out - ahead * s.w
            hit = visibility.closest(scene, o, s.w, FAR)
            if meets(point, side > 0.0, hit.face, hit.t - ahead, ahead):
                return o, True
            apart = wp.min(WIDER * apart, passing.most)
            k += 1
        return s.x, False

    @wp.func
    def accumulate(
        scene: Scene, target: wp.array(dtype=wp.float32), point: point_type, s: Segment, w: wp.float32
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = accumulate_point(scene, target, point, w * s.boundary_normal)
        start = VertexAdjoint()
        start.x = -w * s.boundary_normal
        started = accumulate_vertex(scene, target, s.face1, s.u1, s.v1, start, False, s.x, s.w)
        return total + started.dot

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def foreground(
        # Scene:
        scene: Scene,
        camera: Camera,
        found: items,
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
        drawn = draw(found, True, u)
        point, w = own_at(scene, found, drawn, wp.vec3(u4[0], u4[1], u4[2]), choice_of(sampler, False))
        if point.valid == 0:
            return
        s = Segment()
        s.face2 = -1
        s.light = -1
        s.tau = 1.0
        s.w = w
        s.step = step_off_primitive(scene, scene.triangles[drawn.face])
        passing = passing_at(scene, point, s.w, s.step, FAR)
        if passing.shows == 0:
            return
        s.boundary_normal = passing.normal
        s.x = passing.start
        s.known = passing.crease
        # ---- Towards the sensor ----
        s.scale = own_scale(scene, point, drawn, s.w, passing.curvature, wp.float32(job.samples))
        if s.scale == 0.0:
            return
        if passing.crease == 0:
            s.scale = -s.scale  # the light of the shape is on the inner side
        s = sensor_end(scene, moving, s, moves(scene, moving, point.face))
        if s.valid == 0 or not sees(scene, s.x, s.w, s.t1):
            return
        if passing.curvature > 0.0 and is_beside_curve(scene, s, point.face, passing.curvature):
            return
        # ---- Towards the source ----
        below, met = start_beside(scene, point, passing, -1.0, s)
        s.source = below
        if wp.static(touch.creases):
            if passing.crease == 1:
                above, also = start_beside(scene, point, passing, 1.0, s)
                s.x = above
                met = met and also
        if not met:
            return
        held = held_at(scene, point)
        note_place(scene, NOTE_POINT, point.face, held[0], held[1], point.x, s.w, s.radiance)
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate(scene, target, point, s, 1.0)
        weight = transport(scene, camera, sampler, s, s.scale, rest, job, target, image_out)
        if wp.static(role != "forward"):
            if weight != 0.0:
                dropped = accumulate(scene, target, point, s, weight)
                if wp.static(role == "samples"):
                    tangent = outline_at(scene, point, s.w)
                    dropped += record_pull(target, number, point.x, tangent, weight * s.boundary_normal)
                if dropped != 0.0:
                    count_invalid(scene, sampler)

    return foreground

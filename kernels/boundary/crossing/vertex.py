"""Secondary boundary at curves of intersection: path vertices where one surface passes through the other.

Seen from x_1 along w, one side of the curve belongs to surface A and the other to B. Let out be the normal of the plane
of curve and w that points away from A's part. Then A adds L_A out . (x_b' - x_A'), and B the same with -out. x_k' is
the velocity of a path vertex of surface k at the curve: that of a material point, or on grids, whose vertices slide
along the segment, that of the point of x_1's surface from which the segment starts (form S). The sample draws one of
the two surfaces.

Derivation: ``docs/theory/implicit.md#curves-of-intersection``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.crossing.curve import (
    CrossingCurves,
    CrossingPoint,
    make_crossing_point,
    make_crossing_sink,
    make_shows,
    place_beside,
    sheet_in_front,
)
from warp_psdr.kernels.boundary.crossing.film import same_shape
from warp_psdr.kernels.boundary.depth import make_indirect
from warp_psdr.kernels.boundary.film_edge import AHEAD
from warp_psdr.kernels.boundary.forwards import make_sees
from warp_psdr.kernels.boundary.local_form import barycentrics_at
from warp_psdr.kernels.boundary.path_space.edge_segment import moves
from warp_psdr.kernels.boundary.path_space.secondary import make_source_sink
from warp_psdr.kernels.boundary.silhouette.aim import SLOT_DIRECTION, SLOT_SILHOUETTE
from warp_psdr.kernels.boundary.silhouette.dispatch import make_coordinates
from warp_psdr.kernels.boundary.silhouette.ends import make_sensor_end
from warp_psdr.kernels.boundary.silhouette.touch import FRONT
from warp_psdr.kernels.boundary.transport import Segment, make_source, make_transport
from warp_psdr.kernels.constants import FAR, FOUR_PI
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_EDGE, make_note
from warp_psdr.kernels.primitive.affine import from_axes, is_primitive
from warp_psdr.kernels.primitive.dispatch import has_sliding, slides_on
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sampling import square_to_sphere
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@functools.cache
def make_crossing_segment(primitives: tuple[int, ...]):
    """Return ``curve_segment(scene, point, u4, samples) -> (Segment, vec3)``: its end on A or B, and a direction.

    The vector leads from the curve into the part of that surface which is seen (``sheet_in_front``).
    """
    coordinates = make_coordinates(primitives)
    slides = has_sliding(primitives)
    shows = make_shows(primitives)

    @wp.func
    def held_at(scene: Scene, face: wp.int32, x: wp.vec3) -> wp.vec2:
        """What a path vertex would hold at a point of a face; on grids nobody asks."""
        tri = scene.triangles[face]
        if is_primitive(tri):
            if wp.static(slides):
                if slides_on(tri):
                    return wp.vec2(0.0, 0.0)
            if wp.static(coordinates is not None):
                return coordinates(tri, from_axes(tri, x - tri.normal))
        return barycentrics_at(tri, x)

    @wp.func
    def curve_segment(scene: Scene, point: CrossingPoint, u4: wp.vec4, samples: wp.float32) -> tuple[Segment, wp.vec3]:
        s = Segment()
        sheet = wp.vec3(0.0, 0.0, 0.0)
        s.light = -1
        s.tau = 1.0
        s.step = point.step
        s.w = square_to_sphere(wp.vec2(u4[0], u4[1]))
        if not shows(scene, point, s.w):
            return s, sheet
        of_b = u4[2] >= 0.5
        sheet = sheet_in_front(point.n_a, point.n_b, point.along, s.w)
        s.face2 = point.face_a
        if of_b:
            sheet = sheet_in_front(point.n_b, point.n_a, point.along, s.w)
            s.face2 = point.face_b
        s.boundary_normal = wp.cross(point.along, s.w)
        if wp.dot(s.boundary_normal, sheet) > 0.0:
            s.boundary_normal = -s.boundary_normal
        held = held_at(scene, s.face2, point.x)
        s.u2 = held[0]
        s.v2 = held[1]
        # Half of the samples end on A, half on B.
        s.scale = wp.static(2.0 * FOUR_PI) / (point.density * samples)
        s.valid = 1
        return s, sheet

    return curve_segment


@functools.cache
def make_vertex_crossing_kernel(config: PathConfig, role: str, camera_moves: bool, indirect: bool = False):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    crossing_point = make_crossing_point(config.surfaces.primitives)
    accumulate_crossing = make_crossing_sink(role, config.surfaces.primitives)
    accumulate_source = make_source_sink(role, False, config.surfaces.primitives)
    curve_segment = make_crossing_segment(config.surfaces.primitives)
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    sees = make_sees(config.rays, config.surfaces.primitives)
    sensor_end = make_sensor_end(config.rays, config.surfaces.primitives)
    source = make_source(config)
    source = make_indirect(source) if indirect else source
    transport = make_transport(config, role, camera_moves, source)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d
    note_place = make_note(config.noted)

    @wp.func
    def accumulate(
        scene: Scene, target: wp.array(dtype=wp.float32), point: CrossingPoint, s: Segment, w: wp.float32
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = accumulate_crossing(scene, target, point, w * s.boundary_normal)
        return accumulate_source(scene, target, s, w, total)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def vertex_crossing(
        # Scene:
        scene: Scene,
        camera: Camera,
        curves: CrossingCurves,
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
        point = crossing_point(scene, curves, u)
        if point.valid == 0:
            return
        s, sheet = curve_segment(scene, point, u4, wp.float32(job.samples))
        if s.valid == 0:
            return
        s.valid = 0
        s.x = point.x - (FRONT * s.step) * s.w
        s = sensor_end(scene, moving, s, moves(scene, moving, point.face_a) + moves(scene, moving, point.face_b))
        if s.valid == 0 or not sees(scene, s.x, s.w, s.t1):
            return
        s.source = place_beside(point, sheet) - wp.min(AHEAD * s.step, s.t1) * s.w
        if not same_shape(scene, visibility.closest(scene, s.source, s.w, FAR).face, s.face2):
            return
        note_place(scene, NOTE_EDGE, s.face2, s.u2, s.v2, point.x, s.w, wp.vec3(s.scale))
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate(scene, target, point, s, 1.0)
        weight = transport(scene, camera, sampler, s, s.scale, rest, job, target, image_out)
        if wp.static(role != "forward"):
            if weight != 0.0:
                if accumulate(scene, target, point, s, weight) != 0.0:
                    count_invalid(scene, sampler)

    return vertex_crossing

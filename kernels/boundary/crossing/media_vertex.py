"""Curves of intersection between rays in media: where exact shapes run through other surfaces and one of them moves.

As in ``vertex.py``, but x_1 is drawn along the ray from the curve and is a surface point or a volume vertex. The rays
that end on the visible part of a surface are a domain that ends at the curve, so all that comes along such a ray is
lost there, what is scattered in front of the curve included.

Derivation: ``docs/theory/media.md#shapes-without-triangles``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.crossing.curve import (
    CrossingCurves,
    CrossingPoint,
    make_crossing_point,
    make_crossing_sink,
    place_beside,
)
from warp_psdr.kernels.boundary.crossing.film import same_shape
from warp_psdr.kernels.boundary.crossing.vertex import make_crossing_segment
from warp_psdr.kernels.boundary.film_edge import AHEAD
from warp_psdr.kernels.boundary.path_space.media_intersection_curve import make_whole_ray
from warp_psdr.kernels.boundary.path_space.media_transport import make_media_transport
from warp_psdr.kernels.boundary.path_space.media_walk import make_leaves_first
from warp_psdr.kernels.boundary.path_space.secondary import make_source_sink
from warp_psdr.kernels.boundary.silhouette.aim import SLOT_DIRECTION, SLOT_SILHOUETTE
from warp_psdr.kernels.boundary.silhouette.touch import FRONT
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.medium.line import make_line
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import make_eye
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@functools.cache
def make_media_crossing_kernel(config: PathConfig, role: str, camera_moves: bool, grids_move: bool):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    crossing_point = make_crossing_point(config.surfaces.primitives)
    accumulate_crossing = make_crossing_sink(role, config.surfaces.primitives)
    accumulate_source = make_source_sink(role, False, config.surfaces.primitives)
    curve_segment = make_crossing_segment(config.surfaces.primitives)
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    leaves_first = make_leaves_first(config.surfaces.primitives)
    _line, medium_at = make_line(config)
    emissive = config.media is not None and config.media.emissive
    first_vertex, transport = make_media_transport(
        config, role, camera_moves, grids_move, make_whole_ray(config), ends=0 if emissive else 2
    )
    eye_of = make_eye(config.camera)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d

    @wp.func
    def accumulate(
        scene: Scene, target: wp.array(dtype=wp.float32), point: CrossingPoint, s: Segment, w: wp.float32
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = accumulate_crossing(scene, target, point, w * s.boundary_normal)
        return accumulate_source(scene, target, s, w, total)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def media_vertex_crossing(
        # Scene:
        scene: Scene,
        camera: Camera,
        curves: CrossingCurves,
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
        s.x = place_beside(point, sheet)
        if not same_shape(scene, visibility.closest(scene, s.x - AHEAD * s.step * s.w, s.w, FAR).face, s.face2):
            return
        start = s.x - FRONT * s.step * s.w
        eye = eye_of(scene, camera, start)
        medium = medium_at(scene, eye, start, camera.medium)
        first = first_vertex(scene, sampler, start, -s.w, eye, medium)
        s.t1 = wp.dot(s.x - first.x, s.w)
        if first.alive == 0 or s.t1 <= s.step:
            return
        s.source = s.x - (s.t1 - leaves_first(scene, first, s.w, s.t1)) * s.w
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate(scene, target, point, s, 1.0)
        dark = wp.vec3(0.0, 0.0, 0.0)
        weight, dropped = transport(
            scene, camera, sampler, s, first, first.medium, eye, s.scale, dark, rest, job, target, image_out
        )
        if wp.static(role == "reverse"):
            if weight != 0.0:
                dropped += accumulate(scene, target, point, s, weight)
                if dropped != 0.0:
                    count_invalid(scene, sampler)

    return media_vertex_crossing

"""Curves in media in which two surfaces A and B run through each other.

As in ``intersection_curve.py``, but x_1 is drawn along the ray from c on A and is a surface point or a volume vertex
(``media_walk.py``). The rays that end on the visible part of A are a domain that ends at the curve. So all that comes
along such a ray is lost there, what is scattered in front of c included.

Derivation: ``docs/theory/media.md#boundaries-in-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import Incident
from warp_psdr.kernels.boundary.local_form import Edges, edge_point
from warp_psdr.kernels.boundary.media_radiance import make_media_incident
from warp_psdr.kernels.boundary.path_space.intersection_curve import make_curve_draw
from warp_psdr.kernels.boundary.path_space.media_transport import make_media_transport
from warp_psdr.kernels.boundary.path_space.media_walk import make_leaves_first
from warp_psdr.kernels.boundary.path_space.secondary import make_segment_sink
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.medium.line import make_line
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import make_eye
from warp_psdr.kernels.step import leaving_step
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig

#: Sample slots of a point on the curve and of a direction; the walk has slots from 4 on (``media_walk.py``).
SLOT_POINT, SLOT_DIRECTION = 2, 3


@functools.cache
def make_whole_ray(config: PathConfig):
    """Return ``along(scene, sampler, segment, medium, k, max_depth, rr_depth) -> Incident``: all that comes to x_1."""
    media_incident = make_media_incident(config, whole=True)

    @wp.func
    def along(
        scene: Scene,
        sampler: Sampler,
        s: Segment,
        medium: wp.int32,
        k: wp.int32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> Incident:
        return media_incident(scene, sampler, medium, s.source, s.w, k, max_depth, rr_depth)

    return along


@functools.cache
def make_media_intersection_curve_kernel(config: PathConfig, role: str, camera_moves: bool, grids_move: bool):
    """Return the kernel: one thread a sample (arguments as in ``secondary.py``)."""
    curve_draw = make_curve_draw()
    accumulate_segment = make_segment_sink(role, False, config.surfaces.primitives)
    _line, medium_at = make_line(config)
    emissive = config.media is not None and config.media.emissive
    first_vertex, transport = make_media_transport(
        config, role, camera_moves, grids_move, make_whole_ray(config), ends=0 if emissive else 2
    )
    sample_4d = make_sampler(config.sampler).sample_4d
    eye_of = make_eye(config.camera)
    leaves_first = make_leaves_first(config.surfaces.primitives)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def media_intersection_curve(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        u4 = sample_4d(sampler, SLOT_POINT)
        point = edge_point(scene, edges, number, job.samples, u4[0])
        s = curve_draw(scene, edges, point, wp.where(u4[1] < 0.5, 0, 1), sample_4d(sampler, SLOT_DIRECTION))
        if s.valid == 0:
            return
        start = s.source
        eye = eye_of(scene, camera, start)
        medium = medium_at(scene, eye, start, camera.medium)
        first = first_vertex(scene, sampler, start, -s.w, eye, medium)
        s.t1 = wp.dot(s.x - first.x, s.w)
        if first.alive == 0 or s.t1 <= leaving_step(scene, s.face2):
            return
        s.source = s.x - (s.t1 - leaves_first(scene, first, s.w, s.t1)) * s.w
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate_segment(scene, target, edges, point, s, 1.0)
        dark = wp.vec3(0.0, 0.0, 0.0)
        scale = s.scale / wp.float32(job.samples)
        weight, dropped = transport(
            scene, camera, sampler, s, first, first.medium, eye, scale, dark, rest, job, target, image_out
        )
        if wp.static(role == "reverse"):
            if weight != 0.0:
                dropped += accumulate_segment(scene, target, edges, point, s, weight)
                if dropped != 0.0:
                    count_invalid(scene, sampler)

    return media_intersection_curve

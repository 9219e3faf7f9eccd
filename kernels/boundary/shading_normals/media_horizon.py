"""The horizon of a triangle with interpolated normals that scatters what arrives through media.

As ``geometric_horizon.py``; x_2 is the first surface that is there, and what the whole ray from there brings counts.

Derivation: ``docs/theory/media.md#interpolated-normals-in-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import Incident, scaled
from warp_psdr.kernels.boundary.media_radiance import make_media_incident
from warp_psdr.kernels.boundary.path_space.media_transport import make_media_transport
from warp_psdr.kernels.boundary.path_space.media_walk import MediaWalk
from warp_psdr.kernels.boundary.shading_normals.geometric_horizon import make_horizon_segment, make_horizon_sink
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.medium.line import make_line
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import Sampler, sampler_at
from warp_psdr.kernels.sensor.camera import make_eye
from warp_psdr.kernels.step import leaving_step
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_media_side(config: PathConfig):
    """Return ``side(scene, sampler, segment, medium, k, max_depth, rr_depth) -> Incident``: L, negative below."""
    incident = make_media_incident(config, True)

    @wp.func
    def side(
        scene: Scene,
        sampler: Sampler,
        s: Segment,
        medium: wp.int32,
        k: wp.int32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> Incident:
        found = incident(scene, sampler, medium, s.source, s.w, k, max_depth, rr_depth)
        return scaled(found, wp.vec3(0.0, 0.0, 0.0), s.radiance[0])

    return side


@functools.cache
def make_media_horizon_kernel(config: PathConfig, role: str, camera_moves: bool, grids_move: bool):
    """Return the kernel: one thread a sample (arguments as in ``geometric_horizon.py``).

    ``grids_move``: grids of media have derivatives.
    """
    horizon_segment = make_horizon_segment(config)
    accumulate_geometric_horizon = make_horizon_sink(config.surfaces, role)
    line, medium_at = make_line(config)
    eye_of = make_eye(config.camera)
    _first_vertex, transport = make_media_transport(
        config, role, camera_moves, grids_move, make_media_side(config), ends=2
    )

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def media_horizon(
        # Scene:
        scene: Scene,
        camera: Camera,
        face_cdf: wp.array(dtype=wp.float32),
        faces: wp.array(dtype=wp.int32),
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        s, normal, scale = horizon_segment(scene, face_cdf, faces, number, job.samples, sampler)
        if s.valid == 0:
            return
        eye = eye_of(scene, camera, s.source)
        medium = medium_at(scene, eye, s.source, camera.medium)
        ahead = line(scene, sampler, -1, s.source, s.w, FAR, medium, 1)
        if ahead.lost:
            return
        s.face2 = ahead.face
        if ahead.face >= 0:
            if ahead.t <= leaving_step(scene, s.face1):
                return
            s.u2 = ahead.u
            s.v2 = ahead.v
            s.boundary_normal = normal / ahead.t
        first = MediaWalk()
        first.alive = 1
        first.face = s.face1
        first.u = s.u1
        first.v = s.v1
        first.x = s.x
        first.to = s.w
        first.medium = medium
        first.weight = wp.vec3(1.0, 1.0, 1.0)
        first.near_face = -1
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate_geometric_horizon(scene, target, s, 1.0)
        nothing = wp.vec3(0.0, 0.0, 0.0)
        weight, dropped = transport(
            scene, camera, sampler, s, first, medium, eye, scale, nothing, rest, job, target, image_out
        )
        if wp.static(role == "reverse"):
            if weight != 0.0:
                dropped += accumulate_geometric_horizon(scene, target, s, weight)
                if dropped != 0.0:
                    count_invalid(scene, sampler)

    return media_horizon

"""The terminator of interpolated normals as path vertices in media see it, on surfaces or in the medium.

As ``indirect_terminator.py``, but the vertex x_1 that sees x is drawn along a ray from x.

Derivation: ``docs/theory/media.md#interpolated-normals-in-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import Incident, difference
from warp_psdr.kernels.boundary.media_radiance import make_media_incident
from warp_psdr.kernels.boundary.path_space.media_transport import make_media_transport
from warp_psdr.kernels.boundary.shading_normals.indirect_terminator import (
    AHEAD,
    TILT,
    make_turned_segment,
    make_turned_sink,
)
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.medium.line import make_line
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import Sampler, sampler_at
from warp_psdr.kernels.sensor.camera import make_eye
from warp_psdr.kernels.step import leaving_step, passing_step
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_media_jump(config: PathConfig):
    """Return ``jump(scene, sampler, segment, medium, k, max_depth, rr_depth) -> Incident``: [L] just in front of x."""
    incident = make_media_incident(config)

    @wp.func
    def jump(
        scene: Scene,
        sampler: Sampler,
        s: Segment,
        medium: wp.int32,
        k: wp.int32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> Incident:
        n = -s.t1 * s.boundary_normal
        ahead = wp.min(AHEAD * passing_step(scene, s.face2), 0.5 * s.t1)
        d = wp.normalize(s.w - TILT * n)
        here = incident(scene, sampler, medium, s.x - ahead * d, d, k, max_depth, rr_depth)
        d = wp.normalize(s.w + TILT * n)
        there = incident(scene, sampler, medium, s.x - ahead * d, d, k, max_depth, rr_depth)
        return difference(here, there)

    return jump


@functools.cache
def make_media_indirect_terminator_kernel(config: PathConfig, role: str, camera_moves: bool, grids_move: bool):
    """Return the kernel: one thread a sample (arguments as in ``indirect_terminator.py``).

    ``grids_move``: grids of media have derivatives.
    """
    turned_segment = make_turned_segment(config)
    accumulate_terminator = make_turned_sink(config.surfaces, role)
    _line, medium_at = make_line(config)
    eye_of = make_eye(config.camera)
    first_vertex, transport = make_media_transport(
        config, role, camera_moves, grids_move, make_media_jump(config), least=2, ends=3
    )

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def media_indirect_terminator(
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
        s, start, scale = turned_segment(scene, face_cdf, faces, number, job.samples, sampler)
        if s.valid == 0:
            return
        eye = eye_of(scene, camera, start)
        medium = medium_at(scene, eye, start, camera.medium)
        first = first_vertex(scene, sampler, start, -s.w, eye, medium)
        s.t1 = wp.dot(s.x - first.x, s.w)
        if first.alive == 0 or s.t1 <= leaving_step(scene, s.face2):
            return
        first.weight = wp.cw_mul(first.weight, first.transmittance)
        s.boundary_normal = (1.0 / s.t1) * s.boundary_normal
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate_terminator(scene, target, s, 1.0)
        nothing = wp.vec3(0.0, 0.0, 0.0)
        weight, dropped = transport(
            scene, camera, sampler, s, first, medium, eye, scale, nothing, rest, job, target, image_out
        )
        if wp.static(role == "reverse"):
            if weight != 0.0:
                dropped += accumulate_terminator(scene, target, s, weight)
                if dropped != 0.0:
                    count_invalid(scene, sampler)

    return media_indirect_terminator

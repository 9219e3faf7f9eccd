"""Steps of textures that slide over a surface in media.

As in ``sliding_steps.py``, but x_1 is drawn along the ray from the line and is a surface point or a volume vertex
(``media_walk.py``). Only what the surface sends jumps, so its light has the transmittance up to x_1, and what is
scattered on the way does not count.

Derivation: ``docs/theory/boundary.md#steps-of-textures``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.detector import Incident, difference
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.boundary.media_radiance import make_media_incident
from warp_psdr.kernels.boundary.path_space.media_transport import make_media_transport
from warp_psdr.kernels.boundary.path_space.sliding_steps import beside_step, make_slide_draw
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.medium.line import make_line
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import Sampler, sampler_at
from warp_psdr.kernels.sensor.camera import make_eye
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.texture.steps import make_slide_sink
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_media_step_jump(config: PathConfig):
    """Return ``jump(scene, sampler, segment, medium, k, max_depth, rr_depth) -> Incident``: L_+ - L_-."""
    media_incident = make_media_incident(config, whole=True)

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
        aside = s.step * s.boundary_normal
        above = media_incident(scene, sampler, medium, s.source + aside, s.w, k, max_depth, rr_depth)
        below = media_incident(scene, sampler, medium, s.source - aside, s.w, k, max_depth, rr_depth)
        return difference(above, below)

    return jump


@functools.cache
def make_media_sliding_steps_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    _line, medium_at = make_line(config)
    first_vertex, transport = make_media_transport(
        config, role, camera_moves, False, make_media_step_jump(config), ends=2
    )
    accumulate_slide = make_slide_sink(role)
    draw_slide = make_slide_draw(config.sampler)
    eye_of = make_eye(config.camera)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def media_sliding_steps(
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
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        s, edge, start = draw_slide(scene, edges, sampler, number, job.samples)
        cosine = s.t1
        if cosine <= 0.0:
            return
        eye = eye_of(scene, camera, start)
        medium = medium_at(scene, eye, start, camera.medium)
        first = first_vertex(scene, sampler, start, -s.w, eye, medium)
        if first.alive == 0:
            return
        first.weight = wp.cw_mul(first.weight, first.transmittance)
        s.t1 = wp.dot(s.x - first.x, s.w)
        s.source = beside_step(scene, edges, edge, s, cosine)
        tri = scene.triangles[s.face2]
        texture = edges.ends[edge, 1]
        axis = edges.twins[edge, 1]
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate_slide(scene, target, texture, axis, tri, s.u2, s.v2, 1.0)
        dark = wp.vec3(0.0, 0.0, 0.0)
        weight, dropped = transport(
            scene, camera, sampler, s, first, medium, eye, s.scale, dark, rest, job, target, image_out
        )
        if wp.static(role == "reverse"):
            if weight != 0.0:
                dropped += accumulate_slide(scene, target, texture, axis, tri, s.u2, s.v2, weight)
                if dropped != 0.0:
                    count_invalid(scene, sampler)

    return media_sliding_steps

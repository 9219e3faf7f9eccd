"""Interior term in scenes with media by textbook path replay [VSJ21] (``textbook.py``), for comparison.

A first pass adds up the radiance of all steps of a path. The second pass traces the path again and subtracts what each
step adds; the remainder after step n, over the throughput there, is L_{n+1}. If a component of the throughput is 0, the
quotient is lost. Flights do not collide where there is no density. Nothing moves.

Derivation: ``docs/theory/media.md#derivatives``.
"""

import functools

import warp as wp

from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.media_sweep import make_media_sweep
from warp_psdr.kernels.interior.textbook import safe_quotient
from warp_psdr.kernels.invalid import finite, make_derivative_of_sample, on_channel, vanishes
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_camera_start
from warp_psdr.kernels.path_media import make_media_step, media_path_from, radiance_of_step
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_media_textbook_kernel(config: PathConfig, wanted: GradientRequest, role: str):
    """Return the kernel; arguments as ``make_media_replay_kernel``'s."""
    start = make_camera_start(config)
    media_step = make_media_step(config, True)
    media_sweep = make_media_sweep(config, wanted, role)
    channels = 3 if role == "forward" else 1
    derivative_of_sample = make_derivative_of_sample(role)
    sample_weight = make_sample_weight(role)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def media_textbook(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        pixel = pixel_of(job, camera, wp.tid())
        delta = sample_weight(job, pixel)
        if vanishes(delta):
            return
        derivative = wp.vec3d()  # in double precision, as the image
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            started, _sample = start(scene, camera, pixel.px, pixel.py, sampler)
            remaining = wp.vec3(0.0, 0.0, 0.0)
            of_sample = wp.vec3(0.0, 0.0, 0.0)
            # Both passes in one loop, so that the step is compiled once.
            for replays in range(2):
                state = media_path_from(started, camera.medium)
                while state.path.alive == 1:
                    vertex, state = media_step(scene, sampler, state, job.max_depth, job.rr_depth)
                    if replays == 0:
                        remaining += radiance_of_step(vertex)
                    else:
                        remaining -= radiance_of_step(vertex)
                        behind = wp.vec3(0.0, 0.0, 0.0)
                        if state.path.alive == 1:
                            behind = safe_quotient(remaining, state.path.throughput)
                        for channel in range(wp.static(channels)):
                            weight = delta
                            if wp.static(role == "forward"):
                                weight = wp.vec3(0.0, 0.0, 0.0)
                                weight[channel] = delta[channel]
                            _here, dot = media_sweep(scene, target, sampler, vertex, weight, behind)
                            of_sample += on_channel(channel, dot)
            derivative += derivative_of_sample(scene, sampler, finite(remaining), of_sample)
        if wp.static(role == "forward"):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return media_textbook

"""Interior term in scenes with media, by record and sweep as on surfaces (``replay.py``), in both modes.

Forward mode sweeps once for each colour channel. A factor that is exactly zero keeps its derivative, the density and
the albedo of a medium included.

Derivation: ``docs/theory/media.md#derivatives``.
"""

import functools

import warp as wp

from warp_psdr.kernels.interior.differential_ratio_tracking import Stretch, make_ratio_branch
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.media_sweep import explores_density, make_media_sweep
from warp_psdr.kernels.invalid import finite, make_derivative_of_sample, on_channel, vanishes
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.medium.passage import MOST_INTERFACES, steps_kept
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_camera_start
from warp_psdr.kernels.path_media import MediaState, MediaVertex, make_media_step, media_path_from, radiance_of_step
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_media_replay_kernel(
    config: PathConfig, wanted: GradientRequest, role: str, block: int, longest: int, ratio: bool = False
):
    """Return the kernel.

    Args:
        config: what the scene needs.
        wanted: what is differentiated; nothing moves.
        role: "reverse" or "forward".
        block: the number of vertices kept at a time; interfaces come on top.
        longest: most vertices of a path; the surfaces that it passes without a change of direction come on top.
        ratio: in-scattering in grids is by differential ratio tracking, too; the density is differentiated.
    """
    start = make_camera_start(config)
    media_step = make_media_step(config, True, explores_density(wanted), not ratio)
    media_sweep = make_media_sweep(config, wanted, role, ratio)
    consider_stretch, from_stretch = make_ratio_branch(config, wanted, role) if ratio else (None, None)
    channels = 3 if role == "forward" else 1
    derivative_of_sample = make_derivative_of_sample(role)
    sample_weight = make_sample_weight(role)
    room = steps_kept(block)
    blocks = -(-(longest + MOST_INTERFACES + 1) // room)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def media_replay(
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
        record = wp.zeros(shape=(wp.static(room),), dtype=MediaVertex)
        states = wp.zeros(shape=(wp.static(blocks),), dtype=MediaState)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            started, _sample = start(scene, camera, pixel.px, pixel.py, sampler)
            state = media_path_from(started, camera.medium)
            radiance = wp.vec3(0.0, 0.0, 0.0)
            remaining = wp.vec3(0.0, 0.0, 0.0)
            of_sample = wp.vec3(0.0, 0.0, 0.0)
            # Blocks are traced from the first to the last, and swept, and traced again, from the last to the first. One
            # loop, so that the step and the sweep are compiled once.
            b = wp.int32(0)
            tracing = wp.bool(True)
            if wp.static(ratio):
                stretch = Stretch()
            while b >= 0:
                states[b] = state
                count = wp.int32(0)
                while state.path.alive == 1 and count < wp.static(room):
                    before = state
                    vertex, state = media_step(scene, sampler, state, job.max_depth, job.rr_depth)
                    record[count] = vertex
                    count += 1
                    if tracing:
                        if wp.static(ratio):
                            stretch = consider_stretch(scene, sampler, stretch, before, vertex, delta, job.max_depth)
                        radiance += radiance_of_step(vertex)
                if tracing and state.path.alive == 1:
                    b += 1
                else:
                    tracing = False
                    for n in range(count):
                        kept = record[count - 1 - n]
                        behind = remaining
                        for channel in range(wp.static(channels)):
                            weight = delta
                            if wp.static(role == "forward"):
                                weight = wp.vec3(0.0, 0.0, 0.0)
                                weight[channel] = delta[channel]
                            here, dot = media_sweep(scene, target, sampler, kept, weight, behind)
                            remaining = here
                            of_sample += on_channel(channel, dot)
                    b -= 1
                    if b >= 0:
                        state = states[b]
            if wp.static(ratio):
                if stretch.total > 0.0:
                    of_sample += from_stretch(scene, target, sampler, stretch, delta, job.max_depth, job.rr_depth)
            derivative += derivative_of_sample(scene, sampler, finite(radiance) and finite(remaining), of_sample)
        if wp.static(role == "forward"):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return media_replay

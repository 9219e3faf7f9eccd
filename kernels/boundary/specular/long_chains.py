"""How much of an image lies behind more mirrors and glass in a row than a line search follows.

Derivation: ``docs/theory/specular.md#paths-of-any-length``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.specular.media_line_search import MEDIA_WINDOW
from warp_psdr.kernels.boundary.specular.specular_chain import MAX_CHAIN, MAX_WINDOW
from warp_psdr.kernels.constants import LOBE_NULL, LOBE_SMOOTH
from warp_psdr.kernels.invalid import finite
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.medium.null_surface import make_null_surface
from warp_psdr.kernels.path import make_camera_start, make_path_step
from warp_psdr.kernels.path_media import make_media_step, media_path_from, radiance_of_step
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_long_chains_kernel(config: PathConfig):
    """Return the kernel that sums the radiance of each path, and the part of it that lies behind long chains.

    One thread a path; sums go over channels, too. A chain, or what it is pulled back along, may be too long.
    """
    start = make_camera_start(config)
    if config.media is not None:
        return make_long_media_chains_kernel(config)
    path_step = make_path_step(config, False)

    @wp.kernel(module="unique", enable_backward=False)
    def long_chains(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: SampleJob,
        # Out:
        found_out: wp.array(dtype=wp.vec2),
    ):
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        pixel = number % (camera.crop_width * camera.crop_height)
        state, _sample = start(scene, camera, pixel % camera.crop_width, pixel // camera.crop_width, sampler)
        found = wp.vec2(0.0, 0.0)
        chain = wp.int32(0)
        window = wp.int32(0)
        attached = wp.int32(1)
        beyond = wp.float32(0.0)
        while state.alive == 1:
            vertex, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
            value = wp.cw_mul(vertex.throughput, vertex.direct)
            if finite(value):
                found += (value[0] + value[1] + value[2]) * wp.vec2(1.0, beyond)
            specular = vertex.lobe > LOBE_SMOOTH
            chain = wp.where(specular, chain + 1, 0)
            window = wp.where(attached == 0 and not specular, 2, window + 1)
            attached = wp.where(specular, 1, 0)
            if chain == MAX_CHAIN or (window > MAX_WINDOW and not specular):
                beyond = wp.float32(1.0)
        found_out[wp.tid()] = found

    return long_chains


@functools.cache
def make_long_media_chains_kernel(config: PathConfig) -> wp.Kernel:
    """Return the kernel in media: surfaces that are not there are no vertices, points that scatter are."""
    start = make_camera_start(config)
    media_step = make_media_step(config, False)
    is_interface, _past = make_null_surface(config.surfaces, config.lights)

    @wp.kernel(module="unique", enable_backward=False)
    def long_chains_in_media(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: SampleJob,
        # Out:
        found_out: wp.array(dtype=wp.vec2),
    ):
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        pixel = number % (camera.crop_width * camera.crop_height)
        started, _sample = start(scene, camera, pixel % camera.crop_width, pixel // camera.crop_width, sampler)
        state = media_path_from(started, camera.medium)
        found = wp.vec2(0.0, 0.0)
        chain = wp.int32(0)
        window = wp.int32(0)
        attached = wp.int32(1)
        turned = wp.int32(0)  # 1: a mirror or glass came before
        beyond = wp.float32(0.0)
        while state.path.alive == 1:
            step, state = media_step(scene, sampler, state, job.max_depth, job.rr_depth)
            value = radiance_of_step(step)
            if finite(value):
                found += (value[0] + value[1] + value[2]) * wp.vec2(1.0, beyond)
            vertex = step.surface
            passes = not step.collides and vertex.lobe == LOBE_NULL and is_interface(scene, vertex.face)
            if not passes:
                specular = vertex.lobe > LOBE_SMOOTH
                chain = wp.where(specular, chain + 1, 0)
                window = wp.where(attached == 0 and not specular and not step.collides, 1, window + 1)
                attached = wp.where(specular, 1, 0)
                if specular:
                    turned = 1
                if chain == MAX_CHAIN or (window > MEDIA_WINDOW and not specular and turned == 1):
                    beyond = wp.float32(1.0)
        found_out[wp.tid()] = found

    return long_chains_in_media

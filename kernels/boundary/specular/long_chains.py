"""How much of an image lies behind more mirrors and glass in a row than a line search follows.

Derivation: ``docs/theory/specular.md#paths-of-any-length``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.specular.specular_chain import MAX_CHAIN, MAX_WINDOW
from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.invalid import finite
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.path import make_camera_start, make_path_step
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_long_chains_kernel(config: PathConfig):
    """Return the kernel that sums the radiance of each path, and the part of it that lies behind long chains.

    One thread a path; sums go over channels, too. A chain, or what it is pulled back along, may be too long.
    """
    start = make_camera_start(config)
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

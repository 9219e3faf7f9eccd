"""How much of an image lies behind more mirrors and glass in a row than a line search follows.

Derivation: ``docs/theory/specular.md#paths-of-any-length``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.specular.specular_chain import MAX_CHAIN
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

    One thread a path; sums go over channels, too. A run of vertices without two in a row that smooth lobes join holds
    every chain, and what it is pulled back along.
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
        run = wp.int32(0)
        attached = wp.int32(1)
        beyond = wp.float32(0.0)
        while state.alive == 1:
            vertex, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
            value = wp.cw_mul(vertex.throughput, vertex.direct)
            if finite(value):
                found += (value[0] + value[1] + value[2]) * wp.vec2(1.0, beyond)
            run += 1
            if attached == 0 and vertex.lobe <= LOBE_SMOOTH:
                run = wp.int32(1)
            attached = wp.where(vertex.lobe > LOBE_SMOOTH, 1, 0)
            if run == MAX_CHAIN:
                beyond = wp.float32(1.0)
        found_out[wp.tid()] = found

    return long_chains

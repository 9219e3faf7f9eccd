"""The primal pass: images by the path loop of ``path.py``; ``splat.py`` has that of wide pixel filters."""

import functools

import warp as wp

from warp_psdr.kernels.camera import CameraSample
from warp_psdr.kernels.camera_rays import make_camera_paths
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.path import PathConfig, PathState
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.structs import Camera, Scene


@functools.cache
def make_primal_kernel(config: PathConfig):
    """Return the primal kernel: one thread a pixel, all its samples in order."""
    lanes, starts, path_step = make_camera_paths(config, False)

    @wp.kernel(module="unique", enable_backward=False)
    def primal(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        pixels: wp.array(dtype=wp.int32),
        first_pixel: wp.int32,
        first_sample: wp.int32,
        samples: wp.int32,
        scale: wp.float32,
        seed: wp.uint32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        # Out:
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        pixel = pixels[first_pixel + wp.tid()]
        px = pixel % camera.crop_width
        py = pixel // camera.crop_width
        # In double precision: a float32 sum stands still after 2^24 equal terms.
        total = wp.vec3d()
        starting = wp.zeros(shape=(wp.static(lanes),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(lanes),), dtype=CameraSample)
        for i in range(samples):
            sampler = sampler_at(pixel, first_sample + i, seed)
            radiance = wp.vec3(0.0, 0.0, 0.0)
            state, _sample = starts(scene, camera, px, py, sampler, i, samples, starting, cameras)
            while state.alive == 1:
                vertex, state = path_step(scene, sampler, state, max_depth, rr_depth)
                radiance += wp.cw_mul(vertex.throughput, vertex.direct)
            if finite(radiance):
                total += wp.vec3d(radiance)
            else:
                count_invalid(scene, sampler)
        image_out[py, px] = image_out[py, px] + wp.vec3(wp.float64(scale) * total)

    return primal

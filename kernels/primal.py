"""The primal pass: images by the path loop of ``path.py``; ``splat.py`` has that of wide pixel filters."""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.camera import CameraSample
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.lanes import ROWS
from warp_psdr.kernels.path import make_camera_start, make_path_step
from warp_psdr.kernels.path_lanes import make_lane_paths, side_by_side
from warp_psdr.kernels.rng import Sampler, branch_of, sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@wp.struct
class CameraPath:
    """What became of a sample: where it lies on the film, and the radiance that it found."""

    sample: CameraSample
    radiance: wp.vec3


class CameraPaths(NamedTuple):
    """How the samples of a pixel are traced: ``width`` at a time.

    ``trace(scene, camera, px, py, sampler, count, max_depth, rr_depth, rows, paths_out)`` traces the sampler's sample
    and those behind it, ``count`` in all, with an array of ``size`` uint32 to work on, into an array of ``width``
    ``CameraPath``.
    """

    width: int
    size: int
    trace: wp.Function


@functools.cache
def make_camera_paths(config: PathConfig, filter_kind: int | None = None) -> CameraPaths:
    """Make the function for what a scene needs; ``filter_kind`` as ``make_camera_start``'s."""
    if side_by_side(config):
        lanes = make_lane_paths(config, False, filter_kind=filter_kind)

        @wp.func
        def trace_lanes(
            scene: Scene,
            camera: Camera,
            px: wp.int32,
            py: wp.int32,
            sampler: Sampler,
            count: wp.int32,
            max_depth: wp.int32,
            rr_depth: wp.int32,
            rows: ROWS,
            paths_out: wp.array(dtype=CameraPath),
        ):
            lanes.start(scene, camera, px, py, sampler, count, 0, rows)
            depth = wp.int32(0)
            alive = wp.int32(count)
            while alive > 0:
                alive = lanes.step(scene, sampler, depth, max_depth, rr_depth, rows)
                depth += 1
            for j in range(count):
                path = CameraPath()
                path.sample = lanes.camera(rows, j)
                path.radiance = lanes.gathered(rows, j).radiance
                paths_out[j] = path

        return CameraPaths(lanes.width, lanes.size, trace_lanes)

    start = make_camera_start(config, filter_kind)
    path_step = make_path_step(config, False)

    @wp.func
    def trace(
        scene: Scene,
        camera: Camera,
        px: wp.int32,
        py: wp.int32,
        sampler: Sampler,
        count: wp.int32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        rows: ROWS,
        paths_out: wp.array(dtype=CameraPath),
    ):
        path = CameraPath()
        state, sample = start(scene, camera, px, py, sampler)
        path.sample = sample
        while state.alive == 1:
            vertex, state = path_step(scene, sampler, state, max_depth, rr_depth)
            path.radiance += wp.cw_mul(vertex.throughput, vertex.direct)
        paths_out[0] = path

    return CameraPaths(1, 1, trace)


@functools.cache
def make_primal_kernel(config: PathConfig):
    """Return the primal kernel: one thread a pixel, all its samples in order."""
    paths = make_camera_paths(config)
    trace = paths.trace

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
        rows = wp.zeros(shape=(wp.static(paths.size),), dtype=wp.uint32)
        found = wp.zeros(shape=(wp.static(paths.width),), dtype=CameraPath)
        done = wp.int32(0)
        while done < samples:
            count = wp.min(samples - done, wp.static(paths.width))
            sampler = sampler_at(pixel, first_sample + done, seed)
            trace(scene, camera, px, py, sampler, count, max_depth, rr_depth, rows, found)
            for j in range(count):
                if finite(found[j].radiance):
                    total += wp.vec3d(found[j].radiance)
                else:
                    count_invalid(scene, branch_of(sampler, wp.int32(sampler.index) + j))
            done += count
        image_out[py, px] = image_out[py, px] + wp.vec3(wp.float64(scale) * total)

    return primal

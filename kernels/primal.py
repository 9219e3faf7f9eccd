"""Images by the path loop of ``path.py``; ``splat.py`` draws images with wide pixel filters."""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bidirectional_path import make_camera_walk, make_walk_from
from warp_psdr.kernels.camera_rays import (
    Bundle,
    column_of,
    make_bundled_starts,
    make_camera_paths,
    make_pixel_bundle,
    rays_together,
    row_of,
    sampler_in,
)
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.jobs import PixelJob
from warp_psdr.kernels.lanes.path_lanes import make_lane_paths, side_by_side
from warp_psdr.kernels.lanes.waiting_lanes import CameraPath, make_trace_waiting
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_camera_start
from warp_psdr.kernels.path_media import make_media_step, media_path_from, radiance_of_step
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathState


class CameraPaths(NamedTuple):
    """How samples are traced: up to ``width`` at a time, which are those of one pixel unless ``grouped``.

    ``trace(scene, camera, pixels, bundle, max_depth, rr_depth, paths_out)`` traces the samples of a bundle into an
    array of ``width`` ``CameraPath``.
    """

    width: int
    grouped: bool
    trace: wp.Function


@functools.cache
def make_image_paths(config: PathConfig, filter_kind: int | None = None) -> CameraPaths:
    """Make the function for what a scene needs; ``filter_kind`` as ``make_camera_start``'s."""
    if side_by_side(config):
        paths = make_lane_paths(config, False, filter_kind=filter_kind)
        together, trace_waiting = make_trace_waiting(config.scatter, paths)
        return CameraPaths(together, True, trace_waiting)
    if config.media is not None:
        return _make_media_paths(config, filter_kind)
    if config.connections:
        return _make_weighted_paths(config, filter_kind)
    width, starts, path_step = make_camera_paths(config, False, filter_kind=filter_kind)

    @wp.func
    def trace(
        scene: Scene,
        camera: Camera,
        pixels: wp.array(dtype=wp.int32),
        bundle: Bundle,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        paths_out: wp.array(dtype=CameraPath),
    ):
        starting = wp.zeros(shape=(wp.static(width),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(width),), dtype=CameraSample)
        for j in range(bundle.samples):
            sampler = sampler_in(pixels, bundle, j)
            px = column_of(bundle, sampler)
            py = row_of(bundle, sampler)
            path = CameraPath()
            state, sample = starts(scene, camera, px, py, sampler, j, bundle.samples, starting, cameras)
            path.sample = sample
            while state.alive == 1:
                vertex, state = path_step(scene, sampler, state, max_depth, rr_depth)
                path.radiance += wp.cw_mul(vertex.throughput, vertex.direct)
            paths_out[j] = path

    return CameraPaths(width, False, trace)


def _make_media_paths(config: PathConfig, filter_kind: int | None) -> CameraPaths:
    """The same in a scene with media."""
    start = make_camera_start(config, filter_kind)
    media_step = make_media_step(config, False)

    @wp.func
    def trace_media(
        scene: Scene,
        camera: Camera,
        pixels: wp.array(dtype=wp.int32),
        bundle: Bundle,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        paths_out: wp.array(dtype=CameraPath),
    ):
        for j in range(bundle.samples):
            sampler = sampler_in(pixels, bundle, j)
            path = CameraPath()
            started, sample = start(scene, camera, column_of(bundle, sampler), row_of(bundle, sampler), sampler)
            state = media_path_from(started, camera.medium)
            path.sample = sample
            while state.path.alive == 1:
                vertex, state = media_step(scene, sampler, state, max_depth, rr_depth)
                path.radiance += radiance_of_step(vertex)
            paths_out[j] = path

    return CameraPaths(1, False, trace_media)


def _make_weighted_paths(config: PathConfig, filter_kind: int | None) -> CameraPaths:
    """The same with the weights of bidirectional paths."""
    width = rays_together(config.rays, config.surfaces.primitives)
    starts = make_bundled_starts(config, filter_kind)
    camera_walk = make_camera_walk(config, False, width > 1)
    walk_from = make_walk_from(config.camera)

    @wp.func
    def trace_weighted(
        scene: Scene,
        camera: Camera,
        pixels: wp.array(dtype=wp.int32),
        bundle: Bundle,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        paths_out: wp.array(dtype=CameraPath),
    ):
        starting = wp.zeros(shape=(wp.static(width),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(width),), dtype=CameraSample)
        for j in range(bundle.samples):
            sampler = sampler_in(pixels, bundle, j)
            px = column_of(bundle, sampler)
            py = row_of(bundle, sampler)
            path = CameraPath()
            state, sample = starts(scene, camera, px, py, sampler, j, bundle.samples, starting, cameras)
            path.sample = sample
            walk = walk_from(state, sample)
            while walk.path.alive == 1:
                vertex, walk = camera_walk(scene, camera, sampler, walk, max_depth, rr_depth)
                path.radiance += wp.cw_mul(vertex.throughput, vertex.direct)
            paths_out[j] = path

    return CameraPaths(width, False, trace_weighted)


@functools.cache
def make_primal_kernel(config: PathConfig):
    """Return the primal kernel: one thread a pixel, all its samples in order.

    ``film_out`` receives the sum of their radiance and their number, ``squares_out``, unless it is empty, the sum of
    the squares.
    """
    paths = make_image_paths(config)
    trace = paths.trace
    pixel_bundle = make_pixel_bundle(paths.width if paths.grouped else 1)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def primal(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        # Out:
        film_out: wp.array2d(dtype=wp.vec4d),
        squares_out: wp.array2d(dtype=wp.vec3d),
    ):
        bundle = pixel_bundle(job, camera, wp.tid())
        if bundle.pixels == 0:
            return
        # In double precision: a float32 sum stands still after 2^24 equal terms.
        total = wp.vec3d()
        squares = wp.vec3d()
        found = wp.zeros(shape=(wp.static(paths.width),), dtype=CameraPath)
        done = wp.int32(0)
        while done < job.samples:
            bundle.first_sample = job.first_sample + done
            bundle.samples = wp.min(job.samples - done, wp.static(paths.width))
            done += bundle.samples
            trace(scene, camera, job.pixels, bundle, job.max_depth, job.rr_depth, found)
            for i in range(bundle.pixels):
                sampler = sampler_at(job.pixels[bundle.first + i], 0, bundle.seed)
                for k in range(bundle.samples):
                    radiance = found[i * bundle.samples + k].radiance
                    if finite(radiance):
                        total += wp.vec3d(radiance)
                        squares += wp.cw_mul(wp.vec3d(radiance), wp.vec3d(radiance))
                    else:
                        sampler.index = wp.uint32(bundle.first_sample + k)
                        count_invalid(scene, sampler)
                if done == job.samples:
                    px = column_of(bundle, sampler)
                    py = row_of(bundle, sampler)
                    film_out[py, px] = film_out[py, px] + wp.vec4d(
                        total[0], total[1], total[2], wp.float64(job.samples)
                    )
                    if squares_out.shape[0] > 0:
                        squares_out[py, px] = squares_out[py, px] + squares
                    total = wp.vec3d()
                    squares = wp.vec3d()

    return primal

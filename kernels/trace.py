"""Draws the path of one sample again and writes its vertices, to find why a sample is not finite."""

import functools

import warp as wp

from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_camera_start, make_path_step
from warp_psdr.kernels.path_media import MediaVertex, make_media_step, media_path_from
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathVertex


@functools.cache
def make_trace_kernel(config: PathConfig, differential: bool, filter_kind: int | None):
    """Return the kernel: one thread. It writes at most ``vertices_out.shape[0]`` vertices and their number.

    Args:
        config: what the scene needs.
        differential: as ``make_path_step``'s.
        filter_kind: as ``make_camera_start``'s.
    """
    path_step = make_path_step(config, differential)
    start = make_camera_start(config, filter_kind)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def trace(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        px: wp.int32,
        py: wp.int32,
        pixel: wp.int32,
        sample: wp.int32,
        seed: wp.uint32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        # Out:
        vertices_out: wp.array(dtype=PathVertex),
        count_out: wp.array(dtype=wp.int32),
    ):
        sampler = sampler_at(pixel, sample, seed)
        state, _sample = start(scene, camera, px, py, sampler)
        count = wp.int32(0)
        while state.alive == 1:
            vertex, state = path_step(scene, sampler, state, max_depth, rr_depth)
            if count < vertices_out.shape[0]:
                vertices_out[count] = vertex
            count += 1
        count_out[0] = count

    return trace


@functools.cache
def make_media_trace_kernel(
    config: PathConfig, differential: bool, explores: bool, clocked: bool, filter_kind: int | None
):
    """Return the kernel that writes the steps of a path through media, as ``make_trace_kernel``'s does vertices.

    ``differential``, ``explores`` and ``clocked``: as ``make_media_step``'s.
    """
    media_step = make_media_step(config, differential, explores, clocked)
    start = make_camera_start(config, filter_kind)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def media_trace(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        px: wp.int32,
        py: wp.int32,
        pixel: wp.int32,
        sample: wp.int32,
        seed: wp.uint32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        # Out:
        steps_out: wp.array(dtype=MediaVertex),
        count_out: wp.array(dtype=wp.int32),
    ):
        sampler = sampler_at(pixel, sample, seed)
        started, _sample = start(scene, camera, px, py, sampler)
        state = media_path_from(started, camera.medium)
        count = wp.int32(0)
        while state.path.alive == 1:
            step, state = media_step(scene, sampler, state, max_depth, rr_depth)
            if count < steps_out.shape[0]:
                steps_out[count] = step
            count += 1
        count_out[0] = count

    return media_trace

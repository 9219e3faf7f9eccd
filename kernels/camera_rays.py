"""Camera rays that are traced together where the ray structure allows it (``bvh/bundle.py``), with their samples."""

import functools

import warp as wp

from warp_psdr.kernels.bvh.bundle import make_bundle
from warp_psdr.kernels.bvh.wide import Ray, RayHit
from warp_psdr.kernels.jobs import PixelJob
from warp_psdr.kernels.lanes.lanes import ROWS, make_record, words
from warp_psdr.kernels.path import make_camera_start, make_path_step
from warp_psdr.kernels.rng import Sampler, branch_of, sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathState, RayConfig
from warp_psdr.kernels.visibility import visibility_of_meshes


@wp.struct
class Bundle:
    """Samples that are traced together: some of one pixel, or all of several, one after the other."""

    first: wp.int32  # of the pixels, in the list that the kernel is given
    pixels: wp.int32  # their number
    first_sample: wp.int32
    samples: wp.int32  # of each
    seed: wp.uint32
    raster: wp.int32  # width of the raster that the pixels are numbered in
    margin: wp.int32  # by which it exceeds the image


@wp.func
def sampler_in(pixels: wp.array(dtype=wp.int32), bundle: Bundle, j: wp.int32) -> Sampler:
    """The j-th sample of a bundle."""
    pixel = pixels[bundle.first + j // bundle.samples]
    return sampler_at(pixel, bundle.first_sample + j % bundle.samples, bundle.seed)


@wp.func
def column_of(bundle: Bundle, sampler: Sampler) -> wp.int32:
    return wp.int32(sampler.pixel) % bundle.raster - bundle.margin


@wp.func
def row_of(bundle: Bundle, sampler: Sampler) -> wp.int32:
    return wp.int32(sampler.pixel) // bundle.raster - bundle.margin


@functools.cache
def make_pixel_bundle(lanes: int):
    """Return ``pixel_bundle(job, camera, thread) -> Bundle``.

    It holds the pixels that a thread traces, not yet their samples: one, or where its samples are fewer than the lanes,
    as many as fill them. The threads of the others have none.
    """

    @wp.func
    def pixel_bundle(job: PixelJob, camera: Camera, thread: wp.int32) -> Bundle:
        size = wp.max(wp.static(lanes) // job.samples, 1)
        bundle = Bundle()
        bundle.first = job.first_pixel + thread
        bundle.pixels = wp.where(thread % size == 0, wp.min(size, job.pixel_count - thread), 0)
        bundle.seed = job.seed
        bundle.raster = camera.crop_width + 2 * job.margin
        bundle.margin = job.margin
        return bundle

    return pixel_bundle


def rays_together(rays: RayConfig, primitives: tuple[int, ...]) -> int:
    """Return the number of camera rays that are traced at a time; 1: ``path_step`` traces them."""
    return rays.width if rays.backend == "wide" and not primitives else 1


@functools.cache
def make_trace_together(config: RayConfig):
    """Return ``trace_together(scene, count, rows, rays, found)`` for up to ``rays_together`` rays of the camera.

    ``rays`` is the first row of their ``Ray``, of which those behind the ``count``-th are traced for nothing;
    ``found`` that of their ``RayHit``. A few are traced one by one. They meet triangles alone.
    """
    width = config.width
    closest_hits, _any_hits = make_bundle(width)
    visibility = visibility_of_meshes(config)
    get_ray, _put_ray = make_record(Ray, width)
    _get_hit, put_hit = make_record(RayHit, width)

    @wp.func
    def trace_together(scene: Scene, count: wp.int32, rows: ROWS, rays: wp.int32, found: wp.int32):
        if 2 * count <= wp.static(width):
            for i in range(count):
                ray = get_ray(rows, rays, i, Ray())
                put_hit(rows, found, i, visibility.seen(scene, ray.o, ray.d, ray.t_max, 0))
        else:
            closest_hits(visibility.camera_accel(scene), rows, rays, found)

    return trace_together


@functools.cache
def make_bundled_starts(config: PathConfig, filter_kind: int | None = None):
    """Return ``starts(scene, camera, px, py, sampler, k, count, starting, cameras) -> (PathState, CameraSample)``.

    The state and the camera's sample of the k-th of ``count`` samples of a pixel, to be asked for in their order;
    ``starting`` and ``cameras`` are arrays of ``rays_together`` that keep those of a bundle. Every ``rays_together``-th
    call traces the rays of the samples up to the next: ``state.seen``.

    ``filter_kind``: as ``make_camera_start``'s.
    """
    start = make_camera_start(config, filter_kind)
    lanes = rays_together(config.rays, config.surfaces.primitives)
    trace_together = make_trace_together(config.rays) if lanes > 1 else None

    _get_ray, put_ray = make_record(Ray, config.rays.width)
    get_hit, _put_hit = make_record(RayHit, config.rays.width)
    hit_row = words(Ray)

    @wp.func
    def start_together(
        scene: Scene,
        camera: Camera,
        px: wp.int32,
        py: wp.int32,
        sampler: Sampler,
        count: wp.int32,
        starting: wp.array(dtype=PathState),
        cameras: wp.array(dtype=CameraSample),
    ):
        ray = Ray()
        for i in range(count):
            state, sample = start(scene, camera, px, py, branch_of(sampler, wp.int32(sampler.index) + i))
            starting[i] = state
            cameras[i] = sample
            ray.o = state.o
            ray.d = state.d
            ray.t_max = state.t_max
            put_ray(scene.rows, 0, i, ray)
        for i in range(count, wp.static(lanes)):  # the last one once more
            put_ray(scene.rows, 0, i, ray)
        trace_together(scene, count, scene.rows, 0, hit_row)
        for i in range(count):
            state = starting[i]
            state.seen = get_hit(scene.rows, hit_row, i, RayHit())
            starting[i] = state

    @wp.func
    def starts(
        scene: Scene,
        camera: Camera,
        px: wp.int32,
        py: wp.int32,
        sampler: Sampler,
        k: wp.int32,
        count: wp.int32,
        starting: wp.array(dtype=PathState),
        cameras: wp.array(dtype=CameraSample),
    ) -> tuple[PathState, CameraSample]:
        if wp.static(lanes > 1):
            i = k % wp.static(lanes)
            if i == 0:
                start_together(scene, camera, px, py, sampler, wp.min(count - k, wp.static(lanes)), starting, cameras)
            return starting[i], cameras[i]
        else:
            return start(scene, camera, px, py, sampler)

    return starts


def make_camera_paths(
    config: PathConfig, differential: bool, sparse: bool = False, filter_kind: int | None = None
) -> tuple[int, wp.Function, wp.Function]:
    """Return ``(lanes, starts, path_step)`` of paths from the camera: two functions that agree on who traces its rays.

    ``lanes`` is the size of the arrays that ``starts`` takes. Arguments as those of ``make_path_step`` and
    ``make_bundled_starts``.
    """
    lanes = rays_together(config.rays, config.surfaces.primitives)
    path_step = make_path_step(config, differential, sparse, traced=lanes > 1)
    return lanes, make_bundled_starts(config, filter_kind), path_step

"""The image under a filter that reaches beyond its pixel: every sample counts for all pixels within the filter's reach.

Samples are uniform over each pixel's square. Pixel j receives sum_i h(s_i - j) L_i / sum_i h(s_i - j), the usual ratio
estimator of the filtered radiance. It uses each path some 4 pi sigma^2 times, compared with drawing one pixel's offsets
from the filter (``film.py``); the variance of a Gaussian of half a pixel falls by 3. Differential passes use
``film.py`` all the same, since there a sample has one pixel's adjoint. Both estimate the same quantity. If the film
samples its border, the raster is extended by the filter's reach. On the CPU every shard of a launch draws a band of
rows and has a film of the rows that they count for (vec4, the weighted radiance and the weight), because neighbouring
threads would add to the same pixels. ``films.collect_band`` adds these to a film in double precision, every so many
samples, since long float32 sums lose digits. Bands are so high that no more than two count for a pixel: the sum does
not depend on their order.
"""

import functools

import warp as wp

from warp_psdr.kernels.camera_rays import make_pixel_bundle, sampler_in
from warp_psdr.kernels.constants import RFILTER_BOX, RFILTER_TENT
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.jobs import PixelJob
from warp_psdr.kernels.lanes.waiting_lanes import CameraPath
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.primal import make_image_paths
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@wp.struct
class FilterStep:
    """The one-dimensional filter at x, x - 1, x - 2, ... (pixels): what gives the next value from this one."""

    weight: wp.float32  # unnormalised
    value: wp.float32  # gaussian: exp(k x^2); tent: x
    ratio: wp.float32  # gaussian: exp(k (x - 1)^2) / exp(k x^2)
    change: wp.float32  # gaussian: exp(2 k), by which the ratio changes
    end: wp.float32  # gaussian: exp(k radius^2); tent: 1 / radius


@functools.cache
def make_filter_steps(kind: int):
    """Return ``first(x, radius, stddev) -> FilterStep`` and ``following(step) -> FilterStep``.

    A Gaussian, k = -1 / (2 stddev^2), goes from pixel to pixel by products: exp(k (x - 1)^2) = exp(k x^2) exp(k (1 - 2
    x)), whose second factor changes by exp(2 k) a pixel. An exponential for every pixel took a tenth of an image.
    """

    @wp.func
    def first(x: wp.float32, radius: wp.float32, stddev: wp.float32) -> FilterStep:
        step = FilterStep()
        if wp.static(kind == RFILTER_TENT):
            step.value = x
            step.end = 1.0 / radius
            step.weight = wp.max(1.0 - wp.abs(x) * step.end, 0.0)
        else:
            k = -0.5 / (stddev * stddev)
            step.value = wp.exp(k * x * x)
            step.ratio = wp.exp(k * (1.0 - 2.0 * x))
            step.change = wp.exp(2.0 * k)
            step.end = wp.exp(k * radius * radius)
            step.weight = wp.max(step.value - step.end, 0.0)
        return step

    @wp.func
    def following(last: FilterStep) -> FilterStep:
        step = last
        if wp.static(kind == RFILTER_TENT):
            step.value = last.value - 1.0
            step.weight = wp.max(1.0 - wp.abs(step.value) * last.end, 0.0)
        else:
            step.value = last.value * last.ratio
            step.ratio = last.ratio * last.change
            step.weight = wp.max(step.value - last.end, 0.0)
        return step

    return first, following


@functools.cache
def make_splat_kernel(config: PathConfig):
    """Return the primal kernel for tent and gaussian filters: one thread a pixel of the extended raster."""
    paths = make_image_paths(config, RFILTER_BOX)
    trace = paths.trace
    pixel_bundle = make_pixel_bundle(paths.width if paths.grouped else 1)
    first, following = make_filter_steps(config.filter)

    @wp.func
    def spread(camera: Camera, path: CameraPath, first_film_row: wp.int32, film_out: wp.array2d(dtype=wp.vec4)):
        """Add a sample to the pixels that it counts for."""
        # Where it lies, in pixels of the crop window; pixel j's centre is at j + 1/2.
        x = path.sample.film[0] * wp.float32(camera.width) - wp.float32(camera.crop_x) - 0.5
        y = path.sample.film[1] * wp.float32(camera.height) - wp.float32(camera.crop_y) - 0.5
        r = camera.filter_radius
        radiance = path.radiance
        first_row = wp.max(wp.int32(wp.ceil(y - r)), 0)
        last_row = wp.min(wp.int32(wp.floor(y + r)), camera.crop_height - 1)
        first_column = wp.max(wp.int32(wp.ceil(x - r)), 0)
        last_column = wp.min(wp.int32(wp.floor(x + r)), camera.crop_width - 1)
        row_step = first(y - wp.float32(first_row), r, camera.filter_stddev)
        start_step = first(x - wp.float32(first_column), r, camera.filter_stddev)
        for row in range(first_row, last_row + 1):
            step = start_step
            for column in range(first_column, last_column + 1):
                w = row_step.weight * step.weight
                weighted = wp.vec4(w * radiance[0], w * radiance[1], w * radiance[2], w)
                wp.atomic_add(film_out, row - first_film_row, column, weighted)
                step = following(step)
            row_step = following(row_step)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def splat(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        # Out:
        film_out: wp.array2d(dtype=wp.vec4),
    ):
        bundle = pixel_bundle(job, camera, wp.tid())
        if bundle.pixels == 0:
            return
        found = wp.zeros(shape=(wp.static(paths.width),), dtype=CameraPath)
        done = wp.int32(0)
        while done < job.samples:
            bundle.first_sample = job.first_sample + done
            bundle.samples = wp.min(job.samples - done, wp.static(paths.width))
            done += bundle.samples
            trace(scene, camera, job.pixels, bundle, job.max_depth, job.rr_depth, found)
            for j in range(bundle.pixels * bundle.samples):
                if finite(found[j].radiance):
                    spread(camera, found[j], job.first_film_row, film_out)
                else:
                    count_invalid(scene, sampler_in(job.pixels, bundle, j))

    return splat

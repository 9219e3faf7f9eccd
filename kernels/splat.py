"""The primal image under a filter that reaches beyond its pixel: every sample counts for all pixels that it reaches.

Samples are uniform over each pixel's square; pixel j receives sum_i h(s_i - j) L_i / sum_i h(s_i - j), the usual ratio
estimator of the filtered radiance. Compared with drawing one pixel's offsets from the filter (``film.py``, what the
differential passes do, since there a sample has one pixel's adjoint) it uses each path some 4 pi sigma^2 times: the
variance of a Gaussian of half a pixel falls by 3. The raster is extended by the filter's reach, so that border pixels
see the whole of their filter and both estimate the same quantity.

Neighbouring threads would add to the same pixels, so on the CPU every lane of a launch has a film of its own: vec4,
the weighted radiance and the weight. ``collect`` adds the lanes in fixed order to a film in double precision; the host
calls it every so many samples, since a float32 sum of very many terms loses digits, and after 2^24 stands still.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import RFILTER_BOX, RFILTER_TENT
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.path import PathConfig, make_camera_start, make_path_step
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.structs import Camera, Scene


@functools.cache
def make_filter_weight(kind: int):
    """Return ``weight(x, radius, stddev) -> float``: the unnormalised one-dimensional filter, x in pixels."""

    @wp.func
    def weight(x: wp.float32, radius: wp.float32, stddev: wp.float32) -> wp.float32:
        if wp.static(kind == RFILTER_TENT):
            return wp.max(1.0 - wp.abs(x) / radius, 0.0)
        else:
            k = -0.5 / (stddev * stddev)
            return wp.max(wp.exp(k * x * x) - wp.exp(k * radius * radius), 0.0)

    return weight


@functools.cache
def make_splat_kernel(config: PathConfig):
    """Return the primal kernel for tent and gaussian filters: one thread a pixel of the extended raster."""
    path_step = make_path_step(config, False)
    start = make_camera_start(config, RFILTER_BOX)
    weight = make_filter_weight(config.filter)

    @wp.kernel(module="unique", enable_backward=False)
    def splat(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        pixels: wp.array(dtype=wp.int32),
        first_pixel: wp.int32,
        margin: wp.int32,
        first_sample: wp.int32,
        samples: wp.int32,
        seed: wp.uint32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        # Out:
        film_out: wp.array2d(dtype=wp.vec4),
    ):
        pixel = pixels[first_pixel + wp.tid()]
        width = camera.crop_width + 2 * margin
        px = pixel % width - margin
        py = pixel // width - margin
        for i in range(samples):
            sampler = sampler_at(pixel, first_sample + i, seed)
            state, sample = start(scene, camera, px, py, sampler)
            radiance = wp.vec3(0.0, 0.0, 0.0)
            while state.alive == 1:
                vertex, state = path_step(scene, sampler, state, max_depth, rr_depth)
                radiance += wp.cw_mul(vertex.throughput, vertex.direct)
            if not finite(radiance):
                count_invalid(scene, sampler)
                continue
            # Where the sample lies, in pixels of the crop window; pixel j's centre is at j + 1/2.
            x = sample.film[0] * wp.float32(camera.width) - wp.float32(camera.crop_x) - 0.5
            y = sample.film[1] * wp.float32(camera.height) - wp.float32(camera.crop_y) - 0.5
            r = camera.filter_radius
            first_row = wp.max(wp.int32(wp.ceil(y - r)), 0)
            last_row = wp.min(wp.int32(wp.floor(y + r)), camera.crop_height - 1)
            first_column = wp.max(wp.int32(wp.ceil(x - r)), 0)
            last_column = wp.min(wp.int32(wp.floor(x + r)), camera.crop_width - 1)
            for row in range(first_row, last_row + 1):
                w_y = weight(y - wp.float32(row), r, camera.filter_stddev)
                for column in range(first_column, last_column + 1):
                    w = w_y * weight(x - wp.float32(column), r, camera.filter_stddev)
                    wp.atomic_add(film_out, row, column, wp.vec4(w * radiance[0], w * radiance[1], w * radiance[2], w))

    return splat


@wp.kernel(module="unique", enable_backward=False)
def collect(
    # In and out:
    films: wp.array3d(dtype=wp.vec4),
    # Out:
    film_out: wp.array2d(dtype=wp.vec4d),
):
    """Add the lanes' films in fixed order to one in double precision, and clear them."""
    row, column = wp.tid()
    total = film_out[row, column]
    for lane in range(films.shape[0]):
        total += wp.vec4d(films[lane, row, column])
        films[lane, row, column] = wp.vec4()
    film_out[row, column] = total


@wp.kernel(module="unique", enable_backward=False)
def resolve(
    # In:
    film: wp.array2d(dtype=wp.vec4d),
    # Out:
    image_out: wp.array2d(dtype=wp.vec3),
):
    """Divide by the weights."""
    row, column = wp.tid()
    total = film[row, column]
    if total[3] > wp.float64(0.0):
        image_out[row, column] = wp.vec3(wp.vec3d(total[0], total[1], total[2]) / total[3])

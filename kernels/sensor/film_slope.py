"""The derivative of splats by their position on the film: the slopes of pixel filters.

A point at u counts h_j(u) / share_j for pixel j (``projection.py``); the share depends on the pixel alone. Tents and
Gaussians end at 0, so their slopes are the whole derivative. A box has no slope, but jumps, which no kernel here
estimates.

Derivation: ``docs/theory/light_tracing.md#vertices-that-move``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import RFILTER_TENT
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.sensor.film import GAUSSIAN_CUT, GAUSSIAN_INTEGRAL, filter_share
from warp_psdr.kernels.sensor.projection import counts, film_window, pixel_filter
from warp_psdr.kernels.structs import Camera, Scene


@wp.func
def pixel_slope(camera: Camera, at: wp.float32, pixel: wp.int32, size: wp.int32) -> wp.float32:
    """Derivative of ``pixel_filter`` by the place [1 / pixel^2], of a tent or a Gaussian."""
    x = at - wp.float32(pixel) - 0.5
    slope = wp.float32(0.0)
    if camera.filter == RFILTER_TENT:
        if wp.abs(x) < camera.filter_radius:
            slope = -wp.sign(x) / (camera.filter_radius * camera.filter_radius)
    else:
        z = x / camera.filter_stddev
        if wp.abs(z) < GAUSSIAN_CUT:
            slope = -z * wp.exp(-0.5 * z * z) / (GAUSSIAN_INTEGRAL * camera.filter_stddev * camera.filter_stddev)
    return slope / filter_share(camera, pixel, size)


@functools.cache
def make_moving_splat():
    """Return ``(splat, gather)`` of points that move on the film.

    ``splat(scene, sampler, camera, at, value, at_dot, value_dot, image)`` adds the velocity of a contribution;
    ``gather(camera, at, value, adjoint) -> (vec3, vec2)`` is its transpose: the adjoints of the value and of the place.
    """

    @wp.func
    def splat_velocity(
        scene: Scene,
        sampler: Sampler,
        camera: Camera,
        at: wp.vec2,
        value: wp.vec3,
        at_dot: wp.vec2,
        value_dot: wp.vec3,
        image: wp.array2d(dtype=wp.vec3),
    ):
        if not (finite(value_dot) and finite(wp.vec3(at_dot[0], at_dot[1], 0.0))):
            count_invalid(scene, sampler)
            return
        if not counts(camera, at):
            return
        window = film_window(camera, at)
        for y in range(window.y0, window.y1 + 1):
            h_y = pixel_filter(camera, at[1], y, camera.crop_height)
            s_y = at_dot[1] * pixel_slope(camera, at[1], y, camera.crop_height)
            for x in range(window.x0, window.x1 + 1):
                h_x = pixel_filter(camera, at[0], x, camera.crop_width)
                s_x = at_dot[0] * pixel_slope(camera, at[0], x, camera.crop_width)
                wp.atomic_add(image, y, x, (h_x * h_y) * value_dot + (s_x * h_y + h_x * s_y) * value)

    @wp.func
    def gather_motion(
        camera: Camera, at: wp.vec2, value: wp.vec3, adjoint: wp.array2d(dtype=wp.vec3)
    ) -> tuple[wp.vec3, wp.vec2]:
        asked = wp.vec3(0.0, 0.0, 0.0)
        a_x = wp.float32(0.0)
        a_y = wp.float32(0.0)
        if counts(camera, at):
            window = film_window(camera, at)
            for y in range(window.y0, window.y1 + 1):
                h_y = pixel_filter(camera, at[1], y, camera.crop_height)
                s_y = pixel_slope(camera, at[1], y, camera.crop_height)
                for x in range(window.x0, window.x1 + 1):
                    h_x = pixel_filter(camera, at[0], x, camera.crop_width)
                    s_x = pixel_slope(camera, at[0], x, camera.crop_width)
                    here = adjoint[y, x]
                    asked += (h_x * h_y) * here
                    along = wp.dot(here, value)
                    a_x += s_x * h_y * along
                    a_y += h_x * s_y * along
        return asked, wp.vec2(a_x, a_y)

    return splat_velocity, gather_motion

"""Pixel filters by importance sampling: a camera ray belongs to one pixel and is offset by the filter's own density.

The filters are Mitsuba 3's: ``box`` (radius 1/2), ``tent`` and ``gaussian`` (cut at 4 standard deviations and lowered
by its value there, so that it ends at 0). All are positive, even and separable; offsets are in pixels [M. Ernst, M.
Stamminger, G. Greiner, "Filter Importance Sampling", IEEE Symposium on Interactive Ray Tracing 2006]. Light beyond the
crop window counts for its pixels only if the film's ``sample_border`` is set. Else the filter h_j of a pixel j near the
border ends there, and its weights are normalised by the rest, as in Mitsuba's film:

    I_j = int_W h_j L / int_W h_j,      W the crop window.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import RFILTER_BOX, RFILTER_GAUSSIAN, RFILTER_TENT
from warp_psdr.kernels.structs import Camera

#: Where Mitsuba cuts the Gaussian, in standard deviations; the inversion below holds for this ratio only.
GAUSSIAN_CUT = 4.0
#: sqrt(2 pi) erf(4 / sqrt 2) - 8 exp(-8): the integral of the lowered Gaussian, over its standard deviation.
GAUSSIAN_INTEGRAL = 2.50378587
#: exp(-8), by which it is lowered.
GAUSSIAN_FLOOR = 3.3546263e-4
#: sqrt(pi / 2) and 1 / sqrt 2, of its cumulative distribution.
HALF_GAUSSIAN, SQRT_HALF = 1.25331414, 0.70710678
#: Keeps the logarithm of the inversion finite at the two ends.
TAIL = 3.0e-6


@wp.func
def tent_offset(u: wp.float32, radius: wp.float32) -> wp.float32:
    """Offset with density proportional to 1 - |x| / radius."""
    if u < 0.5:
        return radius * (wp.sqrt(2.0 * u) - 1.0)
    return radius * (1.0 - wp.sqrt(2.0 - 2.0 * u))


@wp.func
def gaussian_offset(u: wp.float32, stddev: wp.float32) -> wp.float32:
    """Offset with density proportional to exp(-x^2 / 2 stddev^2) - exp(-8), |x| < 4 stddev.

    With v = |2 u - 1|, the inverse cumulative distribution is v P(z), z = -log(1 - v^2 + TAIL v^2) / 6 - 1, and P the
    polynomial of degree 7 fitted to it: the cumulative distribution of the result differs from the exact one by less
    than 6e-6 anywhere.
    """
    tail = 2.0 * wp.min(u, 1.0 - u)
    v = 1.0 - tail
    z = wp.log(tail * (2.0 - tail) + TAIL * v * v) * (-1.0 / 6.0) - 1.0
    p = 0.07290868 + 0.03001487 * z
    p = -0.02900402 + p * z
    p = 0.02643145 + p * z
    p = -0.126899 + p * z
    p = -0.67449228 + p * z
    p = 1.4716717 + p * z
    p = 3.17329975 + p * z
    x = wp.min(v * p, GAUSSIAN_CUT) * stddev
    return wp.where(u < 0.5, -x, x)


@functools.cache
def make_filter(kind: int):
    """Return ``sample(u: vec2, radius, stddev) -> vec2``, an offset from the pixel's centre [pixels].

    Args:
        kind: RFILTER_BOX and RFILTER_TENT, which read ``radius``, or RFILTER_GAUSSIAN, which reads ``stddev``: its
            radius is 4 ``stddev``.

    Raises:
        ValueError: unknown filter.
    """
    if kind == RFILTER_BOX:

        @wp.func
        def sample(u: wp.vec2, radius: wp.float32, stddev: wp.float32) -> wp.vec2:
            return wp.vec2((2.0 * u[0] - 1.0) * radius, (2.0 * u[1] - 1.0) * radius)

    elif kind == RFILTER_TENT:

        @wp.func
        def sample(u: wp.vec2, radius: wp.float32, stddev: wp.float32) -> wp.vec2:
            return wp.vec2(tent_offset(u[0], radius), tent_offset(u[1], radius))

    elif kind == RFILTER_GAUSSIAN:

        @wp.func
        def sample(u: wp.vec2, radius: wp.float32, stddev: wp.float32) -> wp.vec2:
            return wp.vec2(gaussian_offset(u[0], stddev), gaussian_offset(u[1], stddev))

    else:
        raise ValueError(f"unknown pixel filter {kind!r}; expected RFILTER_BOX, RFILTER_TENT or RFILTER_GAUSSIAN")
    return sample


@wp.func
def filter_extent(camera: Camera) -> wp.float32:
    """Radius of the pixel filter [pixels]."""
    if camera.filter == RFILTER_GAUSSIAN:
        return GAUSSIAN_CUT * camera.filter_stddev
    return camera.filter_radius


@wp.func
def filter_margin(camera: Camera) -> wp.float32:
    """How far beyond the crop window a point counts for its pixels [pixels]."""
    return wp.where(camera.sample_border == 1, wp.max(filter_extent(camera) - 0.5, 0.0), 0.0)


@wp.func
def filter_cdf(camera: Camera, x: wp.float32) -> wp.float32:
    """Share of the filter, along one axis, that lies below x [pixels]."""
    t = wp.clamp(x / filter_extent(camera), -1.0, 1.0)
    if camera.filter == RFILTER_BOX:
        return 0.5 + 0.5 * t
    if camera.filter == RFILTER_TENT:
        return 0.5 + t * (1.0 - 0.5 * wp.abs(t))
    z = GAUSSIAN_CUT * t
    return 0.5 + (HALF_GAUSSIAN * wp.erf(SQRT_HALF * z) - GAUSSIAN_FLOOR * z) / GAUSSIAN_INTEGRAL


@wp.func
def is_cut(camera: Camera, pixel: wp.int32, size: wp.int32) -> wp.bool:
    """Whether the border cuts a pixel's filter, along an axis on which the crop window has ``size`` pixels."""
    r = filter_extent(camera) - 0.5
    return camera.sample_border == 0 and (wp.float32(pixel) < r or wp.float32(size - 1 - pixel) < r)


@wp.func
def filter_share(camera: Camera, pixel: wp.int32, size: wp.int32) -> wp.float32:
    """Share of a pixel's filter, along one axis, that counts: int_W h_j, by which h_j is normalised."""
    if is_cut(camera, pixel, size):
        centre = wp.float32(pixel) + 0.5
        return filter_cdf(camera, wp.float32(size) - centre) - filter_cdf(camera, -centre)
    return 1.0


@wp.func
def between(camera: Camera, pixel: wp.int32, size: wp.int32, u: wp.float32) -> wp.float32:
    """Uniform over the part of a box that counts, along one axis; no branch in a loop over lanes."""
    centre = wp.float32(pixel) + 0.5
    cut = camera.sample_border == 0
    low = wp.where(cut, wp.max(-camera.filter_radius, -centre), -camera.filter_radius)
    high = wp.where(cut, wp.min(camera.filter_radius, wp.float32(size) - centre), camera.filter_radius)
    return low + u * (high - low)


@wp.func
def box_offset(camera: Camera, px: wp.int32, py: wp.int32, u: wp.vec2) -> wp.vec2:
    """Uniform over what counts of a box filter."""
    return wp.vec2(between(camera, px, camera.crop_width, u[0]), between(camera, py, camera.crop_height, u[1]))


@functools.cache
def make_pixel_offset(kind: int):
    """Return ``offset(camera, px, py, u) -> vec2``: from a pixel's centre, by the density of what its filter counts."""
    if kind == RFILTER_BOX:
        return box_offset
    sample = make_filter(kind)

    @wp.func
    def narrowed(camera: Camera, pixel: wp.int32, size: wp.int32, u: wp.float32) -> wp.float32:
        """Where the border cuts the filter: the number that leads as far into what is left of it."""
        if is_cut(camera, pixel, size):
            return filter_cdf(camera, -wp.float32(pixel) - 0.5) + u * filter_share(camera, pixel, size)
        return u

    @wp.func
    def inside(camera: Camera, pixel: wp.int32, size: wp.int32, x: wp.float32) -> wp.float32:
        """Without the inversion's rounding, which matters where a shape ends with the film."""
        if camera.sample_border == 0:
            centre = wp.float32(pixel) + 0.5
            return wp.clamp(x, -centre, wp.float32(size) - centre)
        return x

    @wp.func
    def offset(camera: Camera, px: wp.int32, py: wp.int32, u: wp.vec2) -> wp.vec2:
        width = camera.crop_width
        height = camera.crop_height
        v = wp.vec2(narrowed(camera, px, width, u[0]), narrowed(camera, py, height, u[1]))
        r = sample(v, camera.filter_radius, camera.filter_stddev)
        return wp.vec2(inside(camera, px, width, r[0]), inside(camera, py, height, r[1]))

    return offset


@wp.func
def uniform_offset(camera: Camera, px: wp.int32, py: wp.int32, u: wp.vec2) -> wp.vec2:
    """Uniform over the pixel, whatever the filter."""
    return wp.vec2(u[0] - 0.5, u[1] - 0.5)

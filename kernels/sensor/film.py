"""Pixel filters by importance sampling: a camera ray belongs to one pixel and is offset by the filter's own density.

The filters are Mitsuba 3's: ``box`` (radius 1/2), ``tent`` and ``gaussian`` (cut at 4 standard deviations and lowered
by its value there, so that it ends at 0). All are positive, even and separable; offsets are in pixels.
M. Ernst, M. Stamminger, G. Greiner, "Filter Importance Sampling", IEEE Symposium on Interactive Ray Tracing 2006.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import RFILTER_BOX, RFILTER_GAUSSIAN, RFILTER_TENT

#: Where Mitsuba cuts the Gaussian, in standard deviations; the inversion below holds for this ratio only.
GAUSSIAN_CUT = 4.0
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

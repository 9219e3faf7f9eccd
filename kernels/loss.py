"""Image losses: one kernel for the terms, two for their sum in a fixed order.

Warp differentiates these kernels itself. That is safe here, unlike in a path's bounce loop: the terms are free of
loops, and the loops of the sums carry nothing but the sum, whose adjoint needs none of its earlier values.
"""

import functools

import warp as wp


@wp.func
def squared(difference: wp.float32, target: wp.float32, parameter: wp.float32) -> wp.float32:
    return difference * difference


@wp.func
def absolute(difference: wp.float32, target: wp.float32, parameter: wp.float32) -> wp.float32:
    # Written with max, which drops NaN, so that the derivative at a difference of zero is zero; that of wp.abs is one.
    if wp.isnan(difference):
        return difference
    return wp.max(difference, 0.0) + wp.max(-difference, 0.0)


@wp.func
def huber(difference: wp.float32, target: wp.float32, parameter: wp.float32) -> wp.float32:
    # d^2 / 2 inside the threshold and its tangent outside. The clamped difference c gives both: c (d - c / 2).
    c = wp.clamp(difference, -parameter, parameter)
    return c * (difference - 0.5 * c)


@wp.func
def relative_squared(difference: wp.float32, target: wp.float32, parameter: wp.float32) -> wp.float32:
    return difference * difference / (target * target + parameter)


@functools.cache
def make_terms(term):
    """Make the kernel that sums ``term(image - target, target, parameter)`` over the channels of every pixel."""

    @wp.kernel(module="unique")
    def terms(
        # In:
        image: wp.array2d(dtype=wp.vec3),
        target: wp.array2d(dtype=wp.vec3),
        parameter: wp.float32,
        # Out:
        terms_out: wp.array2d(dtype=wp.float32),
    ):
        i, j = wp.tid()
        a = image[i, j]
        b = target[i, j]
        terms_out[i, j] = (
            term(a[0] - b[0], b[0], parameter) + term(a[1] - b[1], b[1], parameter) + term(a[2] - b[2], b[2], parameter)
        )

    return terms


@functools.cache
def make_sums():
    """Make the kernels that add up every row, then the rows, in order and in double precision."""

    @wp.kernel(module="warp_psdr.loss")
    def sum_rows(
        # In:
        terms: wp.array2d(dtype=wp.float32),
        # Out:
        rows_out: wp.array(dtype=wp.float64),
    ):
        i = wp.tid()
        total = wp.float64(0.0)
        for j in range(terms.shape[1]):
            total += wp.float64(terms[i, j])
        rows_out[i] = total

    @wp.kernel(module="warp_psdr.loss")
    def mean_of_rows(
        # In:
        rows: wp.array(dtype=wp.float64),
        scale: wp.float64,
        # Out:
        mean_out: wp.array(dtype=wp.float32),
    ):
        total = wp.float64(0.0)
        for i in range(rows.shape[0]):
            total += rows[i]
        mean_out[0] = wp.float32(total * scale)

    return sum_rows, mean_of_rows

"""Losses of images and regularisers of grids: one kernel for the terms, two for their sum in a fixed order.

Warp differentiates these kernels itself. This is safe here, unlike in a path's bounce loop: the terms are free of
loops, and the loops of the sums carry only the sum, whose adjoint needs none of its earlier values.
"""

import functools

import warp as wp

from warp_psdr.kernels.modules import GRID_LOSS, LOSS, wide_vectors


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

    @wp.kernel(module="unique", module_options=wide_vectors())
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
def make_grid_terms():
    """Make the kernels of the terms of grids (Z, Y, X): how far slopes are from 1, and the squared Laplacian."""

    @wp.kernel(module=GRID_LOSS)
    def eikonal_terms(
        # In:
        grid: wp.array3d(dtype=wp.float32),
        inverse: wp.vec3,
        # Out:
        terms_out: wp.array2d(dtype=wp.float32),
    ):
        z, y, x = wp.tid()
        # The slope at the middle of a voxel: a mean of four differences along each axis.
        a = grid[z, y, x]
        b = grid[z, y, x + 1]
        c = grid[z, y + 1, x]
        d = grid[z, y + 1, x + 1]
        e = grid[z + 1, y, x]
        f = grid[z + 1, y, x + 1]
        g = grid[z + 1, y + 1, x]
        h = grid[z + 1, y + 1, x + 1]
        along_x = (b - a) + (d - c) + (f - e) + (h - g)
        along_y = (c - a) + (d - b) + (g - e) + (h - f)
        along_z = (e - a) + (f - b) + (g - c) + (h - d)
        slope = wp.vec3(along_x * inverse[0], along_y * inverse[1], along_z * inverse[2]) * 0.25
        # A slope of zero has no direction; the square keeps its derivative finite, and away from zero changes nothing.
        excess = wp.sqrt(wp.dot(slope, slope) + 1.0e-12) - 1.0
        terms_out[z * (grid.shape[1] - 1) + y, x] = excess * excess

    @wp.kernel(module=GRID_LOSS)
    def laplacian_terms(
        # In:
        grid: wp.array3d(dtype=wp.float32),
        inverse: wp.vec3,
        # Out:
        terms_out: wp.array2d(dtype=wp.float32),
    ):
        z, y, x = wp.tid()
        # The border's values go on behind it.
        here = grid[z, y, x]
        before, behind = wp.max(x - 1, 0), wp.min(x + 1, grid.shape[2] - 1)
        along_x = (grid[z, y, before] - here) + (grid[z, y, behind] - here)
        before, behind = wp.max(y - 1, 0), wp.min(y + 1, grid.shape[1] - 1)
        along_y = (grid[z, before, x] - here) + (grid[z, behind, x] - here)
        before, behind = wp.max(z - 1, 0), wp.min(z + 1, grid.shape[0] - 1)
        along_z = (grid[before, y, x] - here) + (grid[behind, y, x] - here)
        bent = along_x * inverse[0] * inverse[0] + along_y * inverse[1] * inverse[1] + along_z * inverse[2] * inverse[2]
        terms_out[z * grid.shape[1] + y, x] = bent * bent

    return eikonal_terms, laplacian_terms


@functools.cache
def make_total():
    """Make the kernel that adds a weighted loss to a sum of losses."""

    @wp.kernel(module=GRID_LOSS)
    def add_weighted(
        # In:
        loss: wp.array(dtype=wp.float32),
        weight: wp.float32,
        before: wp.array(dtype=wp.float32),
        # Out:
        total_out: wp.array(dtype=wp.float32),
    ):
        total_out[0] = before[0] + weight * loss[0]

    return add_weighted


@functools.cache
def make_sums():
    """Make the kernels that add up every row, then the rows, in order and in double precision."""

    @wp.kernel(module=LOSS)
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

    @wp.kernel(module=LOSS)
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

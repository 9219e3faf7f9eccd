"""A piecewise density over the unit cube of boundary segments: the device form of k-d tree, octree and grid.

A segment has the coordinates (u_0, u_1, u_2): its position on the edges and its direction. The cube is split into
leaves with linear densities. A share of the samples is uniform over the whole cube, which keeps the estimate unbiased.

Derivation: ``docs/theory/guiding.md#cells``.
"""

import warp as wp

from warp_psdr.kernels.distribution import find_interval_64
from warp_psdr.kernels.rng import UNIT


@wp.struct
class Node:
    """A node of the tree that finds the leaf of a point."""

    axis: wp.int32  # -1: a leaf
    split: wp.float32  # coordinate where the upper half begins
    child: wp.int32  # node of the lower half, before that of the upper one; at a leaf its number


@wp.struct
class Cells:
    """The leaves, n of them, and the tree above them; its root is node 0."""

    nodes: wp.array(dtype=Node)
    low: wp.array(dtype=wp.vec3)
    high: wp.array(dtype=wp.vec3)
    slope: wp.array(dtype=wp.vec3)
    cdf: wp.array(dtype=wp.float32)  # cumulative probabilities, multiples of 2^-24, n + 1
    floor: wp.float32  # share of uniform samples, positive


@wp.struct
class CellSample:
    """A point of the cube. ``pdf``: its density; ``leaf``: where it lies."""

    u: wp.vec3d
    pdf: wp.float32
    leaf: wp.int32


@wp.func
def ramp_offset(r: wp.float64, slope: wp.float32) -> wp.float64:
    """Position in [0, 1] with the density 1 + slope (2 t - 1), up to roundings of double precision."""
    s = wp.float64(slope)
    a = wp.float64(1.0) - s
    b = wp.float64(1.0) + s
    return wp.float64(2.0) * r / (a + wp.sqrt((wp.float64(1.0) - r) * a * a + r * b * b))


@wp.func
def find_leaf(cells: Cells, u: wp.vec3d) -> wp.int32:
    node = cells.nodes[0]
    while node.axis >= 0:
        step = wp.where(u[node.axis] < wp.float64(node.split), 0, 1)
        node = cells.nodes[node.child + step]
    return node.child


@wp.func
def leaf_density(cells: Cells, leaf: wp.int32, u: wp.vec3d) -> wp.float32:
    """Density at a point of a leaf, floor included."""
    low = cells.low[leaf]
    size = cells.high[leaf] - low
    slope = cells.slope[leaf]
    density = (cells.cdf[leaf + 1] - cells.cdf[leaf]) / (size[0] * size[1] * size[2])
    for a in range(3):
        t = wp.float32(u[a] - wp.float64(low[a])) / size[a]
        density *= 1.0 + slope[a] * (2.0 * t - 1.0)
    return cells.floor + (1.0 - cells.floor) * density


@wp.func
def pdf_cells(cells: Cells, u: wp.vec3d) -> wp.float32:
    """Density at a point of the cube; 0 outside of it."""
    for a in range(3):
        if u[a] < wp.float64(0.0) or u[a] >= wp.float64(1.0):
            return 0.0
    return leaf_density(cells, find_leaf(cells, u), u)


@wp.func
def sample_cells(cells: Cells, v: wp.float64, jitter: wp.vec3) -> CellSample:
    """Draw a point.

    ``v`` in [0, 1) chooses the leaf and the position along its first axis: (number + random) / count stratifies the
    samples. ``jitter``: for the second axis, the third, and the bits of the second that one float has no room for.
    """
    r = CellSample()
    floor = wp.float64(cells.floor)
    fine = wp.float64(jitter[0]) + wp.float64(UNIT) * wp.float64(jitter[2])
    if v < floor:
        r.u = wp.vec3d(v / floor, fine, wp.float64(jitter[1]))
        r.leaf = find_leaf(cells, r.u)
    else:
        w = (v - floor) / (wp.float64(1.0) - floor)
        r.leaf = find_interval_64(cells.cdf, 0, cells.cdf.shape[0] - 1, w)
        below = wp.float64(cells.cdf[r.leaf])
        low = cells.low[r.leaf]
        high = cells.high[r.leaf]
        slope = cells.slope[r.leaf]
        along = (w - below) / (wp.float64(cells.cdf[r.leaf + 1]) - below)
        t = wp.vec3d(
            ramp_offset(along, slope[0]),
            ramp_offset(fine, slope[1]),
            ramp_offset(wp.float64(jitter[1]), slope[2]),
        )
        for a in range(3):
            r.u[a] = wp.float64(low[a]) + t[a] * (wp.float64(high[a]) - wp.float64(low[a]))
    r.pdf = leaf_density(cells, r.leaf, r.u)
    return r

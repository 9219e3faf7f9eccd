"""Majorants of grids: a super-grid of cells of 8^3 voxels, and a walk along a ray from cell to cell.

A cell holds the largest value that interpolation returns anywhere in it, over all channels, before the medium's
``scale``. Majorants are inputs of a launch, rebuilt when values are edited (``warp_psdr/scene/media/super_grid.py``),
and detached, because no derivative depends on them. The walk steps from cell to cell by integers. It computes the
crossing of a plane from the plane's number each time, so that errors do not add up and a grazing ray skips no cell
[Amanatides and Woo 1987]. Tentative points of tracking come along the walk at the rate of the majorants.

Derivation: ``docs/theory/media.md#grids``.
"""

import warp as wp

from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.medium.flight import minus_log_one_minus
from warp_psdr.kernels.medium.volume import grid_point, grid_size, grid_vector
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.rng import Sampler, independent_2d
from warp_psdr.kernels.structs import Medium, Scene, Texture

#: Voxels along the side of a cell.
CELL = 8


@wp.struct
class GridRay:
    """A ray in voxels, and where it is inside of the grid's box; distances are those of the scene."""

    o: wp.vec3
    d: wp.vec3  # voxels per unit of distance
    t0: wp.float32
    t1: wp.float32  # below t0: it misses the box


@wp.struct
class CellWalk:
    """A cell on a ray."""

    i: wp.int32
    j: wp.int32
    k: wp.int32
    t: wp.float32  # where the ray leaves the cell
    axis: wp.int32  # by a plane across it


@wp.func
def grid_ray(scene: Scene, g: Texture, o: wp.vec3, d: wp.vec3, length: wp.float32) -> GridRay:
    """The stretch of a segment that lies in a grid's box."""
    r = GridRay()
    r.o = grid_point(scene, g, o)
    r.d = grid_vector(scene, g, d)
    size = grid_size(g)
    t0 = wp.float32(0.0)
    t1 = length
    for axis in range(3):
        if r.d[axis] == 0.0:
            if r.o[axis] < 0.0 or r.o[axis] > size[axis]:
                t1 = wp.float32(-1.0)
        else:
            a = -r.o[axis] / r.d[axis]
            b = (size[axis] - r.o[axis]) / r.d[axis]
            t0 = wp.max(t0, wp.min(a, b))
            t1 = wp.min(t1, wp.max(a, b))
    r.t0 = t0
    r.t1 = t1
    return r


@wp.func
def cells_along(voxels: wp.int32) -> wp.int32:
    return (voxels + CELL - 1) // CELL


@wp.func
def cell_of(p: wp.float32, voxels: wp.int32) -> wp.int32:
    return wp.clamp(wp.int32(p) // CELL, 0, cells_along(voxels) - 1)


@wp.func
def plane_at(o: wp.float32, d: wp.float32, cell: wp.int32) -> wp.float32:
    """Where a ray crosses the plane behind a cell."""
    if d == 0.0:
        return FAR
    plane = wp.where(d > 0.0, CELL * (cell + 1), CELL * cell)
    return (wp.float32(plane) - o) / d


@wp.func
def leave_cell(r: GridRay, walk: CellWalk) -> CellWalk:
    w = walk
    tx = plane_at(r.o[0], r.d[0], w.i)
    ty = plane_at(r.o[1], r.d[1], w.j)
    tz = plane_at(r.o[2], r.d[2], w.k)
    w.axis = 0
    w.t = tx
    if ty < w.t:
        w.axis = 1
        w.t = ty
    if tz < w.t:
        w.axis = 2
        w.t = tz
    return w


@wp.func
def first_cell(g: Texture, r: GridRay) -> CellWalk:
    """The cell where a ray enters the grid's box."""
    w = CellWalk()
    p = r.o + r.t0 * r.d
    w.i = cell_of(p[0], g.width)
    w.j = cell_of(p[1], g.height)
    w.k = cell_of(p[2], g.first)
    return leave_cell(r, w)


@wp.func
def next_cell(g: Texture, r: GridRay, walk: CellWalk) -> CellWalk:
    """The cell behind; its ``axis`` is -1 where the box ends."""
    w = walk
    inside = wp.bool(True)
    if w.axis == 0:
        w.i += wp.where(r.d[0] > 0.0, 1, -1)
        inside = w.i >= 0 and w.i < cells_along(g.width)
    elif w.axis == 1:
        w.j += wp.where(r.d[1] > 0.0, 1, -1)
        inside = w.j >= 0 and w.j < cells_along(g.height)
    else:
        w.k += wp.where(r.d[2] > 0.0, 1, -1)
        inside = w.k >= 0 and w.k < cells_along(g.first)
    if inside:
        w = leave_cell(r, w)
    else:
        w.axis = -1
    return w


@wp.func
def majorant_of(values: wp.array(dtype=wp.float32), g: Texture, w: CellWalk) -> wp.float32:
    index = (w.k * cells_along(g.height) + w.j) * cells_along(g.width) + w.i
    return load_float(values, g.second + index)


@wp.func
def mean_majorant(scene: Scene, m: Medium, g: Texture, o: wp.vec3, d: wp.vec3) -> wp.float32:
    """The mean majorant from a point of a ray to the end of the grid, at least one over that length."""
    r = grid_ray(scene, g, o, d, FAR)
    depth = wp.float32(0.0)
    if not r.t0 < r.t1:
        return 0.0
    t = r.t0
    walk = first_cell(g, r)
    while t < r.t1:
        leaves = wp.clamp(walk.t, t, r.t1)
        depth += (leaves - t) * majorant_of(scene.values, g, walk)
        t = leaves
        if leaves < r.t1:
            walk = next_cell(g, r, walk)
            if walk.axis < 0:
                t = r.t1
    return wp.max(load_float(scene.values, m.scale) * depth, 1.0) / (r.t1 - r.t0)


@wp.struct
class Tentative:
    """A tentative point on a ray, or where the ray is before the first of them."""

    t: wp.float32  # the end of the stretch: there is none any more
    rate: wp.float32  # of such points there
    u: wp.float32  # a number for what is decided there
    walk: CellWalk
    slot: wp.int32  # of the last number that was drawn


@wp.func
def before_tentative(g: Texture, r: GridRay, slot: wp.int32) -> Tentative:
    """Where a ray enters the grid; the numbers of ``slot`` and of those before are not drawn."""
    p = Tentative()
    p.t = r.t0
    p.slot = slot
    p.walk = first_cell(g, r)
    return p


@wp.func
def next_tentative(
    values: wp.array(dtype=wp.float32),
    g: Texture,
    r: GridRay,
    scale: wp.float32,
    least: wp.float32,
    stream: Sampler,
    point: Tentative,
) -> Tentative:
    """The next point; the rate is ``scale`` times the majorant, and at ``least`` so much."""
    p = point
    p.slot += 1
    u = independent_2d(stream, p.slot)
    p.u = u[1]
    tau = minus_log_one_minus(u[0])
    more = p.t < r.t1
    while more:
        leaves = wp.min(p.walk.t, r.t1)
        p.rate = wp.max(scale * majorant_of(values, g, p.walk), least)
        depth = p.rate * (leaves - p.t)
        if tau < depth:
            p.t += tau / p.rate
            more = False
        else:
            tau -= wp.max(depth, 0.0)
            p.t = wp.max(leaves, p.t)
            if leaves < r.t1:
                p.walk = next_cell(g, r, p.walk)
                if p.walk.axis < 0:
                    p.t = r.t1
            more = p.t < r.t1
    return p

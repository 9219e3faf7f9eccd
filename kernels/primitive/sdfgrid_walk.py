"""The first point of a ray on the surface of a grid of signed distances.

The ray goes from voxel to voxel of a block that contains the surface, and skips at once all voxels that the reach says
are empty. It carries the sign that phi has where it starts or enters the block. Each voxel reports where that sign
ends, and not whether its own two ends differ, so no crossing is lost between two voxels. Each step moves on along one
axis, and none moves back, so there are fewer steps than nodes along the three axes.

Derivation: ``docs/theory/implicit.md#grids``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.primitive.affine import from_axes
from warp_psdr.kernels.primitive.network import network_cell, network_of, phi_along
from warp_psdr.kernels.primitive.network_roots import make_network_root
from warp_psdr.kernels.primitive.sdfgrid import (
    Grid,
    cubic_along,
    first_root,
    grid_of,
    pack,
    value_and_gradient,
    voxel_at,
    voxel_corner,
)
from warp_psdr.kernels.primitive.sdfgrid_cubic import first_crossing, spline_along, spline_field
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.structs import Scene, Triangle

#: Components of directions below which a ray does not cross voxels along an axis, voxels a unit of the ray.
STILL = 1.0e-20
UNKNOWN = wp.constant(0)
INSIDE = wp.constant(1)
OUTSIDE = wp.constant(2)


@wp.func
def reciprocal(x: wp.float32) -> wp.float32:
    """1 / x, of a finite number of its sign where x is next to 0."""
    return 1.0 / wp.where(wp.abs(x) < wp.static(STILL), wp.where(x < 0.0, -wp.static(STILL), wp.static(STILL)), x)


@wp.func
def reach_of(scene: Scene, g: Grid, i: wp.int32, j: wp.int32, k: wp.int32) -> wp.int32:
    return wp.int32(load_float(scene.values, g.reach + (k * (g.ny - 1) + j) * (g.nx - 1) + i))


@wp.struct
class VoxelRay:
    """A ray in voxels along the axes, from where it enters the block; distances are in units of its direction."""

    p: wp.vec3
    w: wp.vec3
    inverse: wp.vec3  # of w
    near: wp.float32  # distance to p
    end: wp.float32  # distance from p to the end; it may be negative


@wp.struct
class VoxelPlace:
    """Where a ray is among the voxels."""

    s: wp.float32  # distance from where it entered the block
    i: wp.int32
    j: wp.int32
    k: wp.int32
    walks: wp.int32  # 0: it has come to its end, or left the block
    sign: wp.int32  # of phi, which the ray carries: INSIDE, OUTSIDE, or UNKNOWN up to the first voxel that is passed


@wp.func
def voxel_ray(tri: Triangle, g: Grid, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> VoxelRay:
    r = VoxelRay()
    start = wp.cw_mul(g.cells, from_axes(tri, o - tri.normal))
    r.w = wp.cw_mul(g.cells, from_axes(tri, d))
    r.inverse = wp.vec3(reciprocal(r.w[0]), reciprocal(r.w[1]), reciprocal(r.w[2]))
    a = wp.cw_mul(g.low - start, r.inverse)
    b = wp.cw_mul(g.high - start, r.inverse)
    r.near = wp.max(wp.max(wp.min(a, b)), 0.0)
    r.end = wp.min(wp.min(wp.max(a, b)), t_max) - r.near
    # Distances are counted from here on.
    r.p = wp.max(wp.min(start + r.near * r.w, g.high), g.low)
    return r


@wp.func
def enter_grid(g: Grid, r: VoxelRay) -> VoxelPlace:
    at = VoxelPlace()
    # In this order, for rays that are not finite, and grids whose block is empty.
    at.i = wp.max(wp.min(wp.int32(r.p[0]), wp.int32(g.high[0]) - 1), wp.int32(g.low[0]))
    at.j = wp.max(wp.min(wp.int32(r.p[1]), wp.int32(g.high[1]) - 1), wp.int32(g.low[1]))
    at.k = wp.max(wp.min(wp.int32(r.p[2]), wp.int32(g.high[2]) - 1), wp.int32(g.low[2]))
    at.walks = wp.where(r.end > 0.0 and g.low[0] < g.high[0], 1, 0)
    return at


@wp.func
def voxel_plane(i: wp.int32, more: wp.int32, p: wp.float32, inverse: wp.float32) -> wp.float32:
    """Distance along an axis to the plane behind a block of ``more`` voxels around the ``i``-th."""
    return (wp.float32(wp.where(inverse > 0.0, i + 1 + more, i - more)) - p) * inverse


@wp.func
def leaves_at(r: VoxelRay, at: VoxelPlace, more: wp.int32) -> wp.float32:
    """Distance at which a ray leaves such a block, or ends in it."""
    tx = voxel_plane(at.i, more, r.p[0], r.inverse[0])
    ty = voxel_plane(at.j, more, r.p[1], r.inverse[1])
    tz = voxel_plane(at.k, more, r.p[2], r.inverse[2])
    return wp.max(wp.min(wp.min(tx, ty), wp.min(tz, r.end)), at.s)


@wp.func
def next_voxel(i: wp.int32, inverse: wp.float32, more: wp.int32, x: wp.float32, crossed: wp.bool) -> wp.int32:
    """The index behind a block of ``more`` voxels around the ``i``-th, left at x, whether or not through this axis."""
    forward = inverse > 0.0
    low = wp.where(forward, i, i - more)
    return wp.where(crossed, wp.where(forward, i + 1 + more, i - 1 - more), wp.clamp(wp.int32(x), low, low + more))


@wp.func
def walk_on(g: Grid, r: VoxelRay, at: VoxelPlace, more: wp.int32) -> VoxelPlace:
    """The voxel behind a block of ``more`` voxels to every side. Without a branch, for loops over lanes."""
    tx = voxel_plane(at.i, more, r.p[0], r.inverse[0])
    ty = voxel_plane(at.j, more, r.p[1], r.inverse[1])
    tz = voxel_plane(at.k, more, r.p[2], r.inverse[2])
    along_x = tx <= ty and tx <= tz
    along_y = not along_x and ty <= tz
    n = at
    n.s = leaves_at(r, at, more)
    n.i = next_voxel(at.i, r.inverse[0], more, r.p[0] + n.s * r.w[0], along_x)
    n.j = next_voxel(at.j, r.inverse[1], more, r.p[1] + n.s * r.w[1], along_y)
    n.k = next_voxel(at.k, r.inverse[2], more, r.p[2] + n.s * r.w[2], not along_x and not along_y)
    above = n.i >= wp.int32(g.low[0]) and n.j >= wp.int32(g.low[1]) and n.k >= wp.int32(g.low[2])
    below = n.i < wp.int32(g.high[0]) and n.j < wp.int32(g.high[1]) and n.k < wp.int32(g.high[2])
    n.walks = wp.where(above and below and n.s < r.end, 1, 0)
    return n


@wp.func
def network_reach(scene: Scene, g: Grid, i: wp.int32, j: wp.int32, k: wp.int32) -> wp.int32:
    return wp.max(wp.int32(network_cell(scene, g, i, j, k)), 0)


@wp.struct
class GridRoot:
    """What a ray meets in a voxel, and the sign behind."""

    t: wp.float32  # -1: nothing
    q: wp.vec2  # the point, as a vertex holds it
    sign: wp.int32


class GridWalk(NamedTuple):
    """What the kinds of grids have in common.

    Attributes:
        record: ``(scene, tri) -> Grid``.
        reach: ``(scene, g, i, j, k) -> int``, of a voxel.
        root: ``(scene, g, ray, at) -> GridRoot``, in a voxel that the surface may pass.
    """

    record: wp.Function
    reach: wp.Function
    root: wp.Function


@functools.cache
def make_grid_walk(cubic: bool, network: bool = False) -> GridWalk:
    """Return the functions; arguments as ``make_sdfgrid_hit``'s."""
    first_of_network = make_network_root(False) if network else None

    @wp.func
    def sign_before(scene: Scene, g: Grid, r: VoxelRay, at: VoxelPlace) -> wp.int32:
        """The sign that phi has where the ray enters; UNKNOWN: what follows tells.

        A voxel that the surface does not pass has one sign.
        """
        inside = wp.bool(False)
        n = enter_grid(g, r)
        passed = n.i == at.i and n.j == at.j and n.k == at.k
        if wp.static(network):
            return UNKNOWN
        elif wp.static(cubic):
            if passed:
                return UNKNOWN
            inside = spline_field(scene, g, n.i, n.j, n.k, r.p - voxel_corner(n.i, n.j, n.k))[3] < 0.0
        elif passed:
            inside = value_and_gradient(voxel_at(scene, g, n.i, n.j, n.k), r.p - voxel_corner(n.i, n.j, n.k))[3] < 0.0
        else:
            inside = load_float(scene.values, g.first + (n.k * g.ny + n.j) * g.nx + n.i) < 0.0
        return wp.where(inside, INSIDE, OUTSIDE)

    @wp.func
    def root_in(scene: Scene, g: Grid, r: VoxelRay, at: VoxelPlace) -> GridRoot:
        sign = at.sign
        if sign == UNKNOWN:
            sign = sign_before(scene, g, r, at)
        out = leaves_at(r, at, 0)
        cell = voxel_corner(at.i, at.j, at.k)
        x = r.p + at.s * r.w - cell
        way = (out - at.s) * r.w
        root = wp.float32(-1.0)
        if wp.static(network):
            place = wp.cw_div(r.p + at.s * r.w, g.cells)
            over = wp.cw_div(way, g.cells)
            if sign == UNKNOWN:
                # Up to here phi has one sign.
                sign = wp.where(phi_along(scene.values, g.first, place, over)[0] < 0.0, INSIDE, OUTSIDE)
            bend = -wp.dot(over, over) * network_cell(scene, g, at.i, at.j, at.k)
            first, _count = first_of_network(scene, g.first, place, over, bend, sign == INSIDE, 0.0)
            root = first
        elif wp.static(cubic):
            along, size = spline_along(scene, g, at.i, at.j, at.k, x, way)
            if sign == UNKNOWN:
                # By the same arithmetic as what follows.
                sign = wp.where(along[0] < 0.0, INSIDE, OUTSIDE)
            root = first_crossing(along, size, sign == INSIDE)
        else:
            root = first_root(cubic_along(voxel_at(scene, g, at.i, at.j, at.k), x, way), sign == INSIDE)
        found = GridRoot()
        found.t = -1.0
        found.sign = sign
        if root >= 0.0:
            found.t = r.near + at.s + root * (out - at.s)
            found.q = pack(wp.cw_div(cell + x + root * way, g.cells))
        return found

    return GridWalk(network_of if network else grid_of, network_reach if network else reach_of, root_in)


@functools.cache
def make_sdfgrid_hit(cubic: bool, network: bool = False):
    """Return ``hit(scene, tri, o, d, t_max) -> RayHit``, 0 <= t < t_max; ``face`` is -1 if there is none.

    Args:
        cubic: of a smooth grid.
        network: of a network, whose cells are voxels.
    """
    walk = make_grid_walk(cubic, network)

    @wp.func
    def sdfgrid_hit(scene: Scene, tri: Triangle, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
        hit = RayHit()
        hit.t = t_max
        hit.face = -1
        g = walk.record(scene, tri)
        ray = voxel_ray(tri, g, o, d, t_max)
        at = enter_grid(g, ray)
        while at.walks == 1:
            reach = walk.reach(scene, g, at.i, at.j, at.k)
            if reach == 0:
                root = walk.root(scene, g, ray, at)
                if root.t >= 0.0:
                    if root.t < t_max:
                        hit.t = root.t
                        hit.u = root.q[0]
                        hit.v = root.q[1]
                        hit.face = 0
                    return hit
                at.sign = root.sign
            at = walk_on(g, ray, at, wp.max(reach - 1, 0))
        return hit

    return sdfgrid_hit

"""The first point of a ray on the surface of a grid of signed distances.

The ray goes from voxel to voxel, over all at once that its reach says are empty. It carries the sign that phi has where
it starts, or enters the box, and a voxel is asked where that sign ends, not whether its own two ends differ: no
crossing is lost between two voxels. Each step moves on along one axis, and none moves back along any, so there are
fewer steps than nodes along the three axes.

Derivation: ``docs/theory/implicit.md#grids``.
"""

import functools

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
)
from warp_psdr.kernels.primitive.sdfgrid_cubic import first_crossing, spline_along, spline_field
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.structs import Scene, Triangle

#: Components of directions below which a ray does not cross voxels along an axis, voxels a unit of the ray.
STILL = 1.0e-20


@wp.func
def reciprocal(x: wp.float32) -> wp.float32:
    """1 / x, of a finite number of its sign where x is next to 0."""
    return 1.0 / wp.where(wp.abs(x) < wp.static(STILL), wp.where(x < 0.0, -wp.static(STILL), wp.static(STILL)), x)


@wp.func
def reach_of(scene: Scene, g: Grid, i: wp.int32, j: wp.int32, k: wp.int32) -> wp.int32:
    return wp.int32(load_float(scene.values, g.reach + (k * (g.ny - 1) + j) * (g.nx - 1) + i))


@wp.func
def next_voxel(i: wp.int32, forward: wp.int32, more: wp.int32, x: wp.float32, crossed: wp.bool) -> wp.int32:
    """The index behind a block of ``more`` voxels around the ``i``-th, left at x, whether or not through this axis."""
    if crossed:
        return wp.where(forward == 1, i + 1 + more, i - 1 - more)
    return wp.where(forward == 1, wp.clamp(wp.int32(x), i, i + more), wp.clamp(wp.int32(x), i - more, i))


@wp.func
def network_reach(scene: Scene, g: Grid, i: wp.int32, j: wp.int32, k: wp.int32) -> wp.int32:
    return wp.max(wp.int32(network_cell(scene, g, i, j, k)), 0)


@functools.cache
def make_sdfgrid_hit(cubic: bool, network: bool = False):
    """Return ``hit(scene, tri, o, d, t_max) -> RayHit``, 0 <= t < t_max; ``face`` is -1 if there is none.

    Args:
        cubic: of a smooth grid.
        network: of a network, whose cells are voxels.
    """
    record_of = network_of if network else grid_of
    reach_at = network_reach if network else reach_of
    first_of_network = make_network_root(False) if network else None

    @wp.func
    def sdfgrid_hit(scene: Scene, tri: Triangle, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
        hit = RayHit()
        hit.t = t_max
        hit.face = -1
        g = record_of(scene, tri)
        start = wp.cw_mul(g.cells, from_axes(tri, o - tri.normal))
        w = wp.cw_mul(g.cells, from_axes(tri, d))
        inverse = wp.vec3(reciprocal(w[0]), reciprocal(w[1]), reciprocal(w[2]))
        a = wp.cw_mul(-start, inverse)
        b = wp.cw_mul(g.cells - start, inverse)
        near = wp.max(wp.max(wp.min(a, b)), 0.0)
        end = wp.min(wp.min(wp.max(a, b)), t_max) - near
        if not (end > 0.0):
            return hit
        # From here distances are counted from where the ray enters the box.
        p = wp.max(wp.min(start + near * w, g.cells), wp.vec3(0.0, 0.0, 0.0))
        i = wp.clamp(wp.int32(p[0]), 0, g.nx - 2)
        j = wp.clamp(wp.int32(p[1]), 0, g.ny - 2)
        k = wp.clamp(wp.int32(p[2]), 0, g.nz - 2)
        si = wp.where(inverse[0] > 0.0, 1, 0)
        sj = wp.where(inverse[1] > 0.0, 1, 0)
        sk = wp.where(inverse[2] > 0.0, 1, 0)
        reach = reach_at(scene, g, i, j, k)
        # A voxel that the surface does not pass has one sign.
        inside = wp.bool(False)
        starts = wp.bool(False)
        cell = wp.vec3(wp.float32(i), wp.float32(j), wp.float32(k))
        if wp.static(network):
            starts = wp.bool(True)
        elif wp.static(cubic):
            starts = reach == 0
            if reach > 0:
                inside = spline_field(scene, g, i, j, k, p - cell)[3] < 0.0
        else:
            inside = load_float(scene.values, g.first + (k * g.ny + j) * g.nx + i) < 0.0
            if reach == 0:
                inside = value_and_gradient(voxel_at(scene, g, i, j, k), p - cell)[3] < 0.0
        s = wp.float32(0.0)
        while s < end and i >= 0 and j >= 0 and k >= 0 and i < g.nx - 1 and j < g.ny - 1 and k < g.nz - 1:
            reach = reach_at(scene, g, i, j, k)
            # Voxels besides this one, to every side, that are passed at once.
            more = wp.max(reach - 1, 0)
            tx = (wp.float32(wp.where(si == 1, i + 1 + more, i - more)) - p[0]) * inverse[0]
            ty = (wp.float32(wp.where(sj == 1, j + 1 + more, j - more)) - p[1]) * inverse[1]
            tz = (wp.float32(wp.where(sk == 1, k + 1 + more, k - more)) - p[2]) * inverse[2]
            out = wp.max(wp.min(wp.min(tx, ty), wp.min(tz, end)), s)
            if reach == 0:
                cell = wp.vec3(wp.float32(i), wp.float32(j), wp.float32(k))
                x = p + s * w - cell
                way = (out - s) * w
                root = wp.float32(-1.0)
                if wp.static(network):
                    at = wp.cw_div(p + s * w, g.cells)
                    over = wp.cw_div(way, g.cells)
                    if starts:
                        # Up to here phi has one sign.
                        inside = phi_along(scene.values, g.first, at, over)[0] < 0.0
                        starts = False
                    bend = -wp.dot(over, over) * network_cell(scene, g, i, j, k)
                    first, _count = first_of_network(scene, g.first, at, over, bend, inside, 0.0)
                    root = first
                elif wp.static(cubic):
                    along, size = spline_along(scene, g, i, j, k, x, way)
                    if starts:
                        # By the same arithmetic as what follows.
                        inside = along[0] < 0.0
                        starts = False
                    root = first_crossing(along, size, inside)
                else:
                    root = first_root(cubic_along(voxel_at(scene, g, i, j, k), x, way), inside)
                if root >= 0.0:
                    t = near + s + root * (out - s)
                    if t < t_max:
                        q = pack(wp.cw_div(cell + x + root * way, g.cells))
                        hit.t = t
                        hit.u = q[0]
                        hit.v = q[1]
                        hit.face = 0
                    return hit
            s = out
            along_x = tx <= ty and tx <= tz
            along_y = not along_x and ty <= tz
            i = next_voxel(i, si, more, p[0] + s * w[0], along_x)
            j = next_voxel(j, sj, more, p[1] + s * w[1], along_y)
            k = next_voxel(k, sk, more, p[2] + s * w[2], not along_x and not along_y)
        return hit

    return sdfgrid_hit

"""The point of a grid of signed distances that a vertex holds, and its normals (``sdfgrid.py``).

Derivation: ``docs/theory/implicit.md#grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.primitive.affine import cofactor, from_axes, to_axes
from warp_psdr.kernels.primitive.sdfgrid import (
    Grid,
    Voxel,
    grid_of,
    unpack,
    value_and_gradient,
    voxel_at,
    voxel_corner,
)
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import Surface

#: Distance over the size of the box by which decoded points are moved onto the surface, at most.
NEAREST = 1.2e-6


@wp.func
def slope_along(scene: Scene, first: wp.int32, stride: wp.int32, at: wp.int32, nodes: wp.int32) -> wp.float32:
    """Difference of two neighbours along an axis; 0 outside."""
    inside = at >= 0 and at < nodes - 1
    place = first + wp.clamp(at, 0, nodes - 2) * stride
    return wp.where(inside, load_float(scene.values, place + stride) - load_float(scene.values, place), 0.0)


@wp.func
def slope_of_slab(
    scene: Scene,
    at: wp.int32,
    stride: wp.int32,
    nodes: wp.int32,
    first: wp.int32,
    stride_a: wp.int32,
    stride_b: wp.int32,
    a: wp.float32,
    b: wp.float32,
) -> wp.float32:
    """Difference across a slab of voxels, bi-linear in the places (a, b) along the two other axes."""
    return wp.lerp(
        wp.lerp(
            slope_along(scene, first, stride, at, nodes),
            slope_along(scene, first + stride_a, stride, at, nodes),
            a,
        ),
        wp.lerp(
            slope_along(scene, first + stride_b, stride, at, nodes),
            slope_along(scene, first + stride_a + stride_b, stride, at, nodes),
            a,
        ),
        b,
    )


@wp.func
def blend(at: wp.int32, nodes: wp.int32, p: wp.float32) -> wp.float32:
    """Weight of the voxel ``at`` + 1 between the centres of that and of ``at``; a voxel outside has none."""
    return wp.where(at < 0, 1.0, wp.where(at > nodes - 3, 0.0, p - wp.float32(at) - 0.5))


@wp.func
def smooth_gradient(scene: Scene, g: Grid, p: wp.vec3, i: wp.int32, j: wp.int32, k: wp.int32) -> wp.vec3:
    """Normals of the voxels around p, each continued to p, interpolated between the centres of the voxels [HEA22]."""
    sy = g.nx
    sz = g.nx * g.ny
    x = p[0] - wp.float32(i)
    y = p[1] - wp.float32(j)
    z = p[2] - wp.float32(k)
    # The first of the two voxels along each axis whose centres p lies between.
    ci = wp.int32(wp.floor(p[0] + 0.5)) - 1
    cj = wp.int32(wp.floor(p[1] + 0.5)) - 1
    ck = wp.int32(wp.floor(p[2] + 0.5)) - 1
    row_x = g.first + j * sy + k * sz
    row_y = g.first + i + k * sz
    row_z = g.first + i + j * sy
    x0 = slope_of_slab(scene, ci, 1, g.nx, row_x, sy, sz, y, z) * g.cells[0]
    x1 = slope_of_slab(scene, ci + 1, 1, g.nx, row_x, sy, sz, y, z) * g.cells[0]
    y0 = slope_of_slab(scene, cj, sy, g.ny, row_y, 1, sz, x, z) * g.cells[1]
    y1 = slope_of_slab(scene, cj + 1, sy, g.ny, row_y, 1, sz, x, z) * g.cells[1]
    z0 = slope_of_slab(scene, ck, sz, g.nz, row_z, 1, sy, x, y) * g.cells[2]
    z1 = slope_of_slab(scene, ck + 1, sz, g.nz, row_z, 1, sy, x, y) * g.cells[2]
    u = blend(ci, g.nx, p[0])
    v = blend(cj, g.ny, p[1])
    w = blend(ck, g.nz, p[2])
    n00 = (1.0 - u) * wp.normalize(wp.vec3(x0, y0, z0)) + u * wp.normalize(wp.vec3(x1, y0, z0))
    n10 = (1.0 - u) * wp.normalize(wp.vec3(x0, y1, z0)) + u * wp.normalize(wp.vec3(x1, y1, z0))
    n01 = (1.0 - u) * wp.normalize(wp.vec3(x0, y0, z1)) + u * wp.normalize(wp.vec3(x1, y0, z1))
    n11 = (1.0 - u) * wp.normalize(wp.vec3(x0, y1, z1)) + u * wp.normalize(wp.vec3(x1, y1, z1))
    return (1.0 - w) * ((1.0 - v) * n00 + v * n10) + w * ((1.0 - v) * n01 + v * n11)


@wp.struct
class GridPoint:
    """A point of the surface, in voxels along the axes."""

    p: wp.vec3
    i: wp.int32  # the voxel
    j: wp.int32
    k: wp.int32
    voxel: Voxel
    gradient: wp.vec3  # of phi by p


@wp.func
def held_point(scene: Scene, g: Grid, u: wp.float32, v: wp.float32) -> GridPoint:
    """The point that a vertex holds, put back onto the surface."""
    r = GridPoint()
    p = wp.cw_mul(g.cells, unpack(u, v))
    r.i = wp.clamp(wp.int32(p[0]), 0, g.nx - 2)
    r.j = wp.clamp(wp.int32(p[1]), 0, g.ny - 2)
    r.k = wp.clamp(wp.int32(p[2]), 0, g.nz - 2)
    cell = voxel_corner(r.i, r.j, r.k)
    r.voxel = voxel_at(scene, g, r.i, r.j, r.k)
    found = value_and_gradient(r.voxel, p - cell)
    gradient = wp.vec3(found[0], found[1], found[2])
    # What the fixed-point coordinates cut off: along the gradient.
    steepest = wp.max(wp.length(gradient), 1.0e-30)
    limit = wp.static(NEAREST) * wp.max(g.cells)
    p -= (wp.clamp(found[3] / steepest, -limit, limit) / steepest) * gradient
    found = value_and_gradient(r.voxel, p - cell)
    r.p = p
    r.gradient = wp.vec3(found[0], found[1], found[2])
    return r


@wp.func
def sdfgrid_normal(scene: Scene, tri: Triangle, x: wp.vec3) -> wp.vec3:
    """The geometric normal, of any length, at a point of the surface in the world."""
    g = grid_of(scene, tri)
    p = wp.cw_mul(g.cells, from_axes(tri, x - tri.normal))
    i = wp.clamp(wp.int32(p[0]), 0, g.nx - 2)
    j = wp.clamp(wp.int32(p[1]), 0, g.ny - 2)
    k = wp.clamp(wp.int32(p[2]), 0, g.nz - 2)
    found = value_and_gradient(voxel_at(scene, g, i, j, k), p - voxel_corner(i, j, k))
    return wp.float32(tri.i2) * cofactor(tri, wp.cw_mul(g.cells, wp.vec3(found[0], found[1], found[2])))


@functools.cache
def make_sdfgrid_surface(tangent: bool):
    """Return ``surface_of(scene, tri, u, v) -> Surface``; ``tangent``: any direction in the surface, there is no u."""

    @wp.func
    def sdfgrid_surface(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> Surface:
        g = grid_of(scene, tri)
        at = held_point(scene, g, u, v)
        turn = wp.float32(tri.i2)
        s = Surface()
        s.x = tri.normal + to_axes(tri, wp.cw_div(at.p, g.cells))
        s.ng = turn * wp.normalize(cofactor(tri, wp.cw_mul(g.cells, at.gradient)))
        s.n = s.ng
        if g.smooth == 1:
            n = wp.normalize(cofactor(tri, smooth_gradient(scene, g, at.p, at.i, at.j, at.k)))
            if wp.dot(n, n) > 0.0:
                s.n = turn * n
        s.shape = tri.shape
        s.length = -1.0
        if wp.static(tangent):
            s.tangent = any_tangent(s.n)
        return s

    return sdfgrid_surface

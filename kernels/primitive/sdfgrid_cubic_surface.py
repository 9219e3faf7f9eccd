"""The point of a smooth grid of signed distances that a vertex holds, its normal, and the sinks for adjoints of phi.

A vertex slides along the ray that found it, and a ray that leaves is tied to the surface, as on other grids (form S,
``sdfgrid_adjoint.py``). The normal is that of the gradient alone and turns with the position by the Hessian.

Derivation: ``docs/theory/implicit.md#form-s``.
"""

import functools

import warp as wp

from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.primitive.affine import cofactor, from_axes, to_axes
from warp_psdr.kernels.primitive.sdfgrid import Grid, grid_of, unpack
from warp_psdr.kernels.primitive.sdfgrid_cubic import spline_field, spline_rates, spline_weights
from warp_psdr.kernels.primitive.sdfgrid_surface import NEAREST, voxel_corner
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import Surface


@wp.struct
class SplinePoint:
    """A point of the surface, in voxels along the axes."""

    p: wp.vec3
    i: wp.int32  # the voxel
    j: wp.int32
    k: wp.int32
    gradient: wp.vec3  # of phi by p


@wp.func
def spline_point(scene: Scene, g: Grid, u: wp.float32, v: wp.float32) -> SplinePoint:
    """The point that a vertex holds, put back onto the surface."""
    r = SplinePoint()
    p = wp.cw_mul(g.cells, unpack(u, v))
    r.i = wp.clamp(wp.int32(p[0]), 0, g.nx - 2)
    r.j = wp.clamp(wp.int32(p[1]), 0, g.ny - 2)
    r.k = wp.clamp(wp.int32(p[2]), 0, g.nz - 2)
    cell = voxel_corner(r.i, r.j, r.k)
    found = spline_field(scene, g, r.i, r.j, r.k, p - cell)
    gradient = wp.vec3(found[0], found[1], found[2])
    # What the fixed-point coordinates cut off: along the gradient.
    steepest = wp.max(wp.length(gradient), 1.0e-30)
    limit = wp.static(NEAREST) * wp.max(g.cells)
    p -= (wp.clamp(found[3] / steepest, -limit, limit) / steepest) * gradient
    found = spline_field(scene, g, r.i, r.j, r.k, p - cell)
    r.p = p
    r.gradient = wp.vec3(found[0], found[1], found[2])
    return r


@wp.func
def sdfgrid_cubic_normal(scene: Scene, tri: Triangle, x: wp.vec3) -> wp.vec3:
    """The normal, of any length, at a point of the surface in the world."""
    g = grid_of(scene, tri)
    p = wp.cw_mul(g.cells, from_axes(tri, x - tri.normal))
    i = wp.clamp(wp.int32(p[0]), 0, g.nx - 2)
    j = wp.clamp(wp.int32(p[1]), 0, g.ny - 2)
    k = wp.clamp(wp.int32(p[2]), 0, g.nz - 2)
    found = spline_field(scene, g, i, j, k, p - voxel_corner(i, j, k))
    return wp.float32(tri.i2) * cofactor(tri, wp.cw_mul(g.cells, wp.vec3(found[0], found[1], found[2])))


@functools.cache
def make_sdfgrid_cubic_surface(tangent: bool):
    """Return ``surface_of(scene, tri, u, v) -> Surface``; ``tangent``: any direction in the surface, there is no u."""

    @wp.func
    def sdfgrid_cubic_surface(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> Surface:
        g = grid_of(scene, tri)
        at = spline_point(scene, g, u, v)
        s = Surface()
        s.x = tri.normal + to_axes(tri, wp.cw_div(at.p, g.cells))
        s.ng = wp.float32(tri.i2) * wp.normalize(cofactor(tri, wp.cw_mul(g.cells, at.gradient)))
        s.n = s.ng
        s.shape = tri.shape
        s.length = -1.0
        if wp.static(tangent):
            s.tangent = any_tangent(s.n)
        return s

    return sdfgrid_cubic_surface


@functools.cache
def make_spline_sink(role: str):
    """Return ``accumulate(target, g, i, j, k, x, a_phi, a_gradient) -> float`` at the place x in a voxel, [0, 1]^3.

    ``a_phi`` is the adjoint of phi there, ``a_gradient`` that of its gradient, in voxels; both go to 64 values, some of
    which are one at the border.
    """
    sink = make_sink(role)

    @wp.func
    def accumulate_spline(
        target: wp.array(dtype=wp.float32),
        g: Grid,
        i: wp.int32,
        j: wp.int32,
        k: wp.int32,
        x: wp.vec3,
        a_phi: wp.float32,
        a_gradient: wp.vec3,
    ) -> wp.float32:
        wx = spline_weights(x[0])
        wy = spline_weights(x[1])
        wz = spline_weights(x[2])
        along = a_phi * wx + a_gradient[0] * spline_rates(x[0])
        dy = a_gradient[1] * spline_rates(x[1])
        dz = a_gradient[2] * spline_rates(x[2])
        total = wp.float32(0.0)
        row = wp.int32(0)
        while row < 16:
            b = row & 3
            c = row >> 2
            first = wp.clamp(k + c - 1, 0, g.nz - 1) * g.ny + wp.clamp(j + b - 1, 0, g.ny - 1)
            first = g.first + first * g.nx
            value = (wy[b] * wz[c]) * along + (dy[b] * wz[c] + wy[b] * dz[c]) * wx
            total += sink(target, first + wp.max(i - 1, 0), value[0])
            total += sink(target, first + i, value[1])
            total += sink(target, first + i + 1, value[2])
            total += sink(target, first + wp.min(i + 2, g.nx - 1), value[3])
            row += 1
        return total

    return accumulate_spline

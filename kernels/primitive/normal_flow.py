"""Vertices that flow along continuous normals: the rates of the area element and of the normal [ZCM*24].

With V = -phi' / |grad Phi| the speed by the values along the normal n, and the pose's own motion u, linear in the
position, a vertex has the velocity V n + u. The normal c that carries the area element, of unit length, changes by

    c' = V div n n - grad_S V + u's part,        div n = tr (P H) / |grad Phi|,

where u acts as an affine map does on a fixed surface (``affine.py``). In [ZCM*24] u is 0, V comes from everything that
moves, and J' = V div n is the rate of the length of c.

Derivation: ``docs/theory/implicit.md#normal-flow``.
"""

import functools

import warp as wp

from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.primitive.affine import cofactor, determinant, from_axes
from warp_psdr.kernels.primitive.network_surface import network_bend
from warp_psdr.kernels.primitive.sdfgrid import Grid
from warp_psdr.kernels.primitive.sdfgrid_cubic import spline_hessian
from warp_psdr.kernels.primitive.sdfgrid_cubic_surface import SplinePoint
from warp_psdr.kernels.primitive.sdfgrid_surface import voxel_corner
from warp_psdr.kernels.structs import Scene, Triangle


@wp.struct
class FlowAdjoint:
    """Adjoints of phi and of its gradient, in cells, and of the columns of the pose."""

    phi: wp.float32
    gradient: wp.vec3
    g0: wp.vec3
    g1: wp.vec3
    g2: wp.vec3


@functools.cache
def make_flow_pull(network: bool):
    """Return ``pull(scene, tri, g, at, a_c, a_n) -> FlowAdjoint``: adjoints of c and of the unit normal at a vertex."""

    @wp.func
    def bend_of_world(scene: Scene, tri: Triangle, g: Grid, at: SplinePoint, w: wp.vec3) -> wp.vec3:
        """The Hessian by world coordinates times w."""
        way = wp.cw_mul(g.cells, from_axes(tri, w))
        bent = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(network):
            bent = network_bend(scene, g, at.p, way)
        else:
            bent = spline_hessian(scene, g, at.i, at.j, at.k, at.p - voxel_corner(at.i, at.j, at.k)) * way
        return (1.0 / determinant(tri)) * cofactor(tri, wp.cw_mul(g.cells, bent))

    @wp.func
    def pull_flow(scene: Scene, tri: Triangle, g: Grid, at: SplinePoint, a_c: wp.vec3, a_n: wp.vec3) -> FlowAdjoint:
        r = FlowAdjoint()
        if wp.dot(a_c, a_c) + wp.dot(a_n, a_n) == 0.0:
            return r
        slope = wp.cw_mul(g.cells, at.gradient)
        outer = cofactor(tri, slope)
        length = wp.max(wp.length(outer), 1.0e-30)
        c = (wp.float32(tri.i2) / length) * outer
        a = a_c + a_n - wp.dot(a_n, c) * c
        # ---- The pose: c = cof(A) m, m held ----
        m = slope / length
        b = wp.float32(tri.i2) * a
        r.g0 = wp.cross(m[2] * tri.p1 - m[1] * tri.p2, b)
        r.g1 = wp.cross(m[0] * tri.p2 - m[2] * tri.p0, b)
        r.g2 = wp.cross(m[1] * tri.p0 - m[0] * tri.p1, b)
        # ---- The values: n = +-c is the way of the gradient ----
        det = determinant(tri)
        steep = length / wp.abs(det)
        n = (wp.sign(det) / length) * outer
        a = wp.float32(tri.i2) * wp.sign(det) * a
        s = any_tangent(n)
        t = wp.cross(n, s)
        hs = bend_of_world(scene, tri, g, at, s)
        ht = bend_of_world(scene, tri, g, at, t)
        a_v = wp.dot(a, n) * (wp.dot(s, hs) + wp.dot(t, ht)) / steep
        along = a - wp.dot(a, n) * n
        # grad_S V = -(grad phi')_S / |grad Phi| + phi' (H n)_S / |grad Phi|^2, the adjoint of which is -along.
        r.phi = -a_v / steep - (wp.dot(along, s) * wp.dot(n, hs) + wp.dot(along, t) * wp.dot(n, ht)) / (steep * steep)
        r.gradient = wp.cw_mul(g.cells, from_axes(tri, along / steep))
        return r

    return pull_flow

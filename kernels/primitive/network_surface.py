"""The point of a network's surface that a vertex holds, its normal, and the sinks for adjoints of phi.

A vertex slides along the ray that found it, and a ray that leaves is tied to the surface, as on grids (form S,
``docs/theory/implicit.md#form-s``, ``sdfgrid_adjoint.py``). The normal is that of the gradient and turns with the
position by the Hessian.

Derivation: ``docs/theory/implicit.md#networks``.
"""

import functools

import warp as wp

from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.primitive.affine import cofactor, from_axes, to_axes
from warp_psdr.kernels.primitive.network import make_network_sink, network_of, pull_phi
from warp_psdr.kernels.primitive.sdfgrid import Grid, unpack
from warp_psdr.kernels.primitive.sdfgrid_cubic_surface import SplinePoint
from warp_psdr.kernels.primitive.sdfgrid_surface import NEAREST
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import Surface


@wp.func
def network_field(scene: Scene, g: Grid, q: wp.vec3) -> wp.vec4:
    """(gradient, phi) at a point of the box."""
    return pull_phi(scene.values, g.first, q, 1.0, wp.vec3(0.0, 0.0, 0.0))


@wp.func
def network_point(scene: Scene, g: Grid, u: wp.float32, v: wp.float32) -> SplinePoint:
    """The point that a vertex holds, put back onto the surface; lengths and the gradient in cells."""
    r = SplinePoint()
    q = unpack(u, v)
    found = network_field(scene, g, q)
    gradient = wp.vec3(found[0], found[1], found[2])
    # What the fixed-point coordinates cut off: along the gradient.
    steepest = wp.max(wp.length(gradient), 1.0e-30)
    q -= (wp.clamp(found[3] / steepest, -wp.static(NEAREST), wp.static(NEAREST)) / steepest) * gradient
    found = network_field(scene, g, q)
    r.p = wp.cw_mul(g.cells, q)
    r.i = wp.clamp(wp.int32(r.p[0]), 0, g.nx - 2)
    r.j = wp.clamp(wp.int32(r.p[1]), 0, g.ny - 2)
    r.k = wp.clamp(wp.int32(r.p[2]), 0, g.nz - 2)
    r.gradient = wp.cw_div(wp.vec3(found[0], found[1], found[2]), g.cells)
    return r


@wp.func
def network_normal(scene: Scene, tri: Triangle, x: wp.vec3) -> wp.vec3:
    """The normal, of any length, at a point of the surface in the world."""
    found = network_field(scene, network_of(scene, tri), from_axes(tri, x - tri.normal))
    return wp.float32(tri.i2) * cofactor(tri, wp.vec3(found[0], found[1], found[2]))


@functools.cache
def make_network_surface(tangent: bool):
    """Return ``surface_of(scene, tri, u, v) -> Surface``; ``tangent``: any direction in the surface, there is no u."""

    @wp.func
    def network_surface(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> Surface:
        g = network_of(scene, tri)
        at = network_point(scene, g, u, v)
        s = Surface()
        s.x = tri.normal + to_axes(tri, wp.cw_div(at.p, g.cells))
        s.ng = wp.float32(tri.i2) * wp.normalize(cofactor(tri, wp.cw_mul(g.cells, at.gradient)))
        s.n = s.ng
        s.shape = tri.shape
        s.length = -1.0
        if wp.static(tangent):
            s.tangent = any_tangent(s.n)
        return s

    return network_surface


@wp.func
def network_bend(scene: Scene, g: Grid, p: wp.vec3, w: wp.vec3) -> wp.vec3:
    """H w at a place p, both and the Hessian in cells."""
    found = pull_phi(scene.values, g.first, wp.cw_div(p, g.cells), 0.0, wp.cw_div(w, g.cells))
    return wp.cw_div(wp.vec3(found[0], found[1], found[2]), g.cells)


@functools.cache
def make_cell_sink(role: str):
    """Return ``accumulate(scene, target, g, p, a_phi, a_gradient) -> float``: adjoints at a place p, in cells."""
    accumulate_network = make_network_sink(role)

    @wp.func
    def accumulate_cell(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        g: Grid,
        p: wp.vec3,
        a_phi: wp.float32,
        a_gradient: wp.vec3,
    ) -> wp.float32:
        q = wp.cw_div(p, g.cells)
        return accumulate_network(scene.values, target, g.first, q, a_phi, wp.cw_div(a_gradient, g.cells))

    return accumulate_cell

"""The rate of the unit normal as a point moves over a shape without triangles: n' = (1 - n n^T) H x' / |grad phi|.

The shape is at rest. The adjoints of vertices contain the part that the shape's own motion adds (``dispatch.py``).

Derivation: ``docs/theory/specular.md#mirrors-and-glass-without-triangles``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import (
    PRIMITIVE_BSPLINECURVE,
    PRIMITIVE_LINEARCURVE,
    PRIMITIVE_NEURALSDF,
    PRIMITIVE_SDFGRID,
    PRIMITIVE_SDFGRID_CUBIC,
)
from warp_psdr.kernels.interior.tangents import normalize_jvp
from warp_psdr.kernels.primitive.affine import Kind, cofactor, from_axes
from warp_psdr.kernels.primitive.curves_frame import frame_at, tube_bend, tube_gradient
from warp_psdr.kernels.primitive.curves_surface import held_on, make_curve_surface, on_cone
from warp_psdr.kernels.primitive.dispatch import is_bspline, is_cubic, is_grid, is_linear, is_network
from warp_psdr.kernels.primitive.kinds import KINDS, affine_kinds, join
from warp_psdr.kernels.primitive.network import network_of
from warp_psdr.kernels.primitive.network_surface import network_bend, network_point
from warp_psdr.kernels.primitive.sdfgrid import grid_of
from warp_psdr.kernels.primitive.sdfgrid_adjoint import bend_of, mixed_differences
from warp_psdr.kernels.primitive.sdfgrid_cubic import spline_hessian
from warp_psdr.kernels.primitive.sdfgrid_cubic_surface import spline_point
from warp_psdr.kernels.primitive.sdfgrid_surface import held_point, voxel_corner
from warp_psdr.kernels.structs import Scene, Triangle


@functools.cache
def make_turn(primitives: tuple[int, ...]) -> wp.Function | None:
    """Return ``turn(scene, tri, u, v, x_dot) -> vec3`` at a point (u, v) that moves by x_dot, along the surface.

    None: the scene has no shapes without triangles.
    """
    if not primitives:
        return None
    of_affine = join(_either_turn, {kind: _make_turn(KINDS[kind]) for kind in affine_kinds(primitives)})
    linear = PRIMITIVE_SDFGRID in primitives
    cubic = PRIMITIVE_SDFGRID_CUBIC in primitives
    networks = PRIMITIVE_NEURALSDF in primitives
    of_cones = _make_curve_turn(False) if PRIMITIVE_LINEARCURVE in primitives else None
    of_tubes = _make_curve_turn(True) if PRIMITIVE_BSPLINECURVE in primitives else None

    @wp.func
    def normal_turn_of_any(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32, x_dot: wp.vec3) -> wp.vec3:
        if wp.static(of_cones is not None):
            if is_linear(tri):
                return of_cones(scene, tri, u, v, x_dot)
        if wp.static(of_tubes is not None):
            if is_bspline(tri):
                return of_tubes(scene, tri, u, v, x_dot)
        q_dot = from_axes(tri, x_dot)
        if wp.static(networks):
            if is_network(tri):
                n = network_of(scene, tri)
                at = network_point(scene, n, u, v)
                bent = network_bend(scene, n, at.p, wp.cw_mul(n.cells, q_dot))
                return turned_normal(tri, wp.cw_mul(n.cells, at.gradient), wp.cw_mul(n.cells, bent))
        if wp.static(cubic):
            if is_cubic(tri):
                g = grid_of(scene, tri)
                smooth_at = spline_point(scene, g, u, v)
                x = smooth_at.p - voxel_corner(smooth_at.i, smooth_at.j, smooth_at.k)
                h = spline_hessian(scene, g, smooth_at.i, smooth_at.j, smooth_at.k, x)
                spline_bent = h * wp.cw_mul(g.cells, q_dot)
                return turned_normal(tri, wp.cw_mul(g.cells, smooth_at.gradient), wp.cw_mul(g.cells, spline_bent))
        if wp.static(linear):
            if is_grid(tri):
                voxels = grid_of(scene, tri)
                in_voxel = held_point(scene, voxels, u, v)
                place = in_voxel.p - voxel_corner(in_voxel.i, in_voxel.j, in_voxel.k)
                mixed = bend_of(mixed_differences(in_voxel.voxel, place), wp.cw_mul(voxels.cells, q_dot))
                return turned_normal(tri, wp.cw_mul(voxels.cells, in_voxel.gradient), wp.cw_mul(voxels.cells, mixed))
        if wp.static(of_affine is not None):
            return of_affine(tri, u, v, q_dot)
        return wp.vec3(0.0, 0.0, 0.0)

    return normal_turn_of_any


@wp.func
def turned_normal(tri: Triangle, slope: wp.vec3, slope_dot: wp.vec3) -> wp.vec3:
    """The same from the gradient of phi in the shape's coordinates and its rate."""
    c = cofactor(tri, slope)
    length = wp.length(c)
    sign = wp.float32(tri.i2)
    return normalize_jvp((sign / wp.where(length > 0.0, length, 1.0)) * c, length, sign * cofactor(tri, slope_dot))


def _make_curve_turn(cubic: bool) -> wp.Function:
    surface_of = make_curve_surface(cubic, False)

    @wp.func
    def curve_turn(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32, x_dot: wp.vec3) -> wp.vec3:
        surface = surface_of(scene, tri, u, v)
        segment, along = held_on(u, v)
        place = along
        free = wp.float32(1.0)
        if wp.static(not cubic):
            place, free = on_cone(along)
        f = frame_at(scene, tri, segment, place)
        e = wp.normalize(surface.x - f.c)
        return normalize_jvp(surface.ng, wp.length(tube_gradient(f, e)), tube_bend(f, e, free, x_dot))

    return curve_turn


def _make_turn(kind: Kind) -> wp.Function:
    @wp.func
    def normal_turn(tri: Triangle, u: wp.float32, v: wp.float32, q_dot: wp.vec3) -> wp.vec3:
        q = kind.point(u, v)
        n_rate, _du_rate, _uv_rate = kind.rates(q, q_dot)
        return turned_normal(tri, kind.normal(q), n_rate)

    return normal_turn


def _either_turn(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def normal_turn_of_kind(tri: Triangle, u: wp.float32, v: wp.float32, q_dot: wp.vec3) -> wp.vec3:
        if tri.i1 == word:
            return f(tri, u, v, q_dot)
        return rest(tri, u, v, q_dot)

    return normal_turn_of_kind

"""Velocities of vertices on shapes without triangles: forward mode's counterpart of their adjoints (``affine.py``)."""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.constants import (
    PRIMITIVE_BSPLINECURVE,
    PRIMITIVE_LINEARCURVE,
    PRIMITIVE_NEURALSDF,
    PRIMITIVE_SDFGRID,
    PRIMITIVE_SDFGRID_CUBIC,
)
from warp_psdr.kernels.interior.tangents import VertexTangent, make_vertex_jvp, normalize_jvp
from warp_psdr.kernels.primitive.affine import (
    Kind,
    cofactor,
    from_axes,
    is_primitive_at,
    primitive_record,
    to_axes,
)
from warp_psdr.kernels.primitive.curves_adjoint import make_curve_sink
from warp_psdr.kernels.primitive.dispatch import has_flow, is_bspline, is_cubic, is_grid, is_linear, is_network
from warp_psdr.kernels.primitive.kinds import KINDS, affine_kinds, join
from warp_psdr.kernels.primitive.sdfgrid_adjoint import make_sdfgrid_sink
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import VertexAdjoint


@functools.cache
def make_affine_jvp(kind: Kind, uv: bool, tangent: bool):
    """Return ``affine_jvp(tangents, tri, u, v, by_ray, o, d, o_dot, d_dot) -> VertexTangent``."""

    @wp.func
    def affine_jvp(
        tangents: wp.array(dtype=wp.float32),
        tri: Triangle,
        u: wp.float32,
        v: wp.float32,
        by_ray: wp.bool,
        o: wp.vec3,
        d: wp.vec3,
        o_dot: wp.vec3,
        d_dot: wp.vec3,
    ) -> VertexTangent:
        result = VertexTangent()
        q = kind.point(u, v)
        m = kind.normal(q)
        cross = cofactor(tri, m)
        moved = primitive_record(tangents, tri.i0)  # A' and b'
        result.x = moved.normal + to_axes(moved, q)
        m_dot = wp.vec3(0.0, 0.0, 0.0)
        du_dot = wp.vec3(0.0, 0.0, 0.0)
        if by_ray:
            t = wp.dot(tri.normal + to_axes(tri, q) - o, d) / wp.dot(d, d)
            r = o_dot + t * d_dot - result.x
            along = r - (wp.dot(cross, r) / wp.dot(cross, d)) * d
            n_rate, du_rate, uv_rate = kind.rates(q, from_axes(tri, along))
            m_dot = n_rate
            du_dot = du_rate
            result.x += along
            if wp.static(uv):
                result.uv = uv_rate
        c_dot = (
            cofactor(tri, m_dot)
            + m[0] * (wp.cross(moved.p1, tri.p2) + wp.cross(tri.p1, moved.p2))
            + m[1] * (wp.cross(moved.p2, tri.p0) + wp.cross(tri.p2, moved.p0))
            + m[2] * (wp.cross(moved.p0, tri.p1) + wp.cross(tri.p0, moved.p1))
        )
        result.c = wp.float32(tri.i2) * c_dot
        length = wp.length(cross)
        result.n = normalize_jvp(wp.float32(tri.i2) * cross / length, length, result.c)
        if wp.static(tangent):
            du, _dv = kind.tangents(q)
            result.tangent = to_axes(moved, du) + to_axes(tri, du_dot)
        return result

    return affine_jvp


def _either_jvp(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def jvp_of_kind(
        tangents: wp.array(dtype=wp.float32),
        tri: Triangle,
        u: wp.float32,
        v: wp.float32,
        by_ray: wp.bool,
        o: wp.vec3,
        d: wp.vec3,
        o_dot: wp.vec3,
        d_dot: wp.vec3,
    ) -> VertexTangent:
        if tri.i1 == word:
            return f(tangents, tri, u, v, by_ray, o, d, o_dot, d_dot)
        return rest(tangents, tri, u, v, by_ray, o, d, o_dot, d_dot)

    return jvp_of_kind


@functools.cache
def make_sliding_jvp(accumulate: wp.Function, uv: bool, tangent: bool, flow: bool = False):
    """Return ``sliding_jvp(scene, tangents, tri, u, v, by_ray, o, d, o_dot, d_dot) -> VertexTangent``.

    Component by component, by the sink of a kind in its forward role. The normal that carries the area element has no
    velocity in form S, which has no need of one.

    Args:
        accumulate: the sink.
        uv: texture coordinates are read.
        tangent: dp/du is read.
        flow: vertices flow along normals, and that normal has a velocity.
    """

    @wp.func
    def sliding_jvp(
        scene: Scene,
        tangents: wp.array(dtype=wp.float32),
        tri: Triangle,
        u: wp.float32,
        v: wp.float32,
        by_ray: wp.bool,
        o: wp.vec3,
        d: wp.vec3,
        o_dot: wp.vec3,
        d_dot: wp.vec3,
    ) -> VertexTangent:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        result = VertexTangent()
        axis = wp.int32(0)
        while axis < 3:
            e = wp.vec3(0.0, 0.0, 0.0)
            e[axis] = 1.0
            of_x = VertexAdjoint()
            of_x.x = e
            ax = accumulate(scene, tangents, tri, u, v, of_x, by_ray, o, d)
            of_n = VertexAdjoint()
            of_n.n = e
            an = accumulate(scene, tangents, tri, u, v, of_n, by_ray, o, d)
            result.x[axis] = ax.dot + wp.dot(ax.o, o_dot) + wp.dot(ax.d, d_dot)
            result.n[axis] = an.dot + wp.dot(an.o, o_dot) + wp.dot(an.d, d_dot)
            if wp.static(flow):
                of_c = VertexAdjoint()
                of_c.c = e
                result.c[axis] = accumulate(scene, tangents, tri, u, v, of_c, by_ray, o, d).dot
            if wp.static(tangent):
                of_t = VertexAdjoint()
                of_t.tangent = e
                at = accumulate(scene, tangents, tri, u, v, of_t, by_ray, o, d)
                result.tangent[axis] = at.dot + wp.dot(at.o, o_dot) + wp.dot(at.d, d_dot)
            if wp.static(uv):
                if axis < 2:
                    of_uv = VertexAdjoint()
                    of_uv.uv = wp.vec2(e[0], e[1])
                    auv = accumulate(scene, tangents, tri, u, v, of_uv, by_ray, o, d)
                    result.uv[axis] = auv.dot + wp.dot(auv.o, o_dot) + wp.dot(auv.d, d_dot)
            axis += 1
        return result

    return sliding_jvp


@functools.cache
def make_velocity(smooth: bool, flat: bool, uv: bool, tangent: bool, primitives: tuple[int, ...]):
    """Return ``make_vertex_jvp``'s function, for vertices on any shape; other arguments as there."""
    of_triangle = make_vertex_jvp(smooth, flat, uv, tangent)
    if not primitives:
        return of_triangle
    kinds = affine_kinds(primitives)
    of_affine = join(_either_jvp, {kind: make_affine_jvp(KINDS[kind], uv or tangent, tangent) for kind in kinds})
    of_grid, of_cubic, of_linear, of_bspline, of_network = None, None, None, None, None
    flow = has_flow(primitives)
    if PRIMITIVE_NEURALSDF in primitives:
        of_network = make_sliding_jvp(make_sdfgrid_sink("forward", False, True, flow), False, False, flow)
    if PRIMITIVE_SDFGRID in primitives:
        of_grid = make_sliding_jvp(make_sdfgrid_sink("forward"), False, False)
    if PRIMITIVE_SDFGRID_CUBIC in primitives:
        of_cubic = make_sliding_jvp(make_sdfgrid_sink("forward", True, False, flow), False, False, flow)
    if PRIMITIVE_LINEARCURVE in primitives:
        of_linear = make_sliding_jvp(make_curve_sink("forward", False, uv, tangent), uv, tangent)
    if PRIMITIVE_BSPLINECURVE in primitives:
        of_bspline = make_sliding_jvp(make_curve_sink("forward", True, uv, tangent), uv, tangent)

    @wp.func
    def velocity_of_any(
        scene: Scene,
        tangents: wp.array(dtype=wp.float32),
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        by_ray: wp.bool,
        o: wp.vec3,
        d: wp.vec3,
        o_dot: wp.vec3,
        d_dot: wp.vec3,
    ) -> VertexTangent:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        if is_primitive_at(scene, face):
            tri = triangle_at(scene, face)
            if wp.static(of_linear is not None):
                if is_linear(tri):
                    return of_linear(scene, tangents, tri, u, v, by_ray, o, d, o_dot, d_dot)
            if wp.static(of_bspline is not None):
                if is_bspline(tri):
                    return of_bspline(scene, tangents, tri, u, v, by_ray, o, d, o_dot, d_dot)
            if wp.static(of_network is not None):
                if is_network(tri):
                    return of_network(scene, tangents, tri, u, v, by_ray, o, d, o_dot, d_dot)
            if wp.static(of_cubic is not None):
                if is_cubic(tri):
                    return of_cubic(scene, tangents, tri, u, v, by_ray, o, d, o_dot, d_dot)
            if wp.static(of_grid is not None):
                if wp.static(of_affine is None) or is_grid(tri):
                    return of_grid(scene, tangents, tri, u, v, by_ray, o, d, o_dot, d_dot)
            if wp.static(of_affine is not None):
                return of_affine(tangents, tri, u, v, by_ray, o, d, o_dot, d_dot)
        return of_triangle(scene, tangents, face, u, v, by_ray, o, d, o_dot, d_dot)

    return velocity_of_any

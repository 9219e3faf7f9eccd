"""Kinds that are a fixed surface under an affine map, x = A q + b, differentiable by all twelve numbers.

With q(u, v) detached, a path vertex rides on the shape as a vertex on a triangle rides on its corners. x is linear in
the pose, and the normal that carries the area element is c = cof(A) n(q), with the normal n of the kind. Every formula
for triangles in terms of x and c therefore holds for these shapes, the geometric factor of a connection included. Where
a ray finds the vertex, q moves: A q' = r - d (c . r) / (c . d), r = o' + t d' - (A' q + b').

Derivation: ``docs/theory/implicit.md#material-form``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.primitive.affine import (
    cofactor,
    determinant,
    from_axes,
    make_pose_sink,
    primitive_record,
    to_axes,
    to_axes_vjp,
)
from warp_psdr.kernels.primitive.kind import MATERIAL, Affine, Kind
from warp_psdr.kernels.primitive.turned_normal import turned_normal
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import RayAdjoint, Surface, VertexAdjoint, normalize_vjp
from warp_psdr.kernels.vertex_motion import VertexTangent, normalize_jvp


def affine_kind(number: int, affine: Affine) -> Kind:
    """Return the kind of a number (``Kind.number``) that is made of the functions of a surface."""
    position, cross = make_affine_point(affine)
    return Kind(
        number=number,
        moves=MATERIAL,
        make_hit=lambda _shadow: make_affine_hit(affine),
        make_surface=lambda uv, tangent: make_affine_surface(affine, uv or tangent, tangent),
        partials=make_affine_partials(affine),
        position=position,
        cross=cross,
        normal=make_affine_normal(affine),
        make_sink=lambda role, uv, tangent, rays, _flow: make_affine_sink(affine, role, uv or tangent, tangent, rays),
        make_velocity=lambda uv, tangent, _flow: make_affine_jvp(affine, uv or tangent, tangent),
        make_turn=lambda: make_affine_turn(affine),
        affine=affine,
    )


@functools.cache
def make_affine_point(affine: Affine):
    """Return ``(point, cross)``: ``(tri, u, v) -> vec3``, x and c."""

    @wp.func
    def affine_point(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
        return tri.normal + to_axes(tri, affine.point(u, v))

    @wp.func
    def affine_cross(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
        return wp.float32(tri.i2) * cofactor(tri, affine.normal(affine.point(u, v)))

    return affine_point, affine_cross


@functools.cache
def make_affine_normal(affine: Affine):
    """Return ``normal(scene, tri, x) -> vec3``, not of unit length, at a point of the shape in the world."""

    @wp.func
    def affine_normal(scene: Scene, tri: Triangle, x: wp.vec3) -> wp.vec3:
        return wp.float32(tri.i2) * cofactor(tri, affine.normal(from_axes(tri, x - tri.normal)))

    return affine_normal


@functools.cache
def make_affine_hit(affine: Affine):
    """Return ``hit(scene, tri, o, d, t_max) -> RayHit``; its ``face`` is 0, or -1 for a miss."""

    @wp.func
    def affine_hit(scene: Scene, tri: Triangle, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
        return affine.hit(from_axes(tri, o - tri.normal), from_axes(tri, d), t_max)

    return affine_hit


@functools.cache
def make_affine_surface(affine: Affine, uv: bool, tangent: bool):
    """Return ``surface_of(scene, tri, u, v) -> Surface``; arguments as ``make_surface_of``'s."""

    @wp.func
    def affine_surface(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> Surface:
        q = affine.point(u, v)
        s = Surface()
        s.x = tri.normal + to_axes(tri, q)
        s.ng = wp.float32(tri.i2) * wp.normalize(cofactor(tri, affine.normal(q)))
        s.n = s.ng
        s.shape = tri.shape
        s.length = -1.0
        if wp.static(uv):
            s.uv = affine.uv(q)
        if wp.static(tangent):
            du, _dv = affine.tangents(q)
            s.tangent = to_axes(tri, du)
        return s

    return affine_surface


@functools.cache
def make_affine_partials(affine: Affine):
    """Return ``partials(scene, tri, u, v) -> (dp/du, dp/dv)``."""

    @wp.func
    def affine_partials(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> tuple[wp.vec3, wp.vec3]:
        du, dv = affine.tangents(affine.point(u, v))
        return to_axes(tri, du), to_axes(tri, dv)

    return affine_partials


@functools.cache
def make_affine_sink(affine: Affine, role: str, uv: bool, tangent: bool, rays: bool):
    """Return ``accumulate(scene, target, tri, u, v, adjoint, by_ray, o, d) -> RayAdjoint`` (``Kind.make_sink``)."""
    accumulate_pose = make_pose_sink(role)

    @wp.func
    def affine_sink(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        tri: Triangle,
        u: wp.float32,
        v: wp.float32,
        adjoint: VertexAdjoint,
        by_ray: wp.bool,
        o: wp.vec3,
        d: wp.vec3,
    ) -> RayAdjoint:
        result = RayAdjoint()
        q = affine.point(u, v)
        m = affine.normal(q)
        cross = wp.float32(tri.i2) * cofactor(tri, m)
        # The unit normal is c / |c|.
        length = wp.length(cross)
        a_c = wp.float32(tri.i2) * (
            adjoint.c + normalize_vjp((1.0 / wp.where(length > 0.0, length, 1.0)) * cross, length, adjoint.n)
        )
        # x = A q + b; c = m_0 A_1 x A_2 + m_1 A_2 x A_0 + m_2 A_0 x A_1: the triple product's rule.
        g0 = q[0] * adjoint.x + wp.cross(m[2] * tri.p1 - m[1] * tri.p2, a_c)
        g1 = q[1] * adjoint.x + wp.cross(m[0] * tri.p2 - m[2] * tri.p0, a_c)
        g2 = q[2] * adjoint.x + wp.cross(m[1] * tri.p0 - m[0] * tri.p1, a_c)
        g = adjoint.x
        a_m = wp.vec3(
            wp.dot(a_c, wp.cross(tri.p1, tri.p2)),
            wp.dot(a_c, wp.cross(tri.p2, tri.p0)),
            wp.dot(a_c, wp.cross(tri.p0, tri.p1)),
        )
        a_du = wp.vec3(0.0, 0.0, 0.0)
        a_uv = wp.vec2(0.0, 0.0)
        if wp.static(tangent):
            du, _dv = affine.tangents(q)
            g0 += du[0] * adjoint.tangent
            g1 += du[1] * adjoint.tangent
            g2 += du[2] * adjoint.tangent
            a_du = to_axes_vjp(tri, adjoint.tangent)
        if wp.static(uv):
            a_uv = adjoint.uv
        if wp.static(rays):
            if by_ray:
                # Adjoint of A q', and with the rule for q' that of r.
                pulled = affine.pull(q, a_m, a_du, a_uv)
                h = adjoint.x + (1.0 / determinant(tri)) * cofactor(tri, pulled)
                k = h - (wp.dot(h, d) / wp.dot(cross, d)) * cross
                t = wp.dot(tri.normal + to_axes(tri, q) - o, d) / wp.dot(d, d)
                result.o = k
                result.d = t * k
                g0 -= q[0] * k
                g1 -= q[1] * k
                g2 -= q[2] * k
                g -= k
        result.dot = accumulate_pose(target, tri, g0, g1, g2, g)
        return result

    return affine_sink


@functools.cache
def make_affine_jvp(affine: Affine, uv: bool, tangent: bool):
    """Return ``affine_jvp(scene, tangents, tri, u, v, by_ray, o, d, o_dot, d_dot) -> VertexTangent``."""

    @wp.func
    def affine_jvp(
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
        result = VertexTangent()
        q = affine.point(u, v)
        m = affine.normal(q)
        cross = cofactor(tri, m)
        moved = primitive_record(tangents, tri.i0)  # A' and b'
        result.x = moved.normal + to_axes(moved, q)
        m_dot = wp.vec3(0.0, 0.0, 0.0)
        du_dot = wp.vec3(0.0, 0.0, 0.0)
        if by_ray:
            t = wp.dot(tri.normal + to_axes(tri, q) - o, d) / wp.dot(d, d)
            r = o_dot + t * d_dot - result.x
            along = r - (wp.dot(cross, r) / wp.dot(cross, d)) * d
            n_rate, du_rate, uv_rate = affine.rates(q, from_axes(tri, along))
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
            du, _dv = affine.tangents(q)
            result.tangent = to_axes(moved, du) + to_axes(tri, du_dot)
        return result

    return affine_jvp


@functools.cache
def make_affine_turn(affine: Affine):
    """Return ``turn(scene, tri, u, v, x_dot) -> vec3``, the rate of the unit normal (``turned_normal.py``)."""

    @wp.func
    def affine_turn(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32, x_dot: wp.vec3) -> wp.vec3:
        q_dot = from_axes(tri, x_dot)
        q = affine.point(u, v)
        n_rate, _du_rate, _uv_rate = affine.rates(q, q_dot)
        return turned_normal(tri, affine.normal(q), n_rate)

    return affine_turn

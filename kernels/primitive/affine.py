"""Shapes that are a fixed surface under an affine map: x = A q + b, differentiable by all twelve numbers.

With q(u, v) detached, a path vertex rides on the shape as a vertex on a triangle rides on its corners. x is linear in
the pose, and the normal that carries the area element is c = cof(A) n(q), with the normal n of the kind. Every formula
for triangles in terms of x and c therefore holds for these shapes, the geometric factor of a connection included. Where
a ray finds the vertex, q moves: A q' = r - d (c . r) / (c . d), r = o' + t d' - (A' q + b'). The record of a shape
follows those of the triangles, as a ``Triangle`` whose corners are the columns of A, whose normal is b, and whose
``i1`` is -1 - kind; ``i0`` is the flat offset of the pose, ``i2`` the sign of c against normals.

Derivation: ``docs/theory/implicit.md#material-form``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.modules import SCENE
from warp_psdr.kernels.reading import triangle_int
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.step import RESOLVED
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import RayAdjoint, Surface, VertexAdjoint, normalize_vjp

#: Word of ``Triangle.i1`` in the record (``reading.py``).
KIND_WORD = 13


class Kind(NamedTuple):
    """The functions of a kind, in its own coordinates; q is a point of it.

    Attributes:
        point: ``(u, v) -> q``.
        hit: ``(o, d, t_max) -> RayHit``: the first point of a line; its ``face`` is -1 if there is none.
        normal: ``(q) -> vec3``, as long as the area element.
        tangents: ``(q) -> (dp/du, dp/dv)``.
        uv: ``(q) -> vec2``.
        rates: ``(q, q_dot) -> (normal, dp/du, uv)``: their velocities.
        pull: ``(q, a_normal, a_tangent, a_uv) -> vec3``: the transpose.
    """

    point: wp.Function
    hit: wp.Function
    normal: wp.Function
    tangents: wp.Function
    uv: wp.Function
    rates: wp.Function
    pull: wp.Function


@wp.func
def is_primitive(tri: Triangle) -> wp.bool:
    """Whether the record is that of a shape without triangles."""
    return tri.i1 < 0


@wp.func
def is_primitive_at(scene: Scene, face: wp.int32) -> wp.bool:
    """The same of a number of a face; -1 stands for none."""
    return face >= 0 and triangle_int(scene.triangles, wp.max(face, 0), wp.static(KIND_WORD)) < 0


@wp.func
def triangle_or_none(scene: Scene, face: wp.int32) -> wp.int32:
    """The number of a face if it is that of a triangle, else -1."""
    return wp.where(is_primitive_at(scene, face), -1, face)


@wp.func
def to_axes(tri: Triangle, p: wp.vec3) -> wp.vec3:
    """A p."""
    return p[0] * tri.p0 + p[1] * tri.p1 + p[2] * tri.p2


@wp.func
def to_axes_vjp(tri: Triangle, a: wp.vec3) -> wp.vec3:
    """A^T a."""
    return wp.vec3(wp.dot(tri.p0, a), wp.dot(tri.p1, a), wp.dot(tri.p2, a))


@wp.func
def from_axes(tri: Triangle, w: wp.vec3) -> wp.vec3:
    """A^-1 w."""
    c0 = wp.cross(tri.p1, tri.p2)
    c1 = wp.cross(tri.p2, tri.p0)
    c2 = wp.cross(tri.p0, tri.p1)
    return (1.0 / wp.dot(tri.p0, c0)) * wp.vec3(wp.dot(c0, w), wp.dot(c1, w), wp.dot(c2, w))


@wp.func
def cofactor(tri: Triangle, n: wp.vec3) -> wp.vec3:
    """cof(A) n, which is det(A) A^-T n."""
    return n[0] * wp.cross(tri.p1, tri.p2) + n[1] * wp.cross(tri.p2, tri.p0) + n[2] * wp.cross(tri.p0, tri.p1)


@wp.func
def determinant(tri: Triangle) -> wp.float32:
    return wp.dot(tri.p0, wp.cross(tri.p1, tri.p2))


@wp.func
def step_off_primitive(scene: Scene, tri: Triangle) -> wp.float32:
    """Distance, world units, at which the rays that leave a shape start."""
    reach = wp.max(wp.abs(tri.normal) + wp.abs(tri.p0) + wp.abs(tri.p1) + wp.abs(tri.p2))
    return wp.where(scene.least_step <= 0.0, scene.ray_epsilon, RESOLVED * reach)


@functools.cache
def make_affine_point(kind: Kind):
    """Return ``(point, cross)``: ``(tri, u, v) -> vec3``, x and c."""

    @wp.func
    def affine_point(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
        return tri.normal + to_axes(tri, kind.point(u, v))

    @wp.func
    def affine_cross(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
        return wp.float32(tri.i2) * cofactor(tri, kind.normal(kind.point(u, v)))

    return affine_point, affine_cross


@functools.cache
def make_affine_normal(kind: Kind):
    """Return ``normal(tri, x) -> vec3``, not of unit length, at a point of the shape in the world."""

    @wp.func
    def affine_normal(tri: Triangle, x: wp.vec3) -> wp.vec3:
        return wp.float32(tri.i2) * cofactor(tri, kind.normal(from_axes(tri, x - tri.normal)))

    return affine_normal


@functools.cache
def make_affine_hit(kind: Kind):
    """Return ``hit(tri, o, d, t_max) -> RayHit``; its ``face`` is 0, or -1 for a miss."""

    @wp.func
    def affine_hit(tri: Triangle, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
        return kind.hit(from_axes(tri, o - tri.normal), from_axes(tri, d), t_max)

    return affine_hit


@functools.cache
def make_affine_surface(kind: Kind, uv: bool, tangent: bool):
    """Return ``surface_of(tri, u, v) -> Surface`` (arguments as ``make_surface_of``'s) and its partials.

    ``partials(tri, u, v) -> (dp/du, dp/dv)``.
    """

    @wp.func
    def affine_surface(tri: Triangle, u: wp.float32, v: wp.float32) -> Surface:
        q = kind.point(u, v)
        s = Surface()
        s.x = tri.normal + to_axes(tri, q)
        s.ng = wp.float32(tri.i2) * wp.normalize(cofactor(tri, kind.normal(q)))
        s.n = s.ng
        s.shape = tri.shape
        s.length = -1.0
        if wp.static(uv):
            s.uv = kind.uv(q)
        if wp.static(tangent):
            du, _dv = kind.tangents(q)
            s.tangent = to_axes(tri, du)
        return s

    @wp.func
    def affine_partials(tri: Triangle, u: wp.float32, v: wp.float32) -> tuple[wp.vec3, wp.vec3]:
        du, dv = kind.tangents(kind.point(u, v))
        return to_axes(tri, du), to_axes(tri, dv)

    return affine_surface, affine_partials


@functools.cache
def make_pose_sink(role: str):
    """Return ``accumulate_pose(target, tri, g0, g1, g2, g) -> float``: the adjoints of A's columns and of b."""
    sink = make_sink(role)

    @wp.func
    def accumulate_pose(
        target: wp.array(dtype=wp.float32), tri: Triangle, g0: wp.vec3, g1: wp.vec3, g2: wp.vec3, g: wp.vec3
    ) -> wp.float32:
        total = wp.float32(0.0)
        for i in range(3):
            total += sink(target, tri.i0 + 4 * i, g0[i])
            total += sink(target, tri.i0 + 4 * i + 1, g1[i])
            total += sink(target, tri.i0 + 4 * i + 2, g2[i])
            total += sink(target, tri.i0 + 4 * i + 3, g[i])
        return total

    return accumulate_pose


@functools.cache
def make_affine_sink(kind: Kind, role: str, uv: bool, tangent: bool, rays: bool):
    """Return ``accumulate(target, tri, u, v, adjoint, by_ray, o, d) -> RayAdjoint``, as ``make_vertex_sink``'s."""
    accumulate_pose = make_pose_sink(role)

    @wp.func
    def affine_sink(
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
        q = kind.point(u, v)
        m = kind.normal(q)
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
            du, _dv = kind.tangents(q)
            g0 += du[0] * adjoint.tangent
            g1 += du[1] * adjoint.tangent
            g2 += du[2] * adjoint.tangent
            a_du = to_axes_vjp(tri, adjoint.tangent)
        if wp.static(uv):
            a_uv = adjoint.uv
        if wp.static(rays):
            if by_ray:
                # Adjoint of A q', and with the rule for q' that of r.
                pulled = kind.pull(q, a_m, a_du, a_uv)
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


@wp.func
def primitive_record(values: wp.array(dtype=wp.float32), pose: wp.int32) -> Triangle:
    """The columns of A, b, and where they stand."""
    tri = Triangle()
    tri.i0 = pose
    tri.p0 = wp.vec3(values[pose], values[pose + 4], values[pose + 8])
    tri.p1 = wp.vec3(values[pose + 1], values[pose + 5], values[pose + 9])
    tri.p2 = wp.vec3(values[pose + 2], values[pose + 6], values[pose + 10])
    tri.normal = wp.vec3(values[pose + 3], values[pose + 7], values[pose + 11])
    return tri


@wp.kernel(module=SCENE, enable_backward=False)
def update_primitive(
    # In:
    values: wp.array(dtype=wp.float32),
    pose: wp.int32,
    shape: wp.int32,
    kind: wp.int32,
    orientation: wp.float32,
    place: wp.int32,
    # Out:
    triangles_out: wp.array(dtype=Triangle),
):
    """Write the record of a shape from its pose."""
    tri = primitive_record(values, pose)
    tri.i1 = -1 - kind
    tri.i2 = wp.where((determinant(tri) < 0.0) == (orientation < 0.0), 1, -1)
    tri.shape = shape
    triangles_out[place] = tri


@wp.func
def last_primitive(scene: Scene) -> wp.int32:
    """Number of the last record; those of shapes without triangles are the last ones."""
    return scene.triangles.shape[0] - 1

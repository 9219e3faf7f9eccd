"""A point on a triangle, and the sinks for its adjoint.

A vertex of a light path is ``x = (1 - u - v) p0 + u p1 + v p2``. Its triangle is attached; its barycentrics are

* detached in **material form** ([ZCZ25] eq. 10: the point rides on its triangle), or
* attached where a ray with an attached origin and direction finds it (the first vertex, seen through a fixed film
  position, and every vertex behind a smooth mirror or glass): there ``(u, v) = barycentrics(o, d, p0, p1, p2)``.

The functions named ``*_dot`` are the local factors of the geometry. Each folds its adjoint in and returns a scalar, so
that ``wp.grad`` of it is a vector-Jacobian product. They hold no loop and mutate nothing (kernels are built with
``enable_backward=False``; only these functions are differentiated).
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import differentiable
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.modules import SCENE
from warp_psdr.kernels.reading import load_float, load_vec3, shape_at, triangle_at
from warp_psdr.kernels.sink import make_sink, make_sink_vec3
from warp_psdr.kernels.structs import Scene, Shape, Triangle

#: Squared length below which interpolated normals cancel.
CANCELLED = wp.constant(1.0e-20)
#: Area of a triangle's texture coordinates, twice, up to which they tell no directions.
DEGENERATE = wp.constant(1.0e-20)


@wp.func
def point_on(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
    """Point of a triangle with the barycentrics (u, v)."""
    return (1.0 - u - v) * tri.p0 + u * tri.p1 + v * tri.p2


@wp.struct
class CornerTexcoords:
    """Texture coordinates of a triangle's corners. Numbers: a loop over lanes in which a ``vec2`` moves is no SIMD."""

    u0: wp.float32
    v0: wp.float32
    u1: wp.float32
    v1: wp.float32
    u2: wp.float32
    v2: wp.float32


@wp.func
def corner_texcoords(scene: Scene, shape: Shape, tri: Triangle) -> CornerTexcoords:
    """Texture coordinates of a triangle's corners; their barycentrics where its shape has none."""
    given = shape.has_uv == 1
    at0 = wp.where(given, shape.uv_offset + 2 * tri.i0, 0)
    at1 = wp.where(given, shape.uv_offset + 2 * tri.i1, 0)
    at2 = wp.where(given, shape.uv_offset + 2 * tri.i2, 0)
    c = CornerTexcoords()
    c.u0 = wp.where(given, load_float(scene.values, at0), 0.0)
    c.v0 = wp.where(given, load_float(scene.values, at0 + 1), 0.0)
    c.u1 = wp.where(given, load_float(scene.values, at1), 1.0)
    c.v1 = wp.where(given, load_float(scene.values, at1 + 1), 0.0)
    c.u2 = wp.where(given, load_float(scene.values, at2), 0.0)
    c.v2 = wp.where(given, load_float(scene.values, at2 + 1), 1.0)
    return c


@wp.func
def texcoords_of(c: CornerTexcoords, u: wp.float32, v: wp.float32) -> wp.vec2:
    """Texture coordinates at the barycentrics (u, v)."""
    w = 1.0 - u - v
    return wp.vec2(w * c.u0 + u * c.u1 + v * c.u2, w * c.v0 + u * c.v1 + v * c.v2)


@wp.func
def texcoords_at(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec2:
    """Texture coordinates of a point of a triangle; its barycentrics where the shape has none."""
    return texcoords_of(corner_texcoords(scene, shape_at(scene, tri.shape), tri), u, v)


@wp.struct
class Surface:
    """Differential geometry at a point of a triangle."""

    x: wp.vec3
    n: wp.vec3  # unit shading normal, turned by flip_normals
    ng: wp.vec3  # unit geometric normal, turned by flip_normals
    tangent: wp.vec3  # dp/du, only where an anisotropic model needs it
    uv: wp.vec2
    shape: wp.int32
    length: wp.float32  # of the sum of vertex normals that n comes from, 0 where they cancel; -1: n is the triangle's


@wp.struct
class VertexAdjoint:
    """Adjoint of a path vertex: position, shading normal, tangent, texture coordinates, attached barycentrics.

    ``c`` is the adjoint of the cross product (p1 - p0) x (p2 - p0) of its triangle's edges, through which the geometric
    factor and the face normal depend on the corners.
    """

    x: wp.vec3
    n: wp.vec3
    tangent: wp.vec3
    uv: wp.vec2
    u: wp.float32
    v: wp.float32
    c: wp.vec3


@wp.struct
class Corners:
    """Adjoints of a triangle's corners."""

    p0: wp.vec3
    p1: wp.vec3
    p2: wp.vec3


@wp.struct
class RayAdjoint:
    """Adjoint of a ray's origin and direction, and the forward-mode sum collected on the way."""

    o: wp.vec3
    d: wp.vec3
    dot: wp.float32


@wp.func
def interpolate(a: wp.vec3, b: wp.vec3, c: wp.vec3, u: wp.float32, v: wp.float32) -> wp.vec3:
    """Sum of three corners' values, weighted by barycentrics."""
    return (1.0 - u - v) * a + u * b + v * c


@wp.func
def length_of_normals(n: wp.vec3) -> wp.float32:
    """Length of a sum of vertex normals; 0 where they cancel."""
    squared = wp.dot(n, n)
    cancelled = squared < CANCELLED
    return wp.where(cancelled, 0.0, wp.sqrt(wp.where(cancelled, 1.0, squared)))


@wp.func
def unit_normal(n: wp.vec3, length: wp.float32, fallback: wp.vec3) -> wp.vec3:
    """A sum of vertex normals over its length; ``fallback`` where they cancel."""
    some = length > 0.0
    return where3(some, (1.0 / wp.where(some, length, 1.0)) * n, fallback)


@wp.func
def uv_tangent(p0: wp.vec3, p1: wp.vec3, p2: wp.vec3, t0: wp.vec2, t1: wp.vec2, t2: wp.vec2) -> wp.vec3:
    """dp/du of a triangle with texture coordinates; its first edge where those are degenerate."""
    d1 = t1 - t0
    d2 = t2 - t0
    det = d1[0] * d2[1] - d1[1] * d2[0]
    some = wp.abs(det) >= DEGENERATE
    return where3(some, (d2[1] * (p1 - p0) - d1[1] * (p2 - p0)) / wp.where(some, det, 1.0), p1 - p0)


@wp.func
def uv_partials(scene: Scene, tri: Triangle) -> tuple[wp.vec3, wp.vec3]:
    """dp/du and dp/dv; those of the barycentrics where there are no texture coordinates, or degenerate ones."""
    c = corner_texcoords(scene, shape_at(scene, tri.shape), tri)
    e1 = tri.p1 - tri.p0
    e2 = tri.p2 - tri.p0
    det = (c.u1 - c.u0) * (c.v2 - c.v0) - (c.v1 - c.v0) * (c.u2 - c.u0)
    dp_du = e1
    dp_dv = e2
    if wp.abs(det) > DEGENERATE:
        dp_du = ((c.v2 - c.v0) * e1 - (c.v1 - c.v0) * e2) / det
        dp_dv = ((c.u1 - c.u0) * e2 - (c.u2 - c.u0) * e1) / det
    return dp_du, dp_dv


@wp.func
def ray_barycentrics(o: wp.vec3, d: wp.vec3, p0: wp.vec3, p1: wp.vec3, p2: wp.vec3) -> wp.vec2:
    """Barycentrics (u, v) where the line o + t d meets the plane of a triangle (Cramer's rule)."""
    e1 = p1 - p0
    e2 = p2 - p0
    q = wp.cross(d, e2)
    s = o - p0
    inv_det = 1.0 / wp.dot(e1, q)
    r = wp.cross(s, e1)
    return wp.vec2(wp.dot(s, q) * inv_det, wp.dot(d, r) * inv_det)


@differentiable
@wp.func
def barycentrics_dot(
    o: wp.vec3, d: wp.vec3, p0: wp.vec3, p1: wp.vec3, p2: wp.vec3, a_u: wp.float32, a_v: wp.float32
) -> wp.float32:
    uv = ray_barycentrics(o, d, p0, p1, p2)
    return a_u * uv[0] + a_v * uv[1]


@differentiable
@wp.func
def tangent_dot(p0: wp.vec3, p1: wp.vec3, p2: wp.vec3, t0: wp.vec2, t1: wp.vec2, t2: wp.vec2, a: wp.vec3) -> wp.float32:
    return wp.dot(a, uv_tangent(p0, p1, p2, t0, t1, t2))


@wp.func
def normalize_vjp(unit: wp.vec3, length: wp.float32, a: wp.vec3) -> wp.vec3:
    """Adjoint of r from the adjoint of r / |r| = unit: (a - unit (unit . a)) / |r|; 0 where r vanishes."""
    some = not length <= 0.0
    across = (1.0 / wp.where(some, length, 1.0)) * (a - unit * wp.dot(unit, a))
    return where3(some, across, wp.vec3(0.0, 0.0, 0.0))


@wp.func
def face_normal_vjp(tri: Triangle, orientation: wp.float32, a: wp.vec3) -> wp.vec3:
    """Adjoint of the cross product c of a triangle's edges from that of its unit normal, orientation c / |c|."""
    length = wp.length(wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0))
    return normalize_vjp(tri.normal, length, orientation * a)


@wp.func
def corners_vjp(tri: Triangle, u: wp.float32, v: wp.float32, x: wp.vec3, c: wp.vec3) -> Corners:
    """Adjoints of a triangle's corners from those of its point (u, v) and of the cross product of its edges."""
    e1 = tri.p1 - tri.p0
    e2 = tri.p2 - tri.p0
    # c = e1 x e2: the triple product's rule.
    a_e1 = wp.cross(e2, c)
    a_e2 = wp.cross(c, e1)
    corners = Corners()
    corners.p0 = (1.0 - u - v) * x - (a_e1 + a_e2)
    corners.p1 = u * x + a_e1
    corners.p2 = v * x + a_e2
    return corners


@functools.cache
def make_surface_of(smooth: bool, flat: bool, uv: bool, tangent: bool):
    """Return ``surface_of(scene, tri, u, v) -> Surface`` for scenes that hold smooth and/or flat shapes.

    Args:
        smooth: some shape interpolates vertex normals.
        flat: some shape uses face normals.
        uv: some texture reads texture coordinates.
        tangent: some model is anisotropic and needs dp/du.
    """

    @wp.func
    def surface_of(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> Surface:
        s = Surface()
        s.x = point_on(tri, u, v)
        s.ng = tri.normal
        s.n = tri.normal
        s.shape = tri.shape
        s.length = -1.0
        if wp.static(smooth or uv or tangent):
            shape = shape_at(scene, tri.shape)
            if wp.static(smooth):
                is_smooth = shape.smooth == 1
                if wp.static(not flat):
                    is_smooth = True
                n0 = load_vec3(scene.values, wp.where(is_smooth, shape.normal_offset + 3 * tri.i0, 0))
                n1 = load_vec3(scene.values, wp.where(is_smooth, shape.normal_offset + 3 * tri.i1, 0))
                n2 = load_vec3(scene.values, wp.where(is_smooth, shape.normal_offset + 3 * tri.i2, 0))
                n = interpolate(n0, n1, n2, u, v)
                length = length_of_normals(n)
                turned = shape.orientation * unit_normal(n, length, shape.orientation * tri.normal)
                s.length = wp.where(is_smooth, length, -1.0)
                s.n = where3(is_smooth, turned, tri.normal)
            if wp.static(uv or tangent):
                c = corner_texcoords(scene, shape, tri)
                s.uv = texcoords_of(c, u, v)
                s.tangent = tri.p1 - tri.p0
                if wp.static(tangent):
                    t0, t1, t2 = wp.vec2(c.u0, c.v0), wp.vec2(c.u1, c.v1), wp.vec2(c.u2, c.v2)
                    s.tangent = uv_tangent(tri.p0, tri.p1, tri.p2, t0, t1, t2)
        return s

    return surface_of


@functools.cache
def make_surface(smooth: bool, flat: bool, uv: bool, tangent: bool):
    """Return ``surface_at(scene, face, u, v) -> Surface``; arguments as those of ``make_surface_of``."""
    surface_of = make_surface_of(smooth, flat, uv, tangent)

    @wp.func
    def surface_at(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32) -> Surface:
        return surface_of(scene, triangle_at(scene, face), u, v)

    return surface_at


@functools.cache
def make_vertex_sink(role: str, smooth: bool, flat: bool, uv: bool, tangent: bool, texcoords: bool, rays: bool):
    """Return ``accumulate_vertex(scene, target, face, u, v, adjoint, by_ray, o, d) -> RayAdjoint``.

    Scatters a vertex's adjoint to the corners of its triangle, their normals and (``texcoords``) their texture
    coordinates. ``by_ray``: the barycentrics are attached to the ray (o, d), whose adjoint is returned; otherwise they
    are material constants. ``rays=False`` compiles the second case out.
    """
    sink3 = make_sink_vec3(role)
    sink1 = make_sink(role)

    @wp.func
    def accumulate_vertex(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        adjoint: VertexAdjoint,
        by_ray: wp.bool,
        o: wp.vec3,
        d: wp.vec3,
    ) -> RayAdjoint:
        tri = scene.triangles[face]
        shape = shape_at(scene, tri.shape)
        result = RayAdjoint()
        total = wp.float32(0.0)
        w = 1.0 - u - v
        e1 = tri.p1 - tri.p0
        e2 = tri.p2 - tri.p0
        a_u = adjoint.u
        a_v = adjoint.v
        a_c = adjoint.c
        # Shading normal.
        is_smooth = wp.static(smooth) and (shape.smooth == 1 or wp.static(not flat))
        if is_smooth:
            if wp.static(smooth):
                n0 = load_vec3(scene.values, shape.normal_offset + 3 * tri.i0)
                n1 = load_vec3(scene.values, shape.normal_offset + 3 * tri.i1)
                n2 = load_vec3(scene.values, shape.normal_offset + 3 * tri.i2)
                n = interpolate(n0, n1, n2, u, v)
                length = length_of_normals(n)
                b = normalize_vjp(unit_normal(n, length, n), length, shape.orientation * adjoint.n)
                total += sink3(target, shape.normal_offset + 3 * tri.i0, w * b)
                total += sink3(target, shape.normal_offset + 3 * tri.i1, u * b)
                total += sink3(target, shape.normal_offset + 3 * tri.i2, v * b)
                a_u += wp.dot(b, n1 - n0)
                a_v += wp.dot(b, n2 - n0)
        else:
            if wp.static(flat):
                a_c += face_normal_vjp(tri, shape.orientation, adjoint.n)
        corners = corners_vjp(tri, u, v, adjoint.x, a_c)
        a0 = corners.p0
        a1 = corners.p1
        a2 = corners.p2
        # Texture coordinates and their tangent.
        if wp.static(uv or tangent):
            c = corner_texcoords(scene, shape, tri)
            t0, t1, t2 = wp.vec2(c.u0, c.v0), wp.vec2(c.u1, c.v1), wp.vec2(c.u2, c.v2)
            a_u += wp.dot(adjoint.uv, t1 - t0)
            a_v += wp.dot(adjoint.uv, t2 - t0)
            c0 = w * adjoint.uv
            c1 = u * adjoint.uv
            c2 = v * adjoint.uv
            if wp.static(tangent):
                g0, g1, g2, h0, h1, h2, _ga = wp.grad(tangent_dot)(tri.p0, tri.p1, tri.p2, t0, t1, t2, adjoint.tangent)
                a0 += g0
                a1 += g1
                a2 += g2
                c0 += h0
                c1 += h1
                c2 += h2
            if wp.static(texcoords):
                if shape.has_uv == 1:
                    total += sink1(target, shape.uv_offset + 2 * tri.i0, c0[0])
                    total += sink1(target, shape.uv_offset + 2 * tri.i0 + 1, c0[1])
                    total += sink1(target, shape.uv_offset + 2 * tri.i1, c1[0])
                    total += sink1(target, shape.uv_offset + 2 * tri.i1 + 1, c1[1])
                    total += sink1(target, shape.uv_offset + 2 * tri.i2, c2[0])
                    total += sink1(target, shape.uv_offset + 2 * tri.i2 + 1, c2[1])
        # Barycentrics attached to the ray that found them.
        if wp.static(rays):
            if by_ray:
                a_u += wp.dot(adjoint.x, e1)
                a_v += wp.dot(adjoint.x, e2)
                b_o, b_d, b_p0, b_p1, b_p2, _bu, _bv = wp.grad(barycentrics_dot)(o, d, tri.p0, tri.p1, tri.p2, a_u, a_v)
                result.o = b_o
                result.d = b_d
                a0 += b_p0
                a1 += b_p1
                a2 += b_p2
        total += sink3(target, scene.positions + 3 * tri.i0, a0)
        total += sink3(target, scene.positions + 3 * tri.i1, a1)
        total += sink3(target, scene.positions + 3 * tri.i2, a2)
        result.dot = total
        return result

    return accumulate_vertex


@wp.kernel(module=SCENE, enable_backward=False)
def update_triangles(
    # In:
    values: wp.array(dtype=wp.float32),
    positions: wp.int32,
    indices: wp.array(dtype=wp.int32),
    face_shape: wp.array(dtype=wp.int32),
    orientation: wp.array(dtype=wp.float32),
    first: wp.int32,
    # Out:
    triangles_out: wp.array(dtype=Triangle),
):
    """Precompute the per-triangle records of faces ``first`` ... from the vertex positions."""
    face = first + wp.tid()
    tri = Triangle()
    tri.i0 = indices[3 * face]
    tri.i1 = indices[3 * face + 1]
    tri.i2 = indices[3 * face + 2]
    tri.shape = face_shape[face]
    tri.p0 = load_vec3(values, positions + 3 * tri.i0)
    tri.p1 = load_vec3(values, positions + 3 * tri.i1)
    tri.p2 = load_vec3(values, positions + 3 * tri.i2)
    tri.normal = orientation[tri.shape] * wp.normalize(wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0))
    triangles_out[face] = tri

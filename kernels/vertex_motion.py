"""Velocities of path vertices on triangles: forward mode's counterpart of ``make_vertex_sink`` (``surface.py``).

A dot denotes the derivative along the tangent. The corners of a triangle move with the tangents of their vertices; with
p'(u, v) the velocity of the material point,

    x' = p'(u, v) + u' e1 + v' e2,

where u' = v' = 0 for a material point, and for a vertex that an attached ray o + t d finds, x lies on that ray:

    u' e1 + v' e2 - t' d = o' + t d' - p'(u, v) =: r        (solved by Cramer's rule).
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.reading import load_vec2, load_vec3
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.surface import tangent_dot


@wp.struct
class VertexTangent:
    """Velocity of a path vertex: position, shading normal, dp/du, texture coordinates, barycentrics."""

    x: wp.vec3
    n: wp.vec3
    c: wp.vec3  # of the cross product of the triangle's edges
    tangent: wp.vec3
    uv: wp.vec2
    u: wp.float32
    v: wp.float32


@wp.func
def normalize_jvp(unit: wp.vec3, length: wp.float32, dot: wp.vec3) -> wp.vec3:
    """Velocity of r / |r| = unit from the velocity of r; 0 where r vanishes (a ray that leaves a shared corner)."""
    if length <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    return (dot - unit * wp.dot(unit, dot)) / length


@functools.cache
def make_vertex_jvp(smooth: bool, flat: bool, uv: bool, tangent: bool):
    """Return ``vertex_jvp(scene, tangents, face, u, v, by_ray, o, d, o_dot, d_dot) -> VertexTangent``.

    ``tangents`` is the flat array of parameter tangents, laid out like ``Scene.values``. ``by_ray``: the barycentrics
    are attached to the ray (o, d), which moves with (o_dot, d_dot).
    """

    @wp.func
    def vertex_jvp(
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
        result = VertexTangent()
        tri = scene.triangles[face]
        shape = scene.shapes[tri.shape]
        w = 1.0 - u - v
        e1 = tri.p1 - tri.p0
        e2 = tri.p2 - tri.p0
        p0 = load_vec3(tangents, scene.positions + 3 * tri.i0)
        p1 = load_vec3(tangents, scene.positions + 3 * tri.i1)
        p2 = load_vec3(tangents, scene.positions + 3 * tri.i2)
        result.x = w * p0 + u * p1 + v * p2
        if by_ray:
            x = w * tri.p0 + u * tri.p1 + v * tri.p2
            t = wp.dot(x - o, d) / wp.dot(d, d)
            r = o_dot + t * d_dot - result.x
            q = wp.cross(d, e2)
            inv_det = 1.0 / wp.dot(e1, q)
            result.u = wp.dot(r, q) * inv_det
            result.v = wp.dot(d, wp.cross(r, e1)) * inv_det
            result.x += result.u * e1 + result.v * e2
        result.c = wp.cross(p1 - p0, e2) + wp.cross(e1, p2 - p0)
        is_smooth = wp.static(smooth) and (shape.smooth == 1 or wp.static(not flat))
        if is_smooth:
            if wp.static(smooth):
                i0 = shape.normal_offset + 3 * tri.i0
                i1 = shape.normal_offset + 3 * tri.i1
                i2 = shape.normal_offset + 3 * tri.i2
                n0 = load_vec3(scene.values, i0)
                n1 = load_vec3(scene.values, i1)
                n2 = load_vec3(scene.values, i2)
                n = w * n0 + u * n1 + v * n2
                squared = wp.dot(n, n)
                if squared > 1.0e-20:
                    n_dot = w * load_vec3(tangents, i0) + u * load_vec3(tangents, i1) + v * load_vec3(tangents, i2)
                    n_dot += result.u * (n1 - n0) + result.v * (n2 - n0)
                    length = wp.sqrt(squared)
                    result.n = shape.orientation * normalize_jvp(n / length, length, n_dot)
        else:
            if wp.static(flat):
                length = wp.length(wp.cross(e1, e2))
                result.n = normalize_jvp(tri.normal, length, shape.orientation * result.c)
        if wp.static(uv or tangent):
            result.uv = wp.vec2(result.u, result.v)
            result.tangent = p1 - p0
            if shape.has_uv == 1:
                j0 = shape.uv_offset + 2 * tri.i0
                j1 = shape.uv_offset + 2 * tri.i1
                j2 = shape.uv_offset + 2 * tri.i2
                t0 = load_vec2(scene.values, j0)
                t1 = load_vec2(scene.values, j1)
                t2 = load_vec2(scene.values, j2)
                d0 = load_vec2(tangents, j0)
                d1 = load_vec2(tangents, j1)
                d2 = load_vec2(tangents, j2)
                result.uv = w * d0 + u * d1 + v * d2 + result.u * (t1 - t0) + result.v * (t2 - t0)
                if wp.static(tangent):
                    for axis in range(3):
                        e = wp.vec3(0.0, 0.0, 0.0)
                        e[axis] = 1.0
                        g0, g1, g2, h0, h1, h2, _e = wp.grad(tangent_dot)(tri.p0, tri.p1, tri.p2, t0, t1, t2, e)
                        result.tangent[axis] = (
                            wp.dot(g0, p0)
                            + wp.dot(g1, p1)
                            + wp.dot(g2, p2)
                            + wp.dot(h0, d0)
                            + wp.dot(h1, d1)
                            + wp.dot(h2, d2)
                        )
        return result

    return vertex_jvp

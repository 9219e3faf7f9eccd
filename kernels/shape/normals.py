"""Vertex normals as a function of vertex positions, and both directions of its derivative.

A vertex normal is the normalised sum of the unit normals of the faces around it, each weighted by the face's angle at
the vertex (G. Thürmer, C. Wüthrich, "Computing Vertex Normals from Polygonal Facets", JGT 3(1), 1998), which makes it
independent of the triangulation. With N_v the sum and n_v = N_v / |N_v|, reverse mode pulls the adjoint of n_v through
the normalisation, then through every face around v; forward mode pushes the tangents of a face's corners to its three
contributions, then through the normalisation.
"""

import warp as wp

from warp_psdr.kernels.autodiff import differentiable
from warp_psdr.kernels.modules import DERIVED_JVP, DERIVED_VJP, SCENE
from warp_psdr.kernels.reading import load_vec3


@wp.func
def corner_angle(a: wp.vec3, b: wp.vec3) -> wp.float32:
    """Angle between two edges; atan2 keeps full precision and a finite derivative near 0 and pi."""
    return wp.atan2(wp.length(wp.cross(a, b)), wp.dot(a, b))


@differentiable
@wp.func
def weighted_normal_dot(p0: wp.vec3, p1: wp.vec3, p2: wp.vec3, a0: wp.vec3, a1: wp.vec3, a2: wp.vec3) -> wp.float32:
    """Local factor of a face: its contributions to the sums at its three corners."""
    n = wp.normalize(wp.cross(p1 - p0, p2 - p0))
    w0 = corner_angle(p1 - p0, p2 - p0)
    w1 = corner_angle(p2 - p1, p0 - p1)
    w2 = corner_angle(p0 - p2, p1 - p2)
    return w0 * wp.dot(a0, n) + w1 * wp.dot(a1, n) + w2 * wp.dot(a2, n)


@differentiable
@wp.func
def normalized_dot(n: wp.vec3, a: wp.vec3) -> wp.float32:
    return wp.dot(a, wp.normalize(n))


@wp.func
def add_vec3(array: wp.array(dtype=wp.float32), offset: wp.int32, value: wp.vec3):
    wp.atomic_add(array, offset, value[0])
    wp.atomic_add(array, offset + 1, value[1])
    wp.atomic_add(array, offset + 2, value[2])


@wp.struct
class Face:
    """A triangle's vertices: global numbers and positions."""

    i0: wp.int32
    i1: wp.int32
    i2: wp.int32
    p0: wp.vec3
    p1: wp.vec3
    p2: wp.vec3


@wp.func
def load_face(
    values: wp.array(dtype=wp.float32), positions: wp.int32, indices: wp.array(dtype=wp.int32), face: wp.int32
) -> Face:
    f = Face()
    f.i0 = indices[3 * face]
    f.i1 = indices[3 * face + 1]
    f.i2 = indices[3 * face + 2]
    f.p0 = load_vec3(values, positions + 3 * f.i0)
    f.p1 = load_vec3(values, positions + 3 * f.i1)
    f.p2 = load_vec3(values, positions + 3 * f.i2)
    return f


@wp.kernel(module=SCENE, enable_backward=False)
def sum_normals(
    # In:
    values: wp.array(dtype=wp.float32),
    positions: wp.int32,
    indices: wp.array(dtype=wp.int32),
    first_face: wp.int32,
    first_vertex: wp.int32,
    # Out:
    sums_out: wp.array(dtype=wp.float32),
):
    """Add the weighted normals of a shape's faces to ``sums_out`` (3 floats a vertex, local vertex numbers)."""
    f = load_face(values, positions, indices, first_face + wp.tid())
    n = wp.normalize(wp.cross(f.p1 - f.p0, f.p2 - f.p0))
    add_vec3(sums_out, 3 * (f.i0 - first_vertex), corner_angle(f.p1 - f.p0, f.p2 - f.p0) * n)
    add_vec3(sums_out, 3 * (f.i1 - first_vertex), corner_angle(f.p2 - f.p1, f.p0 - f.p1) * n)
    add_vec3(sums_out, 3 * (f.i2 - first_vertex), corner_angle(f.p0 - f.p2, f.p1 - f.p2) * n)


@wp.kernel(module=SCENE, enable_backward=False)
def normalize_sums(
    # In:
    sums: wp.array(dtype=wp.float32),
    offset: wp.int32,
    # Out:
    values_out: wp.array(dtype=wp.float32),
):
    """Write unit normals; a vertex without faces keeps the zero vector."""
    i = wp.tid()
    n = wp.normalize(load_vec3(sums, 3 * i))
    values_out[offset + 3 * i] = n[0]
    values_out[offset + 3 * i + 1] = n[1]
    values_out[offset + 3 * i + 2] = n[2]


@wp.kernel(module=DERIVED_VJP, enable_backward=False)
def normalization_vjp(
    # In:
    sums: wp.array(dtype=wp.float32),
    grad: wp.array(dtype=wp.float32),
    offset: wp.int32,
    # Out:
    adjoint_out: wp.array(dtype=wp.float32),
):
    """Adjoint of the sums from the adjoint of the unit normals."""
    i = wp.tid()
    n = load_vec3(sums, 3 * i)
    # 0 where n is.
    a, _w = wp.grad(normalized_dot)(n, load_vec3(grad, offset + 3 * i))
    adjoint_out[3 * i] = a[0]
    adjoint_out[3 * i + 1] = a[1]
    adjoint_out[3 * i + 2] = a[2]


@wp.kernel(module=DERIVED_VJP, enable_backward=False)
def sum_normals_vjp(
    # In:
    values: wp.array(dtype=wp.float32),
    positions: wp.int32,
    indices: wp.array(dtype=wp.int32),
    first_face: wp.int32,
    first_vertex: wp.int32,
    adjoint: wp.array(dtype=wp.float32),
    # Out:
    grad_out: wp.array(dtype=wp.float32),
):
    """Add the adjoint of the vertex positions, given the adjoint of the sums."""
    f = load_face(values, positions, indices, first_face + wp.tid())
    b0, b1, b2, _a0, _a1, _a2 = wp.grad(weighted_normal_dot)(
        f.p0,
        f.p1,
        f.p2,
        load_vec3(adjoint, 3 * (f.i0 - first_vertex)),
        load_vec3(adjoint, 3 * (f.i1 - first_vertex)),
        load_vec3(adjoint, 3 * (f.i2 - first_vertex)),
    )
    add_vec3(grad_out, positions + 3 * f.i0, b0)
    add_vec3(grad_out, positions + 3 * f.i1, b1)
    add_vec3(grad_out, positions + 3 * f.i2, b2)


@wp.kernel(module=DERIVED_JVP, enable_backward=False)
def sum_normals_jvp(
    # In:
    values: wp.array(dtype=wp.float32),
    positions: wp.int32,
    indices: wp.array(dtype=wp.int32),
    first_face: wp.int32,
    first_vertex: wp.int32,
    tangent: wp.array(dtype=wp.float32),
    # Out:
    sums_out: wp.array(dtype=wp.float32),
):
    """Tangent of the sums: one vector-Jacobian product for each of a face's nine outputs."""
    f = load_face(values, positions, indices, first_face + wp.tid())
    d0 = load_vec3(tangent, positions + 3 * f.i0)
    d1 = load_vec3(tangent, positions + 3 * f.i1)
    d2 = load_vec3(tangent, positions + 3 * f.i2)
    zero = wp.vec3(0.0, 0.0, 0.0)
    for axis in range(3):
        e = wp.vec3(0.0, 0.0, 0.0)
        e[axis] = 1.0
        b0, b1, b2, _x0, _x1, _x2 = wp.grad(weighted_normal_dot)(f.p0, f.p1, f.p2, e, zero, zero)
        c0, c1, c2, _y0, _y1, _y2 = wp.grad(weighted_normal_dot)(f.p0, f.p1, f.p2, zero, e, zero)
        f0, f1, f2, _z0, _z1, _z2 = wp.grad(weighted_normal_dot)(f.p0, f.p1, f.p2, zero, zero, e)
        wp.atomic_add(sums_out, 3 * (f.i0 - first_vertex) + axis, wp.dot(b0, d0) + wp.dot(b1, d1) + wp.dot(b2, d2))
        wp.atomic_add(sums_out, 3 * (f.i1 - first_vertex) + axis, wp.dot(c0, d0) + wp.dot(c1, d1) + wp.dot(c2, d2))
        wp.atomic_add(sums_out, 3 * (f.i2 - first_vertex) + axis, wp.dot(f0, d0) + wp.dot(f1, d1) + wp.dot(f2, d2))


@wp.kernel(module=DERIVED_JVP, enable_backward=False)
def normalization_jvp(
    # In:
    sums: wp.array(dtype=wp.float32),
    sums_tangent: wp.array(dtype=wp.float32),
    offset: wp.int32,
    # Out:
    tangent_out: wp.array(dtype=wp.float32),
):
    """Add the tangent of the unit normals: (d - n (n . d)) / |N|."""
    i = wp.tid()
    n = load_vec3(sums, 3 * i)
    length = wp.length(n)
    if length > 0.0:
        unit = n / length
        d = load_vec3(sums_tangent, 3 * i)
        add_vec3(tangent_out, offset + 3 * i, (d - unit * wp.dot(unit, d)) / length)

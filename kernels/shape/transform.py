"""Vertices and normals of a shape as a function of its ``to_world`` matrix, and both directions of the derivative.

x = M p + t for positions; n = normalize(M^-T n_local) for normals, with M^-T = cof(M) / det(M) and cof(M) the cross
products of the rows of M. Both are differentiated in all of the upper twelve entries: translation, rotation, scale and
shear alike.
"""

import warp as wp

from warp_psdr.kernels.autodiff import differentiable
from warp_psdr.kernels.modules import DERIVED_JVP, DERIVED_VJP, SCENE
from warp_psdr.kernels.reading import load_vec3
from warp_psdr.kernels.sensor.camera import load_mat44
from warp_psdr.kernels.shape.normals import add_vec3


@wp.func
def transform_point(m: wp.mat44, p: wp.vec3) -> wp.vec3:
    return wp.vec3(
        m[0, 0] * p[0] + m[0, 1] * p[1] + m[0, 2] * p[2] + m[0, 3],
        m[1, 0] * p[0] + m[1, 1] * p[1] + m[1, 2] * p[2] + m[1, 3],
        m[2, 0] * p[0] + m[2, 1] * p[1] + m[2, 2] * p[2] + m[2, 3],
    )


@wp.func
def transform_normal(m: wp.mat44, n: wp.vec3) -> wp.vec3:
    r0 = wp.vec3(m[0, 0], m[0, 1], m[0, 2])
    r1 = wp.vec3(m[1, 0], m[1, 1], m[1, 2])
    r2 = wp.vec3(m[2, 0], m[2, 1], m[2, 2])
    c0 = wp.cross(r1, r2)
    c1 = wp.cross(r2, r0)
    c2 = wp.cross(r0, r1)
    # Of the determinant only the sign counts: dividing by it fails where a pose has no volume.
    turn = wp.where(wp.dot(r0, c0) < 0.0, -1.0, 1.0)
    return turn * wp.normalize(wp.vec3(wp.dot(c0, n), wp.dot(c1, n), wp.dot(c2, n)))


@differentiable
@wp.func
def moved_point_dot(m: wp.mat44, p: wp.vec3, a: wp.vec3) -> wp.float32:
    return wp.dot(a, transform_point(m, p))


@differentiable
@wp.func
def normal_dot(m: wp.mat44, n: wp.vec3, a: wp.vec3) -> wp.float32:
    return wp.dot(a, transform_normal(m, n))


@wp.func
def moved_point_jvp(m: wp.mat44, p: wp.vec3, dm: wp.mat44, dp: wp.vec3) -> wp.vec3:
    """Tangent of ``transform_point``."""
    result = wp.vec3(0.0, 0.0, 0.0)
    for axis in range(3):
        e = wp.vec3(0.0, 0.0, 0.0)
        e[axis] = 1.0
        g, h, _a = wp.grad(moved_point_dot)(m, p, e)
        result[axis] = wp.ddot(g, dm) + wp.dot(h, dp)
    return result


@wp.func
def normal_jvp(m: wp.mat44, n: wp.vec3, dm: wp.mat44, dn: wp.vec3) -> wp.vec3:
    """Tangent of ``transform_normal``."""
    result = wp.vec3(0.0, 0.0, 0.0)
    for axis in range(3):
        e = wp.vec3(0.0, 0.0, 0.0)
        e[axis] = 1.0
        g, h, _a = wp.grad(normal_dot)(m, n, e)
        result[axis] = wp.ddot(g, dm) + wp.dot(h, dn)
    return result


@wp.func
def store_vec3(array: wp.array(dtype=wp.float32), offset: wp.int32, value: wp.vec3):
    array[offset] = value[0]
    array[offset + 1] = value[1]
    array[offset + 2] = value[2]


@wp.kernel(module=SCENE, enable_backward=False)
def pose_shape(
    # In:
    local_positions: wp.array(dtype=wp.vec3),
    local_normals: wp.array(dtype=wp.vec3),
    to_world: wp.int32,
    position_offset: wp.int32,
    normal_offset: wp.int32,
    # Out:
    values_out: wp.array(dtype=wp.float32),
):
    """Write world positions and, where ``normal_offset`` >= 0, world normals."""
    i = wp.tid()
    m = load_mat44(values_out, to_world)
    store_vec3(values_out, position_offset + 3 * i, transform_point(m, local_positions[i]))
    if normal_offset >= 0:
        store_vec3(values_out, normal_offset + 3 * i, transform_normal(m, local_normals[i]))


@wp.kernel(module=DERIVED_VJP, enable_backward=False)
def pose_shape_vjp(
    # In:
    values: wp.array(dtype=wp.float32),
    local_positions: wp.array(dtype=wp.vec3),
    local_normals: wp.array(dtype=wp.vec3),
    to_world: wp.int32,
    position_offset: wp.int32,
    normal_offset: wp.int32,
    grad: wp.array(dtype=wp.float32),
    # Out:
    pose_out: wp.array2d(dtype=wp.float64),
):
    """Add the gradient of ``to_world``'s upper three rows, given the flat gradient of positions and normals."""
    i = wp.tid()
    m = load_mat44(values, to_world)
    g, _p, _a = wp.grad(moved_point_dot)(m, local_positions[i], load_vec3(grad, position_offset + 3 * i))
    if normal_offset >= 0:
        h, _n, _b = wp.grad(normal_dot)(m, local_normals[i], load_vec3(grad, normal_offset + 3 * i))
        g = g + h
    for row in range(3):
        for column in range(4):
            wp.atomic_add(pose_out, row, column, wp.float64(g[row, column]))


@wp.kernel(module=DERIVED_VJP, enable_backward=False)
def add_pose(
    # In:
    pose: wp.array2d(dtype=wp.float64),
    to_world: wp.int32,
    # In and out:
    grad_out: wp.array(dtype=wp.float32),
):
    """Add the gradient of ``to_world``'s upper three rows to the flat gradient."""
    row, column = wp.tid()
    i = to_world + 4 * row + column
    grad_out[i] = wp.float32(wp.float64(grad_out[i]) + pose[row, column])


@wp.kernel(module=DERIVED_JVP, enable_backward=False)
def pose_shape_jvp(
    # In:
    values: wp.array(dtype=wp.float32),
    local_positions: wp.array(dtype=wp.vec3),
    local_normals: wp.array(dtype=wp.vec3),
    to_world: wp.int32,
    position_offset: wp.int32,
    normal_offset: wp.int32,
    # In and out:
    tangent_out: wp.array(dtype=wp.float32),
):
    """Add the tangents of positions and normals, given the tangent of ``to_world`` in the same flat array."""
    i = wp.tid()
    m = load_mat44(values, to_world)
    dm = load_mat44(tangent_out, to_world)
    rest = wp.vec3(0.0, 0.0, 0.0)
    add_vec3(tangent_out, position_offset + 3 * i, moved_point_jvp(m, local_positions[i], dm, rest))
    if normal_offset >= 0:
        add_vec3(tangent_out, normal_offset + 3 * i, normal_jvp(m, local_normals[i], dm, rest))


@wp.kernel(module=DERIVED_VJP, enable_backward=False)
def local_shape_vjp(
    # In:
    values: wp.array(dtype=wp.float32),
    local_positions: wp.array(dtype=wp.vec3),
    local_normals: wp.array(dtype=wp.vec3),
    to_world: wp.int32,
    position_offset: wp.int32,
    normal_offset: wp.int32,
    grad: wp.array(dtype=wp.float32),
    # In and out:
    positions_out: wp.array(dtype=wp.float64),
    normals_out: wp.array(dtype=wp.float64),
):
    """Add the gradient of the local positions and normals, given the flat gradient of those in the world."""
    i = wp.tid()
    m = load_mat44(values, to_world)
    _m, g, _a = wp.grad(moved_point_dot)(m, local_positions[i], load_vec3(grad, position_offset + 3 * i))
    for axis in range(3):
        positions_out[3 * i + axis] = positions_out[3 * i + axis] + wp.float64(g[axis])
    if normal_offset >= 0:
        _n, h, _b = wp.grad(normal_dot)(m, local_normals[i], load_vec3(grad, normal_offset + 3 * i))
        for axis in range(3):
            normals_out[3 * i + axis] = normals_out[3 * i + axis] + wp.float64(h[axis])


@wp.kernel(module=DERIVED_VJP, enable_backward=False)
def add_sums(
    # In:
    sums: wp.array(dtype=wp.float64),
    offset: wp.int32,
    # In and out:
    grad_out: wp.array(dtype=wp.float32),
):
    """Add float64 sums to a stretch of the flat gradient."""
    i = wp.tid()
    grad_out[offset + i] = wp.float32(wp.float64(grad_out[offset + i]) + sums[i])


@wp.kernel(module=DERIVED_JVP, enable_backward=False)
def local_shape_jvp(
    # In:
    values: wp.array(dtype=wp.float32),
    local_positions: wp.array(dtype=wp.vec3),
    local_normals: wp.array(dtype=wp.vec3),
    to_world: wp.int32,
    position_offset: wp.int32,
    normal_offset: wp.int32,
    local_position_offset: wp.int32,
    local_normal_offset: wp.int32,
    # In and out:
    tangent_out: wp.array(dtype=wp.float32),
):
    """Add the tangents of positions and normals in the world, given those of the local ones in the same flat array."""
    i = wp.tid()
    m = load_mat44(values, to_world)
    rest = wp.mat44()
    dp = load_vec3(tangent_out, local_position_offset + 3 * i)
    add_vec3(tangent_out, position_offset + 3 * i, moved_point_jvp(m, local_positions[i], rest, dp))
    if normal_offset >= 0:
        dn = load_vec3(tangent_out, local_normal_offset + 3 * i)
        add_vec3(tangent_out, normal_offset + 3 * i, normal_jvp(m, local_normals[i], rest, dn))

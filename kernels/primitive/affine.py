"""Records of shapes without triangles: their pose x = A q + b, and what follows from it.

The records follow those of the triangles. They are ``Triangle``s whose corners are the columns of A, whose normal is b,
and whose ``i1`` is -1 less the number of their kind (``kind.py``); ``i0`` is the flat offset of the pose, ``i2`` the
sign of c = cof(A) n against normals n.

Derivation: ``docs/theory/implicit.md#material-form``.
"""

import functools

import warp as wp

from warp_psdr.kernels.modules import SCENE
from warp_psdr.kernels.reading import triangle_int
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.step import RESOLVED
from warp_psdr.kernels.structs import Scene, Triangle

#: Word of ``Triangle.i1`` in the record (``reading.py``).
KIND_WORD = 13


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

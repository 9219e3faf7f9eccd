"""Surfaces as level sets phi = 0 near a point: triangles, affine shapes, grids of signed distances and curves.

Newton's steps to a curve of intersection need phi and its gradient. The sinks in this file scatter the adjoint of a
point that moves with a surface along its normal: n . x' = -phi_pi / |grad phi|.

Derivation: ``docs/theory/implicit.md#curves-of-intersection``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.crossing.tube import tube_across
from warp_psdr.kernels.boundary.local_form import barycentrics_at
from warp_psdr.kernels.boundary.silhouette.tube_sink import make_tube_sink
from warp_psdr.kernels.constants import (
    PRIMITIVE_CYLINDER,
    PRIMITIVE_DISK,
    PRIMITIVE_SDFGRID,
    PRIMITIVE_SDFGRID_CUBIC,
    PRIMITIVE_SPHERE,
)
from warp_psdr.kernels.primitive.affine import cofactor, determinant, from_axes, is_primitive, make_pose_sink
from warp_psdr.kernels.primitive.dispatch import CURVES, GRIDS, is_bspline, is_cubic, is_grid, is_linear
from warp_psdr.kernels.primitive.kinds import affine_kinds, join
from warp_psdr.kernels.primitive.sdfgrid import Grid, grid_of, value_and_gradient, voxel_at, voxel_corner
from warp_psdr.kernels.primitive.sdfgrid_adjoint import make_voxel_sink
from warp_psdr.kernels.primitive.sdfgrid_cubic import spline_field
from warp_psdr.kernels.primitive.sdfgrid_cubic_surface import make_spline_sink
from warp_psdr.kernels.sink import make_sink_vec3
from warp_psdr.kernels.structs import Scene, Triangle


@wp.func
def sphere_level(q: wp.vec3) -> wp.vec4:
    """(gradient, phi) in the shape's coordinates; phi is positive outside."""
    return wp.vec4(q[0], q[1], q[2], 0.5 * (wp.dot(q, q) - 1.0))


@wp.func
def cylinder_level(q: wp.vec3) -> wp.vec4:
    return wp.vec4(q[0], q[1], 0.0, 0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0))


@wp.func
def disk_level(q: wp.vec3) -> wp.vec4:
    return wp.vec4(0.0, 0.0, 1.0, q[2])


#: Kind (PRIMITIVE_*) -> its level function.
LEVELS: dict[int, wp.Function] = {
    PRIMITIVE_SPHERE: sphere_level,
    PRIMITIVE_CYLINDER: cylinder_level,
    PRIMITIVE_DISK: disk_level,
}


@wp.func
def voxel_of(g: Grid, p: wp.vec3) -> wp.vec3i:
    """The voxel around a point, in voxels."""
    return wp.vec3i(
        wp.clamp(wp.int32(p[0]), 0, g.nx - 2),
        wp.clamp(wp.int32(p[1]), 0, g.ny - 2),
        wp.clamp(wp.int32(p[2]), 0, g.nz - 2),
    )


@functools.cache
def make_grid_field(primitives: tuple[int, ...]):
    """Return ``field(scene, tri, g, at, place) -> (gradient, phi)`` in voxels, at a place in the voxel ``at``."""
    linear = PRIMITIVE_SDFGRID in primitives
    cubic = PRIMITIVE_SDFGRID_CUBIC in primitives

    @wp.func
    def grid_field(scene: Scene, tri: Triangle, g: Grid, at: wp.vec3i, place: wp.vec3) -> wp.vec4:
        if wp.static(cubic):
            if wp.static(not linear) or is_cubic(tri):
                return spline_field(scene, g, at[0], at[1], at[2], place)
        return value_and_gradient(voxel_at(scene, g, at[0], at[1], at[2]), place)

    return grid_field


@functools.cache
def make_level_at(primitives: tuple[int, ...]):
    """Return ``level(scene, face, segment, place, x) -> (gradient, phi)`` of the surface of a record, in the world.

    Of curves one segment is meant, about a place along it; others have none.
    """
    has_curves = bool(set(CURVES) & set(primitives))
    of_affine = join(_either_level, {kind: _make_affine_level(LEVELS[kind]) for kind in affine_kinds(primitives)})
    has_grids = bool(set(GRIDS) & set(primitives))
    grid_field = make_grid_field(primitives)

    @wp.func
    def level_at(scene: Scene, face: wp.int32, segment: wp.int32, place: wp.float32, x: wp.vec3) -> wp.vec4:
        tri = scene.triangles[face]
        if is_primitive(tri):
            if wp.static(has_curves):
                if is_bspline(tri) or is_linear(tri):
                    point = tube_across(scene, tri, face, segment, place, x)
                    n = point.gradient
                    return wp.vec4(n[0], n[1], n[2], wp.length(x - point.f.c) - point.f.r)
            if wp.static(has_grids):
                if wp.static(of_affine is None) or is_grid(tri):
                    g = grid_of(scene, tri)
                    p = wp.cw_mul(g.cells, from_axes(tri, x - tri.normal))
                    at = voxel_of(g, p)
                    f = grid_field(scene, tri, g, at, p - voxel_corner(at[0], at[1], at[2]))
                    slope = cofactor(tri, wp.cw_mul(g.cells, wp.vec3(f[0], f[1], f[2]))) / determinant(tri)
                    return wp.vec4(slope[0], slope[1], slope[2], f[3])
            if wp.static(of_affine is not None):
                return of_affine(tri, x)
        n = tri.normal
        return wp.vec4(n[0], n[1], n[2], wp.dot(n, x - tri.p0))

    return level_at


def _make_affine_level(level: wp.Function) -> wp.Function:
    @wp.func
    def affine_level(tri: Triangle, x: wp.vec3) -> wp.vec4:
        f = level(from_axes(tri, x - tri.normal))
        slope = cofactor(tri, wp.vec3(f[0], f[1], f[2])) / determinant(tri)
        return wp.vec4(slope[0], slope[1], slope[2], f[3])

    return affine_level


def _either_level(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def level_of_kind(tri: Triangle, x: wp.vec3) -> wp.vec4:
        if tri.i1 == word:
            return f(tri, x)
        return rest(tri, x)

    return level_of_kind


@functools.cache
def make_level_sink(role: str, primitives: tuple[int, ...]):
    """Return ``accumulate(scene, target, face, segment, place, x, a) -> float``.

    a is the adjoint of a point, along the surface's normal; ``segment`` and ``place`` are as in ``make_level_at``.
    """
    has_curves = bool(set(CURVES) & set(primitives))
    accumulate_tube = make_tube_sink(role, primitives) if has_curves else None
    sink3 = make_sink_vec3(role)
    accumulate_pose = make_pose_sink(role)
    has_grids = bool(set(GRIDS) & set(primitives))
    only_grids = not affine_kinds(primitives)
    grid_field = make_grid_field(primitives)
    linear = PRIMITIVE_SDFGRID in primitives
    cubic = PRIMITIVE_SDFGRID_CUBIC in primitives
    accumulate_voxel = make_voxel_sink(role) if linear else None
    accumulate_spline = make_spline_sink(role) if cubic else None

    @wp.func
    def accumulate_level(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        face: wp.int32,
        segment: wp.int32,
        place: wp.float32,
        x: wp.vec3,
        a: wp.vec3,
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        tri = scene.triangles[face]
        total = wp.float32(0.0)
        if is_primitive(tri):
            if wp.static(has_curves):
                if is_bspline(tri) or is_linear(tri):
                    return accumulate_tube(scene, target, tube_across(scene, tri, face, segment, place, x), a)
            q = from_axes(tri, x - tri.normal)
            if wp.static(has_grids):
                if wp.static(only_grids) or is_grid(tri):
                    g = grid_of(scene, tri)
                    p = wp.cw_mul(g.cells, q)
                    at = voxel_of(g, p)
                    inside = p - voxel_corner(at[0], at[1], at[2])
                    f = grid_field(scene, tri, g, at, inside)
                    slope = wp.vec3(f[0], f[1], f[2])
                    # x = A p / cells + b, p' = -phi' slope / |slope|^2.
                    pulled = wp.cw_div(wp.vec3(wp.dot(tri.p0, a), wp.dot(tri.p1, a), wp.dot(tri.p2, a)), g.cells)
                    a_phi = -wp.dot(pulled, slope) / wp.length_sq(slope)
                    zero = wp.vec3(0.0, 0.0, 0.0)
                    if wp.static(cubic):
                        if wp.static(not linear) or is_cubic(tri):
                            total += accumulate_spline(target, g, at[0], at[1], at[2], inside, a_phi, zero)
                    if wp.static(linear):
                        if wp.static(not cubic) or not is_cubic(tri):
                            total += accumulate_voxel(target, g, at[0], at[1], at[2], inside, a_phi, zero)
            total += accumulate_pose(target, tri, q[0] * a, q[1] * a, q[2] * a, a)
        else:
            uv = barycentrics_at(tri, x)
            total += sink3(target, scene.positions + 3 * tri.i0, (1.0 - uv[0] - uv[1]) * a)
            total += sink3(target, scene.positions + 3 * tri.i1, uv[0] * a)
            total += sink3(target, scene.positions + 3 * tri.i2, uv[1] * a)
        return total

    return accumulate_level

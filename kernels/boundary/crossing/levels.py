"""Surfaces as level sets phi = 0 near a point: triangles, affine shapes, grids of signed distances and curves.

Newton's steps to a curve of intersection need phi and its gradient. The sinks in this file scatter the adjoint of a
point that moves with a surface along its normal: n . x' = -phi_pi / |grad phi|.

Derivation: ``docs/theory/implicit.md#curves-of-intersection``.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.crossing.tube import tube_across
from warp_psdr.kernels.boundary.local_form import barycentrics_at
from warp_psdr.kernels.boundary.silhouette.tube_sink import make_tube_sink
from warp_psdr.kernels.primitive.affine import cofactor, determinant, from_axes, is_primitive, make_pose_sink
from warp_psdr.kernels.primitive.cubic_grid import CUBIC_GRID
from warp_psdr.kernels.primitive.curve_kinds import CURVES
from warp_psdr.kernels.primitive.kind import Affine
from warp_psdr.kernels.primitive.linear_grid import LINEAR_GRID
from warp_psdr.kernels.primitive.sdfgrid import Grid, grid_of, value_and_gradient, voxel_at, voxel_corner, voxel_of
from warp_psdr.kernels.primitive.sdfgrid_adjoint import make_voxel_sink
from warp_psdr.kernels.primitive.sdfgrid_cubic import spline_field
from warp_psdr.kernels.primitive.sdfgrid_cubic_surface import make_spline_sink
from warp_psdr.kernels.primitive.table import affine_of, join
from warp_psdr.kernels.sink import make_sink_vec3
from warp_psdr.kernels.structs import Scene, Triangle


class Level(NamedTuple):
    """A kind of shapes as level sets. ``segment`` and ``place`` tell which part of a curve is meant.

    Attributes:
        at: ``(scene, tri, face, segment, place, x) -> (gradient, phi)`` in the world.
        make_sink: role -> ``(scene, target, tri, face, segment, place, x, a) -> float``: a is the adjoint of a point,
            along the surface's normal.
    """

    at: wp.Function
    make_sink: Callable[[str], wp.Function]


@functools.cache
def make_affine_level(affine: Affine) -> Level:
    """Return the functions of an affine kind."""

    @wp.func
    def affine_level(
        scene: Scene, tri: Triangle, face: wp.int32, segment: wp.int32, place: wp.float32, x: wp.vec3
    ) -> wp.vec4:
        f = affine.level(from_axes(tri, x - tri.normal))
        slope = cofactor(tri, wp.vec3(f[0], f[1], f[2])) / determinant(tri)
        return wp.vec4(slope[0], slope[1], slope[2], f[3])

    def make_sink(role: str) -> wp.Function:
        accumulate_pose = make_pose_sink(role)

        @wp.func
        def accumulate_affine_level(
            scene: Scene,
            target: wp.array(dtype=wp.float32),
            tri: Triangle,
            face: wp.int32,
            segment: wp.int32,
            place: wp.float32,
            x: wp.vec3,
            a: wp.vec3,
        ) -> wp.float32:
            q = from_axes(tri, x - tri.normal)
            return accumulate_pose(target, tri, q[0] * a, q[1] * a, q[2] * a, a)

        return accumulate_affine_level

    return Level(affine_level, make_sink)


@wp.func
def linear_field(scene: Scene, g: Grid, i: wp.int32, j: wp.int32, k: wp.int32, x: wp.vec3) -> wp.vec4:
    """(gradient, phi) in a voxel of a linear grid."""
    return value_and_gradient(voxel_at(scene, g, i, j, k), x)


@functools.cache
def make_grid_level(field: wp.Function, make_field_sink: Callable[[str], wp.Function]) -> Level:
    """Return the functions of a kind of grids, from (gradient, phi) in a voxel and the sink for phi's adjoint."""

    @wp.func
    def grid_level(
        scene: Scene, tri: Triangle, face: wp.int32, segment: wp.int32, place: wp.float32, x: wp.vec3
    ) -> wp.vec4:
        g = grid_of(scene, tri)
        p = wp.cw_mul(g.cells, from_axes(tri, x - tri.normal))
        at = voxel_of(g, p)
        f = field(scene, g, at[0], at[1], at[2], p - voxel_corner(at[0], at[1], at[2]))
        slope = cofactor(tri, wp.cw_mul(g.cells, wp.vec3(f[0], f[1], f[2]))) / determinant(tri)
        return wp.vec4(slope[0], slope[1], slope[2], f[3])

    def make_sink(role: str) -> wp.Function:
        accumulate_pose = make_pose_sink(role)
        accumulate_field = make_field_sink(role)

        @wp.func
        def accumulate_grid_level(
            scene: Scene,
            target: wp.array(dtype=wp.float32),
            tri: Triangle,
            face: wp.int32,
            segment: wp.int32,
            place: wp.float32,
            x: wp.vec3,
            a: wp.vec3,
        ) -> wp.float32:
            q = from_axes(tri, x - tri.normal)
            g = grid_of(scene, tri)
            p = wp.cw_mul(g.cells, q)
            at = voxel_of(g, p)
            inside = p - voxel_corner(at[0], at[1], at[2])
            f = field(scene, g, at[0], at[1], at[2], inside)
            slope = wp.vec3(f[0], f[1], f[2])
            # x = A p / cells + b, p' = -phi' slope / |slope|^2.
            pulled = wp.cw_div(wp.vec3(wp.dot(tri.p0, a), wp.dot(tri.p1, a), wp.dot(tri.p2, a)), g.cells)
            a_phi = -wp.dot(pulled, slope) / wp.length_sq(slope)
            zero = wp.vec3(0.0, 0.0, 0.0)
            total = wp.float32(0.0)
            total += accumulate_field(target, g, at[0], at[1], at[2], inside, a_phi, zero)
            total += accumulate_pose(target, tri, q[0] * a, q[1] * a, q[2] * a, a)
            return total

        return accumulate_grid_level

    return Level(grid_level, make_sink)


@functools.cache
def make_curve_level(primitives: tuple[int, ...]) -> Level:
    """Return the functions of the kinds of curves of a scene."""

    @wp.func
    def curve_level(
        scene: Scene, tri: Triangle, face: wp.int32, segment: wp.int32, place: wp.float32, x: wp.vec3
    ) -> wp.vec4:
        point = tube_across(scene, tri, face, segment, place, x)
        n = point.gradient
        return wp.vec4(n[0], n[1], n[2], wp.length(x - point.f.c) - point.f.r)

    def make_sink(role: str) -> wp.Function:
        accumulate_tube = make_tube_sink(role, primitives)

        @wp.func
        def accumulate_curve_level(
            scene: Scene,
            target: wp.array(dtype=wp.float32),
            tri: Triangle,
            face: wp.int32,
            segment: wp.int32,
            place: wp.float32,
            x: wp.vec3,
            a: wp.vec3,
        ) -> wp.float32:
            _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
            return accumulate_tube(scene, target, tube_across(scene, tri, face, segment, place, x), a)

        return accumulate_curve_level

    return Level(curve_level, make_sink)


def levels_of(primitives: tuple[int, ...]) -> dict[int, Level]:
    """Return what is known of the kinds of a scene: number -> functions; networks cross nothing."""
    known = {number: make_curve_level(primitives) for number in CURVES}
    known[CUBIC_GRID.number] = make_grid_level(spline_field, make_spline_sink)
    known[LINEAR_GRID.number] = make_grid_level(linear_field, make_voxel_sink)
    known |= {number: make_affine_level(affine) for number, affine in affine_of(primitives).items()}
    return {number: level for number, level in known.items() if number in primitives}


@functools.cache
def make_level_at(primitives: tuple[int, ...]):
    """Return ``level(scene, face, segment, place, x) -> (gradient, phi)`` of the surface of a record, in the world.

    Of curves one segment is meant, about a place along it; others have none.
    """
    of_kind = join("level_of_kind", {number: level.at for number, level in levels_of(primitives).items()})

    @wp.func
    def level_at(scene: Scene, face: wp.int32, segment: wp.int32, place: wp.float32, x: wp.vec3) -> wp.vec4:
        tri = scene.triangles[face]
        if wp.static(of_kind is not None):
            if is_primitive(tri):
                return of_kind(scene, tri, face, segment, place, x)
        n = tri.normal
        return wp.vec4(n[0], n[1], n[2], wp.dot(n, x - tri.p0))

    return level_at


@functools.cache
def make_level_sink(role: str, primitives: tuple[int, ...]):
    """Return ``accumulate(scene, target, face, segment, place, x, a) -> float``.

    a is the adjoint of a point, along the surface's normal; ``segment`` and ``place`` are as in ``make_level_at``.
    """
    made = {number: level.make_sink(role) for number, level in levels_of(primitives).items()}
    of_kind = join("accumulate_level_of_kind", made, anchored=True)
    sink3 = make_sink_vec3(role)

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
        if wp.static(of_kind is not None):
            if is_primitive(tri):
                return of_kind(scene, target, tri, face, segment, place, x, a)
        total = wp.float32(0.0)
        uv = barycentrics_at(tri, x)
        total += sink3(target, scene.positions + 3 * tri.i0, (1.0 - uv[0] - uv[1]) * a)
        total += sink3(target, scene.positions + 3 * tri.i1, uv[0] * a)
        total += sink3(target, scene.positions + 3 * tri.i2, uv[1] * a)
        return total

    return accumulate_level

"""Textures that are volumes (Mitsuba's ``volume``): grids of voxels, read at the surface's position in the scene.

The value at x is t(q), q = W x in the grid's unit cube (``medium/volume.py``). It is linear in the voxels. Its adjoint
a_q = (dt/dq)^T w goes to W as a_q (x, 1)^T, and to x as W^T a_q. A surface that moves slides through the texture: x
rides on the corners of its triangle, and barycentrics that a ray finds are attached too; on shapes without triangles it
moves as their vertices do (``primitive/kind.py``). Nearest voxels have no slope, so parameters that slide them are
refused (``warp_psdr/plan/steps.py``).

Derivation: ``docs/theory/interior.md#textures-that-are-volumes``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.constants import FILTER_NEAREST, TEXTURE_CHECKERBOARD, TEXTURE_GRID
from warp_psdr.kernels.medium.volume import grid_point, grid_size, grid_value, make_grid_sink, voxels_at
from warp_psdr.kernels.primitive.affine import is_primitive
from warp_psdr.kernels.primitive.dispatch import make_point_at
from warp_psdr.kernels.reading import load_vec3, texture_record, triangle_at
from warp_psdr.kernels.sink import make_sink, make_sink_vec3
from warp_psdr.kernels.structs import Scene, Texture
from warp_psdr.kernels.surface import point_on
from warp_psdr.kernels.texture.texture import (
    TextureAdjoint,
    checkerboard_field,
    make_texture,
    make_texture_sink,
    texel,
)


@wp.func
def voxel_dot(scene: Scene, offset: wp.int32, channels: wp.int32, w: wp.vec3) -> wp.float32:
    return wp.dot(texel(scene, offset, channels), w)


@wp.func
def trilinear_slope(scene: Scene, g: Texture, p: wp.vec3, w: wp.vec3) -> wp.vec3:
    """Adjoint of p, a point in voxels, from that of the value there."""
    if g.filter == FILTER_NEAREST:
        return wp.vec3(0.0, 0.0, 0.0)
    v = voxels_at(g, p)
    n = g.channels
    c000 = voxel_dot(scene, v.z0 + v.y0 + v.x0, n, w)
    c100 = voxel_dot(scene, v.z0 + v.y0 + v.x1, n, w)
    c010 = voxel_dot(scene, v.z0 + v.y1 + v.x0, n, w)
    c110 = voxel_dot(scene, v.z0 + v.y1 + v.x1, n, w)
    c001 = voxel_dot(scene, v.z1 + v.y0 + v.x0, n, w)
    c101 = voxel_dot(scene, v.z1 + v.y0 + v.x1, n, w)
    c011 = voxel_dot(scene, v.z1 + v.y1 + v.x0, n, w)
    c111 = voxel_dot(scene, v.z1 + v.y1 + v.x1, n, w)
    x = wp.lerp(wp.lerp(c100 - c000, c110 - c010, v.f[1]), wp.lerp(c101 - c001, c111 - c011, v.f[1]), v.f[2])
    y = wp.lerp(wp.lerp(c010 - c000, c110 - c100, v.f[0]), wp.lerp(c011 - c001, c111 - c101, v.f[0]), v.f[2])
    z = wp.lerp(wp.lerp(c001 - c000, c101 - c100, v.f[0]), wp.lerp(c011 - c010, c111 - c110, v.f[0]), v.f[1])
    return wp.vec3(x, y, z)


@wp.struct
class PlacedAdjoint:
    """Adjoint of what a texture was read at, its place in the scene on shapes without triangles included."""

    dot: wp.float32
    uv: wp.vec2
    u: wp.float32
    v: wp.float32
    x: wp.vec3


@functools.cache
def make_volume_texture(kinds: tuple[int, ...], primitives: tuple[int, ...]):
    """Return ``volume_texture_at``, as ``make_texture``'s, for slots in which some texture is a volume.

    ``primitives``: the kinds of shapes without triangles.
    """
    point_at = make_point_at(primitives)
    rest = tuple(kind for kind in kinds if kind != TEXTURE_GRID)
    others = make_texture(rest) if rest else None

    @wp.func
    def volume_texture_at(
        scene: Scene, index: wp.int32, face: wp.int32, u: wp.float32, v: wp.float32, uv: wp.vec2
    ) -> wp.vec3:
        number = wp.int32(index)
        g = texture_record(scene, number)
        if wp.static(TEXTURE_CHECKERBOARD in kinds):
            if g.kind == TEXTURE_CHECKERBOARD:
                number = checkerboard_field(scene, g, uv)
                g = texture_record(scene, number)
        if wp.static(others is not None):
            if g.kind != TEXTURE_GRID:
                return others(scene, number, face, u, v, uv)
        x = point_at(scene, triangle_at(scene, face), u, v)
        return grid_value(scene.values, g, grid_point(scene, g, x))

    return volume_texture_at


@functools.cache
def make_point_in_volume_sink(role: str, values: bool, to_uv: bool, slide: bool):
    """Return ``accumulate_place(scene, target, g, x, w) -> (adjoint of x, float)``: to voxels and W."""
    accumulate_grid = make_grid_sink(role)
    sink, sink3 = make_sink(role), make_sink_vec3(role)

    @wp.func
    def accumulate_place(
        scene: Scene, target: wp.array(dtype=wp.float32), g: Texture, x: wp.vec3, w: wp.vec3
    ) -> tuple[wp.vec3, wp.float32]:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        p = grid_point(scene, g, x)
        a_x = wp.vec3(0.0, 0.0, 0.0)
        total = wp.float32(0.0)
        if wp.static(values):
            total += accumulate_grid(target, g, p, w)
        if wp.static(to_uv or slide):
            a = wp.cw_mul(grid_size(g), trilinear_slope(scene, g, p, w))
            t = g.to_uv
            if wp.static(to_uv):
                for row in range(3):
                    total += sink3(target, t + 4 * row, a[row] * x) + sink(target, t + 4 * row + 3, a[row])
            if wp.static(slide):
                a_x = (
                    a[0] * load_vec3(scene.values, t)
                    + a[1] * load_vec3(scene.values, t + 4)
                    + a[2] * load_vec3(scene.values, t + 8)
                )
        return a_x, total

    return accumulate_place


@functools.cache
def make_volume_texture_sink(role: str, kinds: tuple[int, ...], values: bool, to_uv: bool, slide: bool):
    """Return ``accumulate_volume_texture``, as ``make_texture_sink``'s; ``to_uv``: scatter to W."""
    rest = tuple(kind for kind in kinds if kind != TEXTURE_GRID)
    others = make_texture_sink(role, rest, values, to_uv, slide) if rest else None
    accumulate_place = make_point_in_volume_sink(role, values, to_uv, slide)
    sink3 = make_sink_vec3(role)

    @wp.func
    def accumulate_volume_texture(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        index: wp.int32,
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        uv: wp.vec2,
        w: wp.vec3,
    ) -> TextureAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = wp.int32(index)
        g = texture_record(scene, number)
        if wp.static(TEXTURE_CHECKERBOARD in kinds):
            if g.kind == TEXTURE_CHECKERBOARD:
                number = checkerboard_field(scene, g, uv)
                g = texture_record(scene, number)
        if wp.static(others is not None):
            if g.kind != TEXTURE_GRID:
                return others(scene, target, number, face, u, v, uv, w)
        tri = triangle_at(scene, face)
        a_x, dot = accumulate_place(scene, target, g, point_on(tri, u, v), w)
        result = TextureAdjoint()
        result.dot = dot
        if wp.static(slide):
            result.dot += sink3(target, scene.positions + 3 * tri.i0, (1.0 - u - v) * a_x)
            result.dot += sink3(target, scene.positions + 3 * tri.i1, u * a_x)
            result.dot += sink3(target, scene.positions + 3 * tri.i2, v * a_x)
            result.u = wp.dot(a_x, tri.p1 - tri.p0)
            result.v = wp.dot(a_x, tri.p2 - tri.p0)
        return result

    return accumulate_volume_texture


@functools.cache
def make_placed_texture_sink(
    role: str, kinds: tuple[int, ...], values: bool, to_uv: bool, slide: bool, primitives: tuple[int, ...]
):
    """Return ``make_volume_texture_sink``'s function where there are ``primitives``; it returns a ``PlacedAdjoint``."""
    on_triangles = make_volume_texture_sink(role, kinds, values, to_uv, slide)
    accumulate_place = make_point_in_volume_sink(role, values, to_uv, slide)
    point_at = make_point_at(primitives)

    @wp.func
    def accumulate_placed_texture(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        index: wp.int32,
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        uv: wp.vec2,
        w: wp.vec3,
    ) -> PlacedAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        result = PlacedAdjoint()
        tri = triangle_at(scene, face)
        g = texture_record(scene, index)
        if wp.static(TEXTURE_CHECKERBOARD in kinds):
            if g.kind == TEXTURE_CHECKERBOARD:
                g = texture_record(scene, checkerboard_field(scene, g, uv))
        if is_primitive(tri) and g.kind == TEXTURE_GRID:
            a_x, dot = accumulate_place(scene, target, g, point_at(scene, tri, u, v), w)
            result.dot = dot
            result.x = a_x
        else:
            t = on_triangles(scene, target, index, face, u, v, uv, w)
            result.dot = t.dot
            result.uv = t.uv
            result.u = t.u
            result.v = t.v
        return result

    return accumulate_placed_texture

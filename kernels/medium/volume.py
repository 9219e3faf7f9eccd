"""Volumes that vary: grids of voxels, their interpolation, and the sinks for the adjoints of interpolated values.

A grid is the record of a texture (``structs.Texture``): ``width`` x ``height`` x ``first`` voxels along x, y, z, stored
with x fastest. ``to_uv`` is the flat offset of the 3x4 row-major matrix from the scene's coordinates to the unit cube
that the grid fills; ``second`` of an extinction is the flat offset of its super-grid (``majorant.py``). Voxel i has its
centre at (i + 1/2) / width, as in Mitsuba. A constant that a medium of grids uses is a grid of one voxel.

Derivation: ``docs/theory/media.md#grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import FILTER_NEAREST
from warp_psdr.kernels.reading import load_float, texture_record
from warp_psdr.kernels.sink import make_sink_texel
from warp_psdr.kernels.structs import Scene, Texture
from warp_psdr.kernels.texture.texture import wrap_index

#: In place of a coefficient's number of channels: it is a grid, whose number stands in place of the flat offset.
GRID = 0


@wp.struct
class Voxels:
    """The eight voxels around a point: flat offsets along each axis, to be added, and the place between them."""

    x0: wp.int32
    x1: wp.int32
    y0: wp.int32
    y1: wp.int32
    z0: wp.int32
    z1: wp.int32
    f: wp.vec3


@wp.func
def grid_size(g: Texture) -> wp.vec3:
    """Voxels along x, y, z."""
    return wp.vec3(wp.float32(g.width), wp.float32(g.height), wp.float32(g.first))


@wp.func
def grid_vector(scene: Scene, g: Texture, v: wp.vec3) -> wp.vec3:
    """A vector of the scene's coordinates, in voxels."""
    t = g.to_uv
    r0 = wp.vec3(load_float(scene.values, t), load_float(scene.values, t + 1), load_float(scene.values, t + 2))
    r1 = wp.vec3(load_float(scene.values, t + 4), load_float(scene.values, t + 5), load_float(scene.values, t + 6))
    r2 = wp.vec3(load_float(scene.values, t + 8), load_float(scene.values, t + 9), load_float(scene.values, t + 10))
    return wp.cw_mul(grid_size(g), wp.vec3(wp.dot(r0, v), wp.dot(r1, v), wp.dot(r2, v)))


@wp.func
def grid_point(scene: Scene, g: Texture, x: wp.vec3) -> wp.vec3:
    """A point of the scene's coordinates, in voxels from the grid's corner."""
    t = g.to_uv
    corner = wp.vec3(load_float(scene.values, t + 3), load_float(scene.values, t + 7), load_float(scene.values, t + 11))
    return grid_vector(scene, g, x) + wp.cw_mul(grid_size(g), corner)


@wp.func
def voxels_at(g: Texture, p: wp.vec3) -> Voxels:
    """The voxels around a point, which is given in voxels; a nearest one stands for all eight."""
    q = p - wp.vec3(0.5, 0.5, 0.5)
    if g.filter == FILTER_NEAREST:
        q = wp.vec3(wp.floor(p[0]), wp.floor(p[1]), wp.floor(p[2]))
    low = wp.vec3(wp.floor(q[0]), wp.floor(q[1]), wp.floor(q[2]))
    i = wp.int32(low[0])
    j = wp.int32(low[1])
    k = wp.int32(low[2])
    r = Voxels()
    r.f = q - low
    row = g.channels * g.width
    layer = row * g.height
    r.x0 = g.channels * wrap_index(i, g.width, g.wrap)
    r.x1 = g.channels * wrap_index(i + 1, g.width, g.wrap)
    r.y0 = row * wrap_index(j, g.height, g.wrap)
    r.y1 = row * wrap_index(j + 1, g.height, g.wrap)
    r.z0 = g.offset + layer * wrap_index(k, g.first, g.wrap)
    r.z1 = g.offset + layer * wrap_index(k + 1, g.first, g.wrap)
    return r


@wp.func
def trilinear(values: wp.array(dtype=wp.float32), v: Voxels, channel: wp.int32) -> wp.float32:
    """One channel, interpolated."""
    a = wp.lerp(
        wp.lerp(
            load_float(values, v.z0 + v.y0 + v.x0 + channel), load_float(values, v.z0 + v.y0 + v.x1 + channel), v.f[0]
        ),
        wp.lerp(
            load_float(values, v.z0 + v.y1 + v.x0 + channel), load_float(values, v.z0 + v.y1 + v.x1 + channel), v.f[0]
        ),
        v.f[1],
    )
    b = wp.lerp(
        wp.lerp(
            load_float(values, v.z1 + v.y0 + v.x0 + channel), load_float(values, v.z1 + v.y0 + v.x1 + channel), v.f[0]
        ),
        wp.lerp(
            load_float(values, v.z1 + v.y1 + v.x0 + channel), load_float(values, v.z1 + v.y1 + v.x1 + channel), v.f[0]
        ),
        v.f[1],
    )
    return wp.lerp(a, b, v.f[2])


@wp.func
def grid_value(values: wp.array(dtype=wp.float32), g: Texture, p: wp.vec3) -> wp.vec3:
    """A grid's value at a point, which is given in voxels; a grey value in all components."""
    v = voxels_at(g, p)
    value = trilinear(values, v, 0)
    if g.channels == 1:
        return wp.vec3(value, value, value)
    return wp.vec3(value, trilinear(values, v, 1), trilinear(values, v, 2))


@wp.func
def grid_value_at(scene: Scene, number: wp.int32, x: wp.vec3) -> wp.vec3:
    """The value of a grid at a point of the scene."""
    g = texture_record(scene, number)
    return grid_value(scene.values, g, grid_point(scene, g, x))


@functools.cache
def make_grid_sink(role: str):
    """Return ``accumulate_grid(target, g, p, w) -> float32``: ``w`` is the adjoint of the value at p, in voxels."""
    sink_texel = make_sink_texel(role)

    @wp.func
    def accumulate_row(
        target: wp.array(dtype=wp.float32),
        row: wp.int32,
        v: Voxels,
        channels: wp.int32,
        share: wp.float32,
        w: wp.vec3,
    ) -> wp.float32:
        total = sink_texel(target, row + v.x0, channels, (share * (1.0 - v.f[0])) * w)
        if v.f[0] != 0.0:
            total += sink_texel(target, row + v.x1, channels, (share * v.f[0]) * w)
        return total

    @wp.func
    def accumulate_grid(target: wp.array(dtype=wp.float32), g: Texture, p: wp.vec3, w: wp.vec3) -> wp.float32:
        v = voxels_at(g, p)
        fy = v.f[1]
        fz = v.f[2]
        n = g.channels
        total = accumulate_row(target, v.z0 + v.y0, v, n, (1.0 - fz) * (1.0 - fy), w)
        if fy != 0.0:
            total += accumulate_row(target, v.z0 + v.y1, v, n, (1.0 - fz) * fy, w)
        if fz != 0.0:
            total += accumulate_row(target, v.z1 + v.y0, v, n, fz * (1.0 - fy), w)
            if fy != 0.0:
                total += accumulate_row(target, v.z1 + v.y1, v, n, fz * fy, w)
        return total

    return accumulate_grid

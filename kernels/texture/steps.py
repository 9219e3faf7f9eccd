"""Textures with steps: where a checkerboard, or a bitmap that takes the nearest texel, jumps inside of a triangle.

A *place* is the texture coordinate (s, t) of such a texture in units of its cells: a checkerboard's fields are half a
unit wide, a bitmap's texels 1 / width and 1 / height. The texture jumps where a coordinate of the place is a whole
number: along straight lines, on a triangle. A line of s rides on its triangle as long as neither the texture
coordinates nor ``to_uv`` change; otherwise it slides, at the velocity -s' grad s / |grad s|^2.

Derivation: ``docs/theory/boundary.md#steps-of-textures``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import TEXTURE_CHECKERBOARD
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Scene, Texture, Triangle
from warp_psdr.kernels.surface import texcoords_at
from warp_psdr.kernels.texture.texture import transform_uv

#: Squared normal of a triangle below which it has no area.
NO_AREA = 1.0e-36


@wp.struct
class StepTextures:
    """The textures with steps on every shape."""

    first: wp.array(dtype=wp.int32)  # where a shape's start, S + 1
    textures: wp.array(dtype=wp.int32)


@wp.struct
class Step:
    """The line of a texture's place beside a point of a surface."""

    texture: wp.int32  # -1: there is none
    axis: wp.int32  # of the place
    slopes: wp.vec2  # of the place's coordinate, by the barycentrics of the triangle


@wp.func
def cells_of(texture: Texture) -> wp.vec2:
    """Cells of a texture in a unit of its coordinates."""
    if texture.kind == TEXTURE_CHECKERBOARD:
        return wp.vec2(2.0, 2.0)
    return wp.vec2(wp.float32(texture.width), wp.float32(texture.height))


@wp.func
def place_of(scene: Scene, texture: Texture, uv: wp.vec2) -> wp.vec2:
    return wp.cw_mul(cells_of(texture), transform_uv(scene, texture, uv))


@wp.func
def place_slopes(scene: Scene, texture: Texture, tri: Triangle, axis: wp.int32) -> wp.vec2:
    """Derivatives of a coordinate of the place by the barycentrics of a triangle."""
    at = texcoords_at(scene, tri, 0.0, 0.0)
    along_u = texcoords_at(scene, tri, 1.0, 0.0) - at
    along_v = texcoords_at(scene, tri, 0.0, 1.0) - at
    row = texture.to_uv + 3 * axis
    m = cells_of(texture)[axis] * wp.vec2(scene.values[row], scene.values[row + 1])
    return wp.vec2(wp.dot(m, along_u), wp.dot(m, along_v))


@wp.func
def place_gradient(tri: Triangle, slopes: wp.vec2) -> wp.vec3:
    """Gradient over a triangle of what has these derivatives by its barycentrics."""
    e1 = tri.p1 - tri.p0
    e2 = tri.p2 - tri.p0
    n = wp.cross(e1, e2)
    return (slopes[0] * wp.cross(e2, n) + slopes[1] * wp.cross(n, e1)) / wp.max(wp.dot(n, n), NO_AREA)


@wp.func
def cell_name(scene: Scene, steps: StepTextures, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.int32:
    """A number that tells the cells apart, of all textures with steps, in which a point of a triangle lies."""
    tri = scene.triangles[face]
    name = wp.int32(0)
    for k in range(steps.first[tri.shape], steps.first[tri.shape + 1]):
        texture = scene.textures[steps.textures[k]]
        place = place_of(scene, texture, texcoords_at(scene, tri, u, v))
        name = 31 * (31 * name + wp.int32(wp.floor(place[0]))) + wp.int32(wp.floor(place[1]))
    return name


@wp.func
def line_beside(
    scene: Scene, steps: StepTextures, face: wp.int32, u: wp.float32, v: wp.float32, reach: wp.float32
) -> Step:
    """The line that is nearest to a point of a triangle, up to a distance."""
    r = Step()
    r.texture = -1
    nearest = wp.float32(reach)
    tri = scene.triangles[face]
    for k in range(steps.first[tri.shape], steps.first[tri.shape + 1]):
        number = steps.textures[k]
        texture = scene.textures[number]
        place = place_of(scene, texture, texcoords_at(scene, tri, u, v))
        for axis in range(2):
            slopes = place_slopes(scene, texture, tri, axis)
            slope = wp.length(place_gradient(tri, slopes))
            away = wp.abs(place[axis] - wp.round(place[axis]))
            if away < nearest * slope:
                nearest = away / slope
                r.texture = number
                r.axis = axis
                r.slopes = slopes
    return r


@functools.cache
def make_slide_sink(role: str):
    """Return ``accumulate_slide(scene, target, texture, axis, tri, u, v, a) -> float``.

    It scatters the adjoint ``a`` of a coordinate of the place at a point of a triangle to the ``to_uv`` of its texture
    and to the texture coordinates of the triangle's corners.
    """
    sink = make_sink(role)

    @wp.func
    def accumulate_slide(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        number: wp.int32,
        axis: wp.int32,
        tri: Triangle,
        u: wp.float32,
        v: wp.float32,
        a: wp.float32,
    ) -> wp.float32:
        texture = scene.textures[number]
        uv = texcoords_at(scene, tri, u, v)
        row = texture.to_uv + 3 * axis
        scaled = a * cells_of(texture)[axis]
        total = (
            sink(target, row, scaled * uv[0]) + sink(target, row + 1, scaled * uv[1]) + sink(target, row + 2, scaled)
        )
        shape = scene.shapes[tri.shape]
        if shape.has_uv == 1:
            for k in range(2):
                slope = scaled * scene.values[row + k]
                total += sink(target, shape.uv_offset + 2 * tri.i0 + k, (1.0 - u - v) * slope)
                total += sink(target, shape.uv_offset + 2 * tri.i1 + k, u * slope)
                total += sink(target, shape.uv_offset + 2 * tri.i2 + k, v * slope)
        return total

    return accumulate_slide

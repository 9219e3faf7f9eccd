"""The slope of a texture along its coordinates, and the sink for its adjoint, for bump maps.

A bilinear bitmap with the footprint (fx, fy) between four texels, in texels of the transformed coordinates, has

    dh/dx = (1 - fy) (t10 - t00) + fy (t11 - t01),    dh/dy = (1 - fx) (t01 - t00) + fx (t11 - t10).

The slope is linear in the texels, and jumps at the lines between them. Parameters that slide such a texture are
therefore refused (``warp_psdr/plan/boundary.py``).
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import TEXTURE_BITMAP, TEXTURE_GRID
from warp_psdr.kernels.reading import texture_record
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Scene, Texture
from warp_psdr.kernels.texture.texture import TextureAdjoint, footprint, make_texture, make_texture_sink, texel
from warp_psdr.kernels.texture.volume import (
    make_placed_texture_sink,
    make_volume_texture,
    make_volume_texture_sink,
)


@wp.func
def texels_per_uv(scene: Scene, texture: Texture) -> wp.mat22:
    """Derivatives of the place in the bitmap, texels, by the texture coordinates: row x, then row y."""
    m = texture.to_uv
    w = wp.float32(texture.width)
    h = wp.float32(texture.height)
    return wp.mat22(w * scene.values[m], w * scene.values[m + 1], h * scene.values[m + 3], h * scene.values[m + 4])


@functools.cache
def make_gradient(kinds: tuple[int, ...]):
    """Return ``gradient_at(scene, index, face, u, v, uv) -> vec3``: (dh/du, dh/dv, 0)."""

    @wp.func
    def gradient_at(
        scene: Scene, index: wp.int32, face: wp.int32, u: wp.float32, v: wp.float32, uv: wp.vec2
    ) -> wp.vec3:
        result = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(TEXTURE_BITMAP in kinds):
            texture = texture_record(scene, index)
            if texture.kind == TEXTURE_BITMAP:
                f = footprint(scene, texture, uv)
                n = texture.channels
                t00 = texel(scene, f.i00, n)[0]
                t10 = texel(scene, f.i10, n)[0]
                t01 = texel(scene, f.i01, n)[0]
                t11 = texel(scene, f.i11, n)[0]
                x = (1.0 - f.fy) * (t10 - t00) + f.fy * (t11 - t01)
                y = (1.0 - f.fx) * (t01 - t00) + f.fx * (t11 - t10)
                m = texels_per_uv(scene, texture)
                result = wp.vec3(x * m[0, 0] + y * m[1, 0], x * m[0, 1] + y * m[1, 1], 0.0)
        return result

    return gradient_at


@functools.cache
def make_gradient_sink(role: str, kinds: tuple[int, ...], values: bool):
    """Return ``accumulate_gradient(scene, target, index, face, u, v, uv, w) -> TextureAdjoint``: to the texels."""
    sink = make_sink(role)

    @wp.func
    def accumulate_gradient(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        index: wp.int32,
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        uv: wp.vec2,
        w: wp.vec3,
    ) -> TextureAdjoint:
        result = TextureAdjoint()
        if wp.static(values and TEXTURE_BITMAP in kinds):
            texture = texture_record(scene, index)
            if texture.kind == TEXTURE_BITMAP:
                f = footprint(scene, texture, uv)
                m = texels_per_uv(scene, texture)
                x = m[0, 0] * w[0] + m[0, 1] * w[1]
                y = m[1, 0] * w[0] + m[1, 1] * w[1]
                result.dot = sink(target, f.i00, -(1.0 - f.fy) * x - (1.0 - f.fx) * y)
                result.dot += sink(target, f.i10, (1.0 - f.fy) * x - f.fx * y)
                result.dot += sink(target, f.i01, -f.fy * x + (1.0 - f.fx) * y)
                result.dot += sink(target, f.i11, f.fy * x + f.fx * y)
        return result

    return accumulate_gradient


def make_reader(kinds: tuple[int, ...], rises: bool, color: bool, primitives: tuple[int, ...]):
    """Return what reads a value of a material: a texture, or how it ``rises``; ``color`` as of ``make_texture``."""
    if rises:
        return make_gradient(kinds)
    return make_volume_texture(kinds, primitives) if TEXTURE_GRID in kinds else make_texture(kinds, color)


def is_placed(kinds: tuple[int, ...], rises: bool, primitives: tuple[int, ...]) -> bool:
    """Whether the adjoint of what is read has a part of the point itself: of volumes on shapes without triangles."""
    return bool(primitives) and TEXTURE_GRID in kinds and not rises


def make_reader_sink(
    role: str,
    kinds: tuple[int, ...],
    rises: bool,
    values: bool,
    to_uv: bool,
    slide: bool,
    primitives: tuple[int, ...],
):
    """Return where the adjoint of ``make_reader`` goes; arguments as of ``make_texture_sink``.

    Where it ``is_placed`` it returns a ``PlacedAdjoint``.
    """
    if rises:
        return make_gradient_sink(role, kinds, values)
    if is_placed(kinds, rises, primitives):
        return make_placed_texture_sink(role, kinds, values, to_uv, slide, primitives)
    make_sink_of = make_volume_texture_sink if TEXTURE_GRID in kinds else make_texture_sink
    return make_sink_of(role, kinds, values, to_uv, slide)

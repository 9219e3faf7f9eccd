"""Textures: constants, bitmaps, mesh attributes and checkerboards of them, and the sinks for their adjoints.

A bitmap's texel (column i, row j) has its centre at texture coordinates ((i + 1/2) / width, (j + 1/2) / height): the
first stored row lies at v = 0 (Mitsuba's convention). Bilinear interpolation is differentiable in the coordinates (a
texture that slides over the film, ``to_uv``) and linear in the texels. Nearest-neighbour look-ups are constant between
texel borders: their derivative by the coordinates is a boundary term (``steps.py``).
The same holds for a checkerboard, whose fields are half a unit wide: it is its first texture where both or none of the
fractional parts of the coordinates are above 1/2, and its second elsewhere. A scaled texture is its first texture times
the number at its offset (``mesh_attribute`` with a ``scale``).
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor, differentiable
from warp_psdr.kernels.constants import (
    FILTER_NEAREST,
    TEXTURE_BITMAP,
    TEXTURE_CHECKERBOARD,
    TEXTURE_CONSTANT,
    TEXTURE_FACE,
    TEXTURE_SCALED,
    TEXTURE_VERTEX,
    WRAP_CLAMP,
    WRAP_MIRROR,
)
from warp_psdr.kernels.reading import load_float, load_vec3, texture_record
from warp_psdr.kernels.sink import make_sink, make_sink_texel
from warp_psdr.kernels.structs import Scene, Texture


@wp.struct
class TextureAdjoint:
    """Adjoint of a texture value with respect to where it is read, and the forward-mode sum of its own values."""

    uv: wp.vec2
    u: wp.float32  # barycentrics, for vertex attributes
    v: wp.float32
    dot: wp.float32


@wp.struct
class Footprint:
    """The four texels of a bilinear look-up (flat offsets) and the fractional position between them."""

    i00: wp.int32
    i10: wp.int32
    i01: wp.int32
    i11: wp.int32
    fx: wp.float32
    fy: wp.float32


@wp.func
def wrap_index(i: wp.int32, size: wp.int32, mode: wp.int32) -> wp.int32:
    if i >= 0 and i < size:
        return i
    if mode == WRAP_CLAMP:
        return wp.clamp(i, 0, size - 1)
    if mode == WRAP_MIRROR:
        period = 2 * size
        k = i - period * wp.int32(wp.floor(wp.float32(i) / wp.float32(period)))
        if k >= size:
            k = period - 1 - k
        return wp.clamp(k, 0, size - 1)
    k = i - size * wp.int32(wp.floor(wp.float32(i) / wp.float32(size)))
    return wp.clamp(k, 0, size - 1)


@wp.func
def transform_uv(scene: Scene, texture: Texture, uv: wp.vec2) -> wp.vec2:
    row0 = load_vec3(scene.values, texture.to_uv)
    row1 = load_vec3(scene.values, texture.to_uv + 3)
    return wp.vec2(
        row0[0] * uv[0] + row0[1] * uv[1] + row0[2],
        row1[0] * uv[0] + row1[1] * uv[1] + row1[2],
    )


@wp.func
def footprint(scene: Scene, texture: Texture, uv: wp.vec2) -> Footprint:
    st = transform_uv(scene, texture, uv)
    result = Footprint()
    x = st[0] * wp.float32(texture.width)
    y = st[1] * wp.float32(texture.height)
    if texture.filter == FILTER_NEAREST:
        i = wrap_index(wp.int32(wp.floor(x)), texture.width, texture.wrap)
        j = wrap_index(wp.int32(wp.floor(y)), texture.height, texture.wrap)
        index = texture.offset + (j * texture.width + i) * texture.channels
        result.i00 = index
        result.i10 = index
        result.i01 = index
        result.i11 = index
        return result
    x -= 0.5
    y -= 0.5
    x0 = wp.floor(x)
    y0 = wp.floor(y)
    i0 = wrap_index(wp.int32(x0), texture.width, texture.wrap)
    i1 = wrap_index(wp.int32(x0) + 1, texture.width, texture.wrap)
    j0 = wrap_index(wp.int32(y0), texture.height, texture.wrap)
    j1 = wrap_index(wp.int32(y0) + 1, texture.height, texture.wrap)
    result.i00 = texture.offset + (j0 * texture.width + i0) * texture.channels
    result.i10 = texture.offset + (j0 * texture.width + i1) * texture.channels
    result.i01 = texture.offset + (j1 * texture.width + i0) * texture.channels
    result.i11 = texture.offset + (j1 * texture.width + i1) * texture.channels
    result.fx = x - x0
    result.fy = y - y0
    return result


@wp.func
def texel(scene: Scene, offset: wp.int32, channels: wp.int32) -> wp.vec3:
    step = wp.where(channels == 1, 0, 1)
    values = scene.values
    return wp.vec3(load_float(values, offset), load_float(values, offset + step), load_float(values, offset + 2 * step))


@differentiable
@wp.func
def bilinear_dot(
    t00: wp.vec3, t10: wp.vec3, t01: wp.vec3, t11: wp.vec3, fx: wp.float32, fy: wp.float32, w: wp.vec3
) -> wp.float32:
    """Local factor of a bilinear look-up."""
    return wp.dot(w, (1.0 - fy) * ((1.0 - fx) * t00 + fx * t10) + fy * ((1.0 - fx) * t01 + fx * t11))


@wp.func_native("""
#if defined(__clang__) && !defined(__CUDA_ARCH__)
    #pragma clang fp contract(off)
    typedef float f3 __attribute__((ext_vector_type(3)));
    f3 t[4];
    const int at[4] = {f.i00, f.i10, f.i01, f.i11};
    for (int i = 0; i < 4; ++i)
        __builtin_memcpy(&t[i], values.data + at[i], 12);
    const f3 top = (1.0f - f.fx) * t[0] + f.fx * t[1], bottom = (1.0f - f.fx) * t[2] + f.fx * t[3];
    const f3 between = (1.0f - f.fy) * top + f.fy * bottom;
    return wp::vec_t<3, wp::float32>(between.x, between.y, between.z);
#else
    wp::vec_t<3, wp::float32> r;
    for (int i = 0; i < 3; ++i) {
        const float top = (1.0f - f.fx) * values.data[f.i00 + i] + f.fx * values.data[f.i10 + i];
        const float bottom = (1.0f - f.fx) * values.data[f.i01 + i] + f.fx * values.data[f.i11 + i];
        r[i] = (1.0f - f.fy) * top + f.fy * bottom;
    }
    return r;
#endif
""")
def bilinear_colors(values: wp.array(dtype=wp.float32), f: Footprint) -> wp.vec3:
    """Interpolate four texels of three channels, which are a vector each."""
    return wp.vec3()


@wp.func
def bilinear_number(values: wp.array(dtype=wp.float32), f: Footprint) -> wp.float32:
    """Interpolate the first channel of four texels."""
    top = (1.0 - f.fx) * load_float(values, f.i00) + f.fx * load_float(values, f.i10)
    bottom = (1.0 - f.fx) * load_float(values, f.i01) + f.fx * load_float(values, f.i11)
    return (1.0 - f.fy) * top + f.fy * bottom


@functools.cache
def _make_bitmap(color: bool):
    @wp.func
    def eval_bitmap(scene: Scene, texture: Texture, uv: wp.vec2) -> wp.vec3:
        f = footprint(scene, texture, uv)
        if wp.static(color):
            if texture.channels == 3:
                return bilinear_colors(scene.values, f)
        number = bilinear_number(scene.values, f)
        return wp.vec3(number, number, number)

    return eval_bitmap


@wp.func
def eval_vertex(scene: Scene, texture: Texture, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.vec3:
    tri = scene.triangles[face]
    n = texture.channels
    return (
        (1.0 - u - v) * texel(scene, texture.offset + n * tri.i0, n)
        + u * texel(scene, texture.offset + n * tri.i1, n)
        + v * texel(scene, texture.offset + n * tri.i2, n)
    )


@wp.func
def checkerboard_field(scene: Scene, texture: Texture, uv: wp.vec2) -> wp.int32:
    """Number of the texture that a checkerboard has here."""
    st = transform_uv(scene, texture, uv)
    right = st[0] - wp.floor(st[0]) > 0.5
    above = st[1] - wp.floor(st[1]) > 0.5
    return wp.where(right == above, texture.first, texture.second)


@functools.cache
def make_texture(kinds: tuple[int, ...], color: bool = True):
    """Return ``texture_at(scene, index, face, u, v, uv) -> vec3`` for the texture kinds that a slot uses.

    ``color=False``: only the first number of the result is asked for.
    """
    if TEXTURE_SCALED in kinds:
        return _make_scaled(kinds, color)
    eval_bitmap = _make_bitmap(color)

    @wp.func
    def texture_at(scene: Scene, index: wp.int32, face: wp.int32, u: wp.float32, v: wp.float32, uv: wp.vec2) -> wp.vec3:
        if wp.static(kinds == (TEXTURE_CONSTANT,)):
            texture = texture_record(scene, index)
            return texel(scene, texture.offset, texture.channels)
        else:
            texture = texture_record(scene, index)
            if wp.static(TEXTURE_CHECKERBOARD in kinds):
                if texture.kind == TEXTURE_CHECKERBOARD:
                    texture = texture_record(scene, checkerboard_field(scene, texture, uv))
            if wp.static(TEXTURE_BITMAP in kinds):
                if texture.kind == TEXTURE_BITMAP:
                    return eval_bitmap(scene, texture, uv)
            if wp.static(TEXTURE_VERTEX in kinds):
                if texture.kind == TEXTURE_VERTEX:
                    return eval_vertex(scene, texture, face, u, v)
            if wp.static(TEXTURE_FACE in kinds):
                if texture.kind == TEXTURE_FACE:
                    return texel(scene, texture.offset + texture.channels * face, texture.channels)
            return texel(scene, texture.offset, texture.channels)

    return texture_at


@functools.cache
def _make_scaled(kinds: tuple[int, ...], color: bool):
    inner = make_texture(tuple(kind for kind in kinds if kind != TEXTURE_SCALED), color)

    @wp.func
    def scaled_texture_at(
        scene: Scene, index: wp.int32, face: wp.int32, u: wp.float32, v: wp.float32, uv: wp.vec2
    ) -> wp.vec3:
        number = wp.int32(index)
        texture = texture_record(scene, number)
        if wp.static(TEXTURE_CHECKERBOARD in kinds):
            if texture.kind == TEXTURE_CHECKERBOARD:
                number = checkerboard_field(scene, texture, uv)
                texture = texture_record(scene, number)
        factor = wp.float32(1.0)
        if texture.kind == TEXTURE_SCALED:
            factor = load_float(scene.values, texture.offset)
            number = texture.first
        return factor * inner(scene, number, face, u, v, uv)

    return scaled_texture_at


@functools.cache
def make_texture_sink(role: str, kinds: tuple[int, ...], values: bool, to_uv: bool, slide: bool):
    """Return ``accumulate_texture(scene, target, index, face, u, v, uv, w) -> TextureAdjoint``.

    Args:
        role: "reverse" or "forward" (see ``kernels/sink.py``).
        kinds: texture kinds in use.
        values: scatter to texels, constants and attributes.
        to_uv: scatter to the texture-coordinate transform.
        slide: return the adjoint of the place where the texture is read.
    """
    if TEXTURE_SCALED in kinds:
        return _make_scaled_sink(role, kinds, values, to_uv, slide)
    sink = make_sink(role)
    sink_texel = make_sink_texel(role)

    @wp.func
    def accumulate_bitmap(
        scene: Scene, target: wp.array(dtype=wp.float32), texture: Texture, uv: wp.vec2, w: wp.vec3
    ) -> TextureAdjoint:
        result = TextureAdjoint()
        f = footprint(scene, texture, uv)
        n = texture.channels
        w00, w10, w01, w11, d_fx, d_fy, _w = wp.grad(bilinear_dot)(
            texel(scene, f.i00, n),
            texel(scene, f.i10, n),
            texel(scene, f.i01, n),
            texel(scene, f.i11, n),
            f.fx,
            f.fy,
            w,
        )
        total = wp.float32(0.0)
        if wp.static(values):
            total += sink_texel(target, f.i00, n, w00) + sink_texel(target, f.i10, n, w10)
            total += sink_texel(target, f.i01, n, w01) + sink_texel(target, f.i11, n, w11)
        if wp.static(slide or to_uv):
            # Adjoint of the transformed coordinates (s, t), then of (u, v) and of the transform.
            a_s = d_fx * wp.float32(texture.width)
            a_t = d_fy * wp.float32(texture.height)
            m = texture.to_uv
            result.uv = wp.vec2(
                scene.values[m] * a_s + scene.values[m + 3] * a_t,
                scene.values[m + 1] * a_s + scene.values[m + 4] * a_t,
            )
            if wp.static(to_uv):
                total += sink(target, m, a_s * uv[0]) + sink(target, m + 1, a_s * uv[1]) + sink(target, m + 2, a_s)
                total += sink(target, m + 3, a_t * uv[0]) + sink(target, m + 4, a_t * uv[1]) + sink(target, m + 5, a_t)
        result.dot = total
        return result

    @wp.func
    def accumulate_vertex_attribute(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        texture: Texture,
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        w: wp.vec3,
    ) -> TextureAdjoint:
        result = TextureAdjoint()
        tri = scene.triangles[face]
        n = texture.channels
        if wp.static(values):
            result.dot = (
                sink_texel(target, texture.offset + n * tri.i0, n, (1.0 - u - v) * w)
                + sink_texel(target, texture.offset + n * tri.i1, n, u * w)
                + sink_texel(target, texture.offset + n * tri.i2, n, v * w)
            )
        if wp.static(slide):
            t0 = texel(scene, texture.offset + n * tri.i0, n)
            result.u = wp.dot(w, texel(scene, texture.offset + n * tri.i1, n) - t0)
            result.v = wp.dot(w, texel(scene, texture.offset + n * tri.i2, n) - t0)
        return result

    @wp.func
    def accumulate_texture(
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
        result = TextureAdjoint()
        texture = texture_record(scene, index)
        if wp.static(TEXTURE_CHECKERBOARD in kinds):
            if texture.kind == TEXTURE_CHECKERBOARD:
                texture = texture_record(scene, checkerboard_field(scene, texture, uv))
        if wp.static(TEXTURE_BITMAP in kinds):
            if texture.kind == TEXTURE_BITMAP:
                return accumulate_bitmap(scene, target, texture, uv, w)
        if wp.static(TEXTURE_VERTEX in kinds):
            if texture.kind == TEXTURE_VERTEX:
                return accumulate_vertex_attribute(scene, target, texture, face, u, v, w)
        if wp.static(TEXTURE_FACE in kinds):
            if texture.kind == TEXTURE_FACE:
                if wp.static(values):
                    result.dot = sink_texel(target, texture.offset + texture.channels * face, texture.channels, w)
                return result
        if wp.static(values):
            result.dot = sink_texel(target, texture.offset, texture.channels, w)
        return result

    return accumulate_texture


@functools.cache
def _make_scaled_sink(role: str, kinds: tuple[int, ...], values: bool, to_uv: bool, slide: bool):
    rest = tuple(kind for kind in kinds if kind != TEXTURE_SCALED)
    inner = make_texture(rest)
    accumulate_inner = make_texture_sink(role, rest, values, to_uv, slide)
    sink = make_sink(role)

    @wp.func
    def accumulate_scaled_texture(
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
        texture = texture_record(scene, number)
        if wp.static(TEXTURE_CHECKERBOARD in kinds):
            if texture.kind == TEXTURE_CHECKERBOARD:
                number = checkerboard_field(scene, texture, uv)
                texture = texture_record(scene, number)
        factor = wp.float32(1.0)
        of_factor = wp.float32(0.0)
        if texture.kind == TEXTURE_SCALED:
            factor = load_float(scene.values, texture.offset)
            number = texture.first
            if wp.static(values):
                of_factor = sink(target, texture.offset, wp.dot(w, inner(scene, number, face, u, v, uv)))
        result = accumulate_inner(scene, target, number, face, u, v, uv, factor * w)
        result.dot += of_factor
        return result

    return accumulate_scaled_texture

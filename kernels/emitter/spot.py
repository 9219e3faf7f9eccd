"""Spot light: a point light that shines along +z of its pose and falls off towards its cut-off angle.

The intensity is full within ``beam_width`` of the axis and falls linearly in the angle to zero at ``cutoff_angle``. It
is continuous, so its derivative has no boundary term, unless the two angles coincide. A textured spot projects a
bitmap, bilinear and so continuous as well, whose unit square encloses the cone (Mitsuba's ``texture``).
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor, differentiable
from warp_psdr.kernels.constants import PI, TEXTURE_BITMAP, TEXTURE_CONSTANT
from warp_psdr.kernels.emitter.point import DeltaLightFunctions
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Emitter, LightAdjoint, LightSample, Scene
from warp_psdr.kernels.texture.texture import make_texture, make_texture_sink

RADIANS_PER_DEGREE = PI / 180.0
#: Narrowest falloff (radians): equal angles give a hard edge instead of a division by zero.
MIN_FALLOFF = 1.0e-6


@wp.func
def load_column(values: wp.array(dtype=wp.float32), offset: wp.int32, column: wp.int32) -> wp.vec3:
    """First three entries of a column of a 4x4 row-major matrix: 2 is the z axis, 3 the translation."""
    i = offset + column
    return wp.vec3(values[i], values[i + 4], values[i + 8])


@wp.func
def falloff(axis: wp.vec3, wi: wp.vec3, cutoff: wp.float32, beam: wp.float32) -> wp.float32:
    """Fraction of the intensity that leaves against ``wi``; angles in degrees, ``axis`` of any length."""
    # atan2 keeps its accuracy near the axis, where acos of a cosine close to one loses half of its digits.
    angle = wp.atan2(wp.length(wp.cross(axis, wi)), -wp.dot(axis, wi))
    width = wp.max((cutoff - beam) * RADIANS_PER_DEGREE, MIN_FALLOFF)
    share = (cutoff * RADIANS_PER_DEGREE - angle) / width
    # Not ``wp.clamp``, which makes a number of NaN.
    return wp.where(share < 0.0, 0.0, wp.where(share > 1.0, 1.0, share))


@differentiable
@wp.func
def spot_dot(
    x: wp.vec3,
    position: wp.vec3,
    axis: wp.vec3,
    intensity: wp.vec3,
    cutoff: wp.float32,
    beam: wp.float32,
    w: wp.vec3,
    a_wi: wp.vec3,
) -> wp.float32:
    """Local factor: inverse square law, falloff and direction."""
    r = position - x
    squared = wp.dot(r, r)
    wi = r / wp.sqrt(squared)
    return wp.dot(w, intensity) * falloff(axis, wi, cutoff, beam) / squared + wp.dot(a_wi, wi)


@wp.func
def projected_uv(d: wp.vec3, x_axis: wp.vec3, y_axis: wp.vec3, z_axis: wp.vec3, cutoff: wp.float32) -> wp.vec2:
    """Texture coordinates in the direction d, of any length, that leaves the light: those of the pose's inverse."""
    scale = 0.5 / (wp.dot(wp.cross(x_axis, y_axis), d) * wp.tan(cutoff * RADIANS_PER_DEGREE))
    across, up = wp.dot(wp.cross(y_axis, z_axis), d), wp.dot(wp.cross(z_axis, x_axis), d)
    return wp.vec2(0.5 + scale * across, 0.5 + scale * up)


@differentiable
@wp.func
def projected_dot(
    x: wp.vec3,
    position: wp.vec3,
    x_axis: wp.vec3,
    y_axis: wp.vec3,
    z_axis: wp.vec3,
    cutoff: wp.float32,
    a_uv: wp.vec2,
) -> wp.float32:
    """Local factor: where the texture is read."""
    return wp.dot(a_uv, projected_uv(x - position, x_axis, y_axis, z_axis, cutoff))


@functools.cache
def make_spot(role: str | None, wanted: tuple[str, ...]) -> DeltaLightFunctions:
    """Return the functions of the spot light (see `DeltaLightFunctions`).

    Args:
        role: "reverse", "forward", or None for a light that is not differentiated.
        wanted: "radiance" scatters to the intensity, "pose" to the matrix and the two angles. Of the matrix, the third
            and fourth column have derivatives: the axis (whose length does not matter) and the position.
    """
    texture_at = make_texture((TEXTURE_CONSTANT,))
    accumulate_texture = (
        make_texture_sink(role, (TEXTURE_CONSTANT,), "radiance" in wanted, False, False) if role else None
    )
    sink = make_sink(role) if role else None

    @wp.func
    def sample(scene: Scene, e: Emitter, x: wp.vec3, u: wp.vec2) -> LightSample:
        result = LightSample()
        result.face = -1
        result.delta = 1
        r = load_column(scene.values, e.to_world, 3) - x
        squared = wp.dot(r, r)
        if not squared <= 0.0:  # NaN passes, and makes the sample invalid
            result.distance = wp.sqrt(squared)
            result.wi = r / result.distance
            axis = load_column(scene.values, e.to_world, 2)
            share = falloff(axis, result.wi, scene.values[e.cutoff], scene.values[e.cutoff + 1])
            result.radiance = texture_at(scene, e.texture, 0, 0.0, 0.0, wp.vec2(0.0, 0.0)) * (share / squared)
            result.pdf = 1.0
        return result

    if role is None:
        return DeltaLightFunctions(sample, None)

    @wp.func
    def sample_vjp(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        e: Emitter,
        x: wp.vec3,
        wi: wp.vec3,
        w: wp.vec3,
        a_wi: wp.vec3,
    ) -> LightAdjoint:
        result = LightAdjoint()
        uv = wp.vec2(0.0, 0.0)
        position = load_column(scene.values, e.to_world, 3)
        if wp.length_sq(position - x) <= 0.0:
            return result
        axis = load_column(scene.values, e.to_world, 2)
        intensity = texture_at(scene, e.texture, 0, 0.0, 0.0, uv)
        d_x, d_position, d_axis, d_intensity, d_cutoff, d_beam, _w, _a = wp.grad(spot_dot)(
            x, position, axis, intensity, scene.values[e.cutoff], scene.values[e.cutoff + 1], w, a_wi
        )
        result.x = d_x
        if wp.static("radiance" in wanted):
            result.dot += accumulate_texture(scene, target, e.texture, 0, 0.0, 0.0, uv, d_intensity).dot
        if wp.static("pose" in wanted):
            for i in range(wp.static(3)):
                result.dot += sink(target, e.to_world + 4 * i + 2, d_axis[i])
                result.dot += sink(target, e.to_world + 4 * i + 3, d_position[i])
            result.dot += sink(target, e.cutoff, d_cutoff) + sink(target, e.cutoff + 1, d_beam)
        return result

    return DeltaLightFunctions(sample, sample_vjp)


@functools.cache
def make_textured_spot(role: str | None, wanted: tuple[str, ...]) -> DeltaLightFunctions:
    """Return the functions of a spot light whose intensity is multiplied by a bitmap; see `make_spot`.

    "radiance" scatters to the texels, too, and "pose" to all columns of the matrix.
    """
    plain = make_spot(role, wanted)
    intensity_at, texture_at = make_texture((TEXTURE_CONSTANT,)), make_texture((TEXTURE_BITMAP,))

    @wp.func
    def projected_place(scene: Scene, e: Emitter, x: wp.vec3) -> wp.vec2:
        values = scene.values
        m = e.to_world
        d = x - load_column(values, m, 3)
        return projected_uv(
            d, load_column(values, m, 0), load_column(values, m, 1), load_column(values, m, 2), values[e.cutoff]
        )

    @wp.func
    def sample_textured(scene: Scene, e: Emitter, x: wp.vec3, u: wp.vec2) -> LightSample:
        result = plain_sample(scene, e, x, u)
        if not wp.length_sq(result.radiance) <= 0.0:  # outside of the cone there is no place on the texture
            colour = texture_at(scene, e.projected, 0, 0.0, 0.0, projected_place(scene, e, x))
            result.radiance = wp.cw_mul(result.radiance, colour)
        return result

    plain_sample = plain.sample
    if role is None:
        return DeltaLightFunctions(sample_textured, None)
    accumulate_intensity = make_texture_sink(role, (TEXTURE_CONSTANT,), "radiance" in wanted, False, False)
    accumulate_texture = make_texture_sink(role, (TEXTURE_BITMAP,), "radiance" in wanted, False, True)
    sink = make_sink(role)

    @wp.func
    def textured_vjp(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        e: Emitter,
        x: wp.vec3,
        wi: wp.vec3,
        w: wp.vec3,
        a_wi: wp.vec3,
    ) -> LightAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        result = LightAdjoint()
        values = scene.values
        m = e.to_world
        position = load_column(values, m, 3)
        if wp.length_sq(position - x) <= 0.0:
            return result
        x_axis, y_axis, z_axis = load_column(values, m, 0), load_column(values, m, 1), load_column(values, m, 2)
        cutoff, beam = values[e.cutoff], values[e.cutoff + 1]
        flat = wp.vec2(0.0, 0.0)
        intensity = intensity_at(scene, e.texture, 0, 0.0, 0.0, flat)
        uv = flat
        colour = wp.vec3(1.0, 1.0, 1.0)
        inside = falloff(z_axis, wi, cutoff, beam) > 0.0
        if inside:  # outside of the cone there is no place on the texture
            uv = projected_place(scene, e, x)
            colour = texture_at(scene, e.projected, 0, 0.0, 0.0, uv)
        d_x, d_position, d_z, d_product, d_cutoff, d_beam, _w, _a = wp.grad(spot_dot)(
            x, position, z_axis, wp.cw_mul(intensity, colour), cutoff, beam, w, a_wi
        )
        result.x = d_x
        if wp.static("radiance" in wanted):
            adjoint = wp.cw_mul(d_product, colour)
            result.dot += accumulate_intensity(scene, target, e.texture, 0, 0.0, 0.0, flat, adjoint).dot
        if wp.static("pose" in wanted):
            for i in range(wp.static(3)):
                result.dot += sink(target, m + 4 * i + 2, d_z[i]) + sink(target, m + 4 * i + 3, d_position[i])
            result.dot += sink(target, e.cutoff, d_cutoff) + sink(target, e.cutoff + 1, d_beam)
        if inside:
            accumulated = accumulate_texture(
                scene, target, e.projected, 0, 0.0, 0.0, uv, wp.cw_mul(d_product, intensity)
            )
            s_x, s_position, s_xaxis, s_yaxis, s_zaxis, s_cutoff, _uv = wp.grad(projected_dot)(
                x, position, x_axis, y_axis, z_axis, cutoff, accumulated.uv
            )
            result.x += s_x
            if wp.static("radiance" in wanted):
                result.dot += accumulated.dot
            if wp.static("pose" in wanted):
                for i in range(wp.static(3)):
                    result.dot += sink(target, m + 4 * i, s_xaxis[i]) + sink(target, m + 4 * i + 1, s_yaxis[i])
                    result.dot += sink(target, m + 4 * i + 2, s_zaxis[i]) + sink(target, m + 4 * i + 3, s_position[i])
                result.dot += sink(target, e.cutoff, s_cutoff)
        return result

    return DeltaLightFunctions(sample_textured, textured_vjp)

"""Spot light: a point light that shines along +z of its pose and falls off towards its cut-off angle.

The intensity is full within ``beam_width`` of the axis and falls linearly in the angle to zero at ``cutoff_angle``. It
is continuous, so its derivative has no boundary term, unless the two angles coincide.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import differentiable
from warp_psdr.kernels.constants import PI, TEXTURE_CONSTANT
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


@functools.cache
def make_spot(role: str | None, wanted: tuple[str, ...]) -> DeltaLightFunctions:
    """Return the functions of the spot light (see `DeltaLightFunctions`).

    Args:
        role: "reverse", "forward", or None for a light that is not differentiated.
        wanted: "radiance" scatters to the intensity, "pose" to the matrix and the two angles. Of the matrix, the third
            and fourth column have derivatives: the axis (whose length does not matter) and the position.
    """
    texture_at = make_texture((TEXTURE_CONSTANT,))
    push_texture = make_texture_sink(role, (TEXTURE_CONSTANT,), "radiance" in wanted, False, False) if role else None
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
            result.dot += push_texture(scene, target, e.texture, 0, 0.0, 0.0, uv, d_intensity).dot
        if wp.static("pose" in wanted):
            for i in range(wp.static(3)):
                result.dot += sink(target, e.to_world + 4 * i + 2, d_axis[i])
                result.dot += sink(target, e.to_world + 4 * i + 3, d_position[i])
            result.dot += sink(target, e.cutoff, d_cutoff) + sink(target, e.cutoff + 1, d_beam)
        return result

    return DeltaLightFunctions(sample, sample_vjp)

"""Point light: equal intensity [W/sr] in all directions from one position. Also the common part of all delta lights."""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import differentiable
from warp_psdr.kernels.constants import TEXTURE_CONSTANT
from warp_psdr.kernels.reading import load_vec3
from warp_psdr.kernels.sink import make_sink_vec3
from warp_psdr.kernels.structs import Emitter, LightAdjoint, LightSample, Scene
from warp_psdr.kernels.texture.texture import make_texture, make_texture_sink


class DeltaLightFunctions(NamedTuple):
    """Device functions of a light that reaches a point from one direction only, so that no ray can hit it.

    ``sample(scene, e, x, u) -> LightSample`` (``u`` is not used) and
    ``sample_vjp(scene, target, e, x, wi, w, a_wi) -> LightAdjoint``: the gradient of
    dot(w, radiance) + dot(a_wi, wi), scattered to the light's parameters and returned for x. None without a role.
    """

    sample: wp.Function
    sample_vjp: wp.Function | None


@differentiable
@wp.func
def point_dot(x: wp.vec3, position: wp.vec3, intensity: wp.vec3, w: wp.vec3, a_wi: wp.vec3) -> wp.float32:
    """Local factor: inverse square law and direction."""
    r = position - x
    squared = wp.dot(r, r)
    return wp.dot(w, intensity) / squared + wp.dot(a_wi, r) / wp.sqrt(squared)


@functools.cache
def make_point(role: str | None, wanted: tuple[str, ...]) -> DeltaLightFunctions:
    """Return the functions of the point light (see `DeltaLightFunctions`).

    Args:
        role: "reverse", "forward", or None for a light that is not differentiated.
        wanted: "radiance" scatters to the intensity, "pose" to the position.
    """
    texture_at = make_texture((TEXTURE_CONSTANT,))
    accumulate_texture = (
        make_texture_sink(role, (TEXTURE_CONSTANT,), "radiance" in wanted, False, False) if role else None
    )
    sink_vec3 = make_sink_vec3(role) if role else None

    @wp.func
    def sample(scene: Scene, e: Emitter, x: wp.vec3, u: wp.vec2) -> LightSample:
        result = LightSample()
        result.face = -1
        result.delta = 1
        r = load_vec3(scene.values, e.to_world) - x
        squared = wp.dot(r, r)
        if not squared <= 0.0:  # NaN passes, and makes the sample invalid
            result.distance = wp.sqrt(squared)
            result.wi = r / result.distance
            result.radiance = texture_at(scene, e.texture, 0, 0.0, 0.0, wp.vec2(0.0, 0.0)) / squared
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
        position = load_vec3(scene.values, e.to_world)
        if wp.length_sq(position - x) <= 0.0:
            return result
        intensity = texture_at(scene, e.texture, 0, 0.0, 0.0, uv)
        d_x, d_position, d_intensity, _w, _a = wp.grad(point_dot)(x, position, intensity, w, a_wi)
        result.x = d_x
        if wp.static("radiance" in wanted):
            result.dot += accumulate_texture(scene, target, e.texture, 0, 0.0, 0.0, uv, d_intensity).dot
        if wp.static("pose" in wanted):
            result.dot += sink_vec3(target, e.to_world, d_position)
        return result

    return DeltaLightFunctions(sample, sample_vjp)

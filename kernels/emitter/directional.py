"""Directional light: parallel rays along +z of its pose, given by the irradiance [W/m^2] on a facing surface."""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor, differentiable
from warp_psdr.kernels.constants import FAR, TEXTURE_CONSTANT
from warp_psdr.kernels.emitter.point import DeltaLightFunctions
from warp_psdr.kernels.emitter.spot import load_column
from warp_psdr.kernels.math import safe_normalize
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Emitter, LightAdjoint, LightSample, Scene
from warp_psdr.kernels.texture.texture import make_texture, make_texture_sink


@differentiable
@wp.func
def directional_dot(axis: wp.vec3, a_wi: wp.vec3) -> wp.float32:
    """Local factor: the direction towards the light from the unnormalised axis of its rays."""
    return -wp.dot(a_wi, safe_normalize(axis))


@functools.cache
def make_directional(role: str | None, wanted: tuple[str, ...]) -> DeltaLightFunctions:
    """Return the functions of the directional light (see `DeltaLightFunctions`).

    Args:
        role: "reverse", "forward", or None for a light that is not differentiated.
        wanted: "radiance" scatters to the irradiance, "pose" to the matrix, of which only the third column counts.
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
        result.distance = FAR
        result.wi = -safe_normalize(load_column(scene.values, e.to_world, 2))
        result.radiance = texture_at(scene, e.texture, 0, 0.0, 0.0, wp.vec2(0.0, 0.0))
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
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        if wp.static("radiance" in wanted):
            result.dot += accumulate_texture(scene, target, e.texture, 0, 0.0, 0.0, wp.vec2(0.0, 0.0), w).dot
        if wp.static("pose" in wanted):
            d_axis, _a = wp.grad(directional_dot)(load_column(scene.values, e.to_world, 2), a_wi)
            for i in range(wp.static(3)):
                result.dot += sink(target, e.to_world + 4 * i + 2, d_axis[i])
        return result

    return DeltaLightFunctions(sample, sample_vjp)

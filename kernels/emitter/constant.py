"""Constant environment: the same radiance from every direction. Also the common part of constant and image skies."""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.constants import FAR, TEXTURE_CONSTANT
from warp_psdr.kernels.sampling import sphere_pdf, square_to_sphere
from warp_psdr.kernels.structs import Emitter, LightAdjoint, LightSample, Scene
from warp_psdr.kernels.texture.texture import make_texture, make_texture_sink


class EnvironmentFunctions(NamedTuple):
    """Device functions of a light at infinity that surrounds the scene.

    ``sample(scene, e, x, u) -> LightSample``; ``eval(scene, e, direction) -> vec3`` and ``pdf(scene, e, direction) ->
    float`` [1/sr] for a unit direction away from the scene, ``eval_pdf`` both in one look-up; ``eval_vjp(scene, target,
    e, direction, w) -> LightAdjoint``: the gradient of dot(w, eval), scattered to the light's parameters and returned
    (``x``) for the direction. ``eval_vjp`` is None without a role.
    """

    sample: wp.Function
    eval: wp.Function
    pdf: wp.Function
    eval_pdf: wp.Function
    eval_vjp: wp.Function | None


@functools.cache
def make_constant(role: str | None, wanted: tuple[str, ...]) -> EnvironmentFunctions:
    """Return the functions of the constant environment (see `EnvironmentFunctions`).

    Args:
        role: "reverse", "forward", or None for a light that is not differentiated.
        wanted: "radiance" scatters to the radiance.
    """
    texture_at = make_texture((TEXTURE_CONSTANT,))
    accumulate_texture = (
        make_texture_sink(role, (TEXTURE_CONSTANT,), "radiance" in wanted, False, False) if role else None
    )

    @wp.func
    def radiance(scene: Scene, e: Emitter, direction: wp.vec3) -> wp.vec3:
        return texture_at(scene, e.texture, 0, 0.0, 0.0, wp.vec2(0.0, 0.0))

    @wp.func
    def pdf(scene: Scene, e: Emitter, direction: wp.vec3) -> wp.float32:
        return sphere_pdf()

    @wp.func
    def eval_pdf(scene: Scene, e: Emitter, direction: wp.vec3) -> tuple[wp.vec3, wp.float32]:
        return radiance(scene, e, direction), sphere_pdf()

    @wp.func
    def sample(scene: Scene, e: Emitter, x: wp.vec3, u: wp.vec2) -> LightSample:
        result = LightSample()
        result.face = -1
        result.distance = FAR
        result.wi = square_to_sphere(u)
        result.radiance = radiance(scene, e, result.wi)
        result.pdf = sphere_pdf()
        return result

    if role is None:
        return EnvironmentFunctions(sample, radiance, pdf, eval_pdf, None)

    @wp.func
    def eval_vjp(
        scene: Scene, target: wp.array(dtype=wp.float32), e: Emitter, direction: wp.vec3, w: wp.vec3
    ) -> LightAdjoint:
        result = LightAdjoint()
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        result.dot = accumulate_texture(scene, target, e.texture, 0, 0.0, 0.0, wp.vec2(0.0, 0.0), w).dot
        return result

    return EnvironmentFunctions(sample, radiance, pdf, eval_pdf, eval_vjp)

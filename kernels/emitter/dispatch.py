"""All light sources except area lights behind one set of functions, compiled for the kinds that a scene holds."""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.constants import (
    DELTA_LIGHTS,
    EMITTER_CONSTANT,
    EMITTER_DIRECTIONAL,
    EMITTER_DIRECTIONAL_AREA,
    EMITTER_ENVMAP,
    EMITTER_POINT,
    EMITTER_PROJECTOR,
    EMITTER_SPOT,
    EMITTER_TEXTURED_SPOT,
)
from warp_psdr.kernels.emitter.constant import make_constant
from warp_psdr.kernels.emitter.directional import make_directional
from warp_psdr.kernels.emitter.directionalarea import make_directional_area
from warp_psdr.kernels.emitter.envmap import make_envmap
from warp_psdr.kernels.emitter.point import make_point
from warp_psdr.kernels.emitter.projector import make_projector
from warp_psdr.kernels.emitter.spot import make_spot, make_textured_spot
from warp_psdr.kernels.generated import make_switch
from warp_psdr.kernels.reading import emitter_at
from warp_psdr.kernels.structs import LightAdjoint, Scene

ENVIRONMENTS = {EMITTER_CONSTANT: make_constant, EMITTER_ENVMAP: make_envmap}
WITHOUT_AREA = {
    EMITTER_POINT: make_point,
    EMITTER_SPOT: make_spot,
    EMITTER_TEXTURED_SPOT: make_textured_spot,
    EMITTER_PROJECTOR: make_projector,
    EMITTER_DIRECTIONAL: make_directional,
    EMITTER_DIRECTIONAL_AREA: make_directional_area,
}
WANTED = ("radiance", "pose")


@wp.func
def is_delta_light(kind: wp.int32) -> wp.bool:
    return ((wp.static(sum(1 << delta for delta in DELTA_LIGHTS)) >> kind) & 1) == 1


class LightFunctions(NamedTuple):
    """Device functions of a set of light sources; None: no source of the set has the function.

    ``sample(scene, e, x, u) -> LightSample``;
    ``sample_vjp(scene, target, e, x, wi, w, a_wi) -> LightAdjoint`` for point, spot and directional lights;
    ``environment_eval(scene, direction) -> vec3``, ``environment_pdf(scene, direction) -> float`` [1/sr, without the
    selection probability], ``environment_eval_pdf``, both in one look-up, and ``environment_vjp(scene, target,
    direction, w) -> LightAdjoint`` for the scene's environment, ``direction`` a unit vector away from the scene. The
    two vjps need a role.
    """

    sample: wp.Function | None
    sample_vjp: wp.Function | None
    environment_eval: wp.Function | None
    environment_pdf: wp.Function | None
    environment_eval_pdf: wp.Function | None
    environment_vjp: wp.Function | None


@functools.cache
def make_lights(kinds: tuple[int, ...], role: str | None, wanted: tuple[str, ...] | frozenset[str]) -> LightFunctions:
    """Return the functions for the light sources ``kinds`` (EMITTER_*, area lights excepted).

    Args:
        kinds: every kind that the scene holds, once each.
        role: "reverse", "forward", or None for lights that are not differentiated.
        wanted: which derivatives are scattered to the lights' own parameters: "radiance" (radiance, texels, intensity,
            irradiance, scale) and "pose" (to_world, position, angles of a spot, field of view of a projector).

    Raises:
        ValueError: unknown kind, role or derivative.
    """
    makers = ENVIRONMENTS | WITHOUT_AREA
    for kind in kinds:
        if kind not in makers:
            raise ValueError(f"unknown kind of light {kind!r}; expected any of {sorted(makers)} (area lights: area.py)")
    if role not in (None, "reverse", "forward"):
        raise ValueError(f"unknown role {role!r}; expected None, 'reverse' or 'forward'")
    if not set(wanted) <= set(WANTED):
        raise ValueError(f"unknown derivatives {sorted(set(wanted) - set(WANTED))}; expected any of {list(WANTED)}")
    flags = tuple(sorted(wanted))
    models = {kind: makers[kind](role, flags) for kind in kinds}
    environments = {kind: model for kind, model in models.items() if kind in ENVIRONMENTS}
    deltas = {kind: model for kind, model in models.items() if kind in DELTA_LIGHTS}
    environment_eval, environment_pdf, environment_eval_pdf, environment_vjp = None, None, None, None
    if environments:
        environment_eval = _environment_eval(_chain(environments, "eval"))
        environment_pdf = _environment_pdf(_chain(environments, "pdf"))
        environment_eval_pdf = _environment_eval_pdf(_chain(environments, "eval_pdf"))
    if environments and role is not None:
        environment_vjp = _environment_vjp(_chain(environments, "eval_vjp", anchored=True))
    return LightFunctions(
        sample=_chain(models, "sample"),
        sample_vjp=_chain(deltas, "sample_vjp", anchored=True) if role is not None else None,
        environment_eval=environment_eval,
        environment_pdf=environment_pdf,
        environment_eval_pdf=environment_eval_pdf,
        environment_vjp=environment_vjp,
    )


def make_delta_sample(kinds: tuple[int, ...]) -> wp.Function | None:
    """Return ``sample`` of the point, spot and directional lights among ``kinds``; None: there is none."""
    return make_lights(tuple(k for k in kinds if k in DELTA_LIGHTS), None, ()).sample


def _chain(models: dict, name: str, anchored: bool = False) -> wp.Function | None:
    """Return the function that calls the one of a light's kind; None: there are no models."""
    functions = {kind: getattr(model, name) for kind, model in models.items()}
    return make_switch(f"light_{name}", "e.kind", functions, anchored=anchored)


def _environment_eval(f: wp.Function) -> wp.Function:
    @wp.func
    def environment_eval(scene: Scene, direction: wp.vec3) -> wp.vec3:
        return f(scene, emitter_at(scene, scene.environment), direction)

    return environment_eval


def _environment_pdf(f: wp.Function) -> wp.Function:
    @wp.func
    def environment_pdf(scene: Scene, direction: wp.vec3) -> wp.float32:
        return f(scene, emitter_at(scene, scene.environment), direction)

    return environment_pdf


def _environment_eval_pdf(f: wp.Function) -> wp.Function:
    @wp.func
    def environment_eval_pdf(scene: Scene, direction: wp.vec3) -> tuple[wp.vec3, wp.float32]:
        found, density = f(scene, emitter_at(scene, scene.environment), direction)
        return found, density

    return environment_eval_pdf


def _environment_vjp(f: wp.Function) -> wp.Function:
    @wp.func
    def environment_vjp(
        scene: Scene, target: wp.array(dtype=wp.float32), direction: wp.vec3, w: wp.vec3
    ) -> LightAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        return f(scene, target, emitter_at(scene, scene.environment), direction, w)

    return environment_vjp

"""The scattering functions of a scene: those of its own models and no others.

``make_bsdf((BSDF_DIFFUSE,))`` calls the diffuse functions directly; with several models a chain of comparisons with the
model id is compiled, one link a model. A new model is a file with its functions and a row in ``_MODELS``.

All directions are local (z: shading normal) and unit, and point away from the surface: ``wi`` to the previous vertex,
``wo`` along the new direction. All models but the dielectric scatter on the side z > 0 only; for the back of a
two-sided surface the caller flips ``wi.z`` before and ``wo.z`` after the call.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import differentiable
from warp_psdr.kernels.bsdf.conductor import conductor_sample, conductor_scatter
from warp_psdr.kernels.bsdf.dielectric import dielectric_sample, dielectric_scatter
from warp_psdr.kernels.bsdf.diffuse import diffuse_eval, diffuse_pdf, diffuse_sample
from warp_psdr.kernels.bsdf.roughconductor import make_rough_conductor
from warp_psdr.kernels.constants import (
    BSDF_CONDUCTOR,
    BSDF_DIELECTRIC,
    BSDF_DIFFUSE,
    BSDF_ROUGH_CONDUCTOR_BECKMANN,
    BSDF_ROUGH_CONDUCTOR_GGX,
)
from warp_psdr.kernels.structs import BsdfAdjoint, BsdfSample, Material, Scattered


class BsdfFunctions(NamedTuple):
    """Warp functions over a set of models, ``model`` (a ``BSDF_*`` id) first. None: no model of the set provides it.

    Attributes:
        sample: ``(model, mat, wi, u, v) -> BsdfSample``. Primal only.
        is_delta: ``(model) -> bool``, True where ``scatter`` serves the model and ``eval`` does not.
        eval: ``(model, mat, wi, wo) -> vec3``, f_s times the cosine of ``wo``, 1/sr; 0 for delta models.
        pdf: ``(model, mat, wi, wo) -> float32``, density of ``sample``, solid angle; 0 for delta models.
        eval_vjp: ``(model, mat, wi, wo, w) -> BsdfAdjoint``, gradient of ``dot(w, eval)``.
        scatter: ``(model, mat, wi, lobe) -> Scattered``, direction and weight (not divided by the probability) of a
            delta lobe; 0 for smooth models.
        scatter_vjp: ``(model, mat, wi, lobe, w, a_wo) -> BsdfAdjoint``, gradient of ``dot(w, value) + dot(a_wo, wo)``;
            its ``wo`` is 0.
    """

    sample: wp.Function
    is_delta: wp.Function
    eval: wp.Function | None
    pdf: wp.Function | None
    eval_vjp: wp.Function | None
    scatter: wp.Function | None
    scatter_vjp: wp.Function | None


class _Smooth(NamedTuple):
    eval: wp.Function
    pdf: wp.Function
    sample: wp.Function


class _Delta(NamedTuple):
    sample: wp.Function
    scatter: wp.Function


#: Model id -> factory of its functions. The factories run only for models that are asked for.
_MODELS = {
    BSDF_DIFFUSE: lambda: _Smooth(diffuse_eval, diffuse_pdf, diffuse_sample),
    BSDF_CONDUCTOR: lambda: _Delta(conductor_sample, conductor_scatter),
    BSDF_DIELECTRIC: lambda: _Delta(dielectric_sample, dielectric_scatter),
    BSDF_ROUGH_CONDUCTOR_GGX: lambda: _Smooth(*make_rough_conductor("ggx")),
    BSDF_ROUGH_CONDUCTOR_BECKMANN: lambda: _Smooth(*make_rough_conductor("beckmann")),
}


@functools.cache
def make_bsdf(models: tuple[int, ...]) -> BsdfFunctions:
    """Return the scattering functions for the models (``BSDF_*`` ids) of a scene.

    Args:
        models: Distinct ids in ascending order, so that equal sets share one specialisation.

    Raises:
        ValueError: Empty, unsorted or unknown ids.
    """
    if not models or list(models) != sorted(set(models)) or any(m not in _MODELS for m in models):
        raise ValueError(
            f"got BSDF models {models!r}; expected a non-empty, strictly ascending tuple of ids out of "
            f"{sorted(_MODELS)}; pass tuple(sorted(set(ids)))"
        )
    functions = {m: _MODELS[m]() for m in models}
    smooth = {m: f for m, f in functions.items() if isinstance(f, _Smooth)}
    delta = {m: f for m, f in functions.items() if isinstance(f, _Delta)}
    # In a set of both kinds the other kind falls through to the functions that return zero.
    mixed = bool(smooth) and bool(delta)
    return BsdfFunctions(
        sample=_chain(_wrap_sample, {m: f.sample for m, f in functions.items()}),
        is_delta=_make_is_delta(frozenset(delta), mixed),
        eval=_chain(_wrap_eval, {m: f.eval for m, f in smooth.items()}, _no_eval if mixed else None),
        pdf=_chain(_wrap_pdf, {m: f.pdf for m, f in smooth.items()}, _no_pdf if mixed else None),
        eval_vjp=_chain(_wrap_eval_vjp, {m: f.eval for m, f in smooth.items()}, _no_eval_vjp if mixed else None),
        scatter=_chain(_wrap_scatter, {m: f.scatter for m, f in delta.items()}, _no_scatter if mixed else None),
        scatter_vjp=_chain(
            _wrap_scatter_vjp, {m: f.scatter for m, f in delta.items()}, _no_scatter_vjp if mixed else None
        ),
    )


def _chain(wrap, functions: dict[int, wp.Function], rest: wp.Function | None = None) -> wp.Function | None:
    """Build ``model == a ? f_a : model == b ? f_b : rest``; without ``rest`` the last function takes every model."""
    for model, f in reversed(functions.items()):
        rest = wrap(model, f, rest)
    return rest


def _make_is_delta(delta: frozenset[int], mixed: bool) -> wp.Function:
    if not mixed:
        answer = bool(delta)

        @wp.func
        def is_delta(model: wp.int32) -> wp.bool:
            return wp.static(answer)

        return is_delta

    bits = sum(1 << m for m in delta)

    @wp.func
    def is_delta_of(model: wp.int32) -> wp.bool:
        return ((wp.static(bits) >> model) & 1) == 1

    return is_delta_of


# The links of a chain. ``rest`` is None at its end, where ``f`` serves every model and no comparison is compiled.


def _wrap_eval(this: int, f: wp.Function, rest: wp.Function | None) -> wp.Function:
    @wp.func
    def eval_link(model: wp.int32, mat: Material, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        if wp.static(rest is not None):
            if model != wp.static(this):
                return rest(model, mat, wi, wo)
        return f(mat, wi, wo)

    return eval_link


def _wrap_pdf(this: int, f: wp.Function, rest: wp.Function | None) -> wp.Function:
    @wp.func
    def pdf_link(model: wp.int32, mat: Material, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        if wp.static(rest is not None):
            if model != wp.static(this):
                return rest(model, mat, wi, wo)
        return f(mat, wi, wo)

    return pdf_link


def _wrap_sample(this: int, f: wp.Function, rest: wp.Function | None) -> wp.Function:
    @wp.func
    def sample_link(model: wp.int32, mat: Material, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        if wp.static(rest is not None):
            if model != wp.static(this):
                return rest(model, mat, wi, u, v)
        return f(mat, wi, u, v)

    return sample_link


def _wrap_eval_vjp(this: int, f: wp.Function, rest: wp.Function | None) -> wp.Function:
    @differentiable
    @wp.func
    def eval_dot(mat: Material, wi: wp.vec3, wo: wp.vec3, w: wp.vec3) -> wp.float32:
        return wp.dot(w, f(mat, wi, wo))

    @wp.func
    def eval_vjp_link(model: wp.int32, mat: Material, wi: wp.vec3, wo: wp.vec3, w: wp.vec3) -> BsdfAdjoint:
        if wp.static(rest is not None):
            if model != wp.static(this):
                return rest(model, mat, wi, wo, w)
        a_mat, a_wi, a_wo, _a_w = wp.grad(eval_dot)(mat, wi, wo, w)
        adjoint = BsdfAdjoint()
        adjoint.material = a_mat
        adjoint.wi = a_wi
        adjoint.wo = a_wo
        return adjoint

    return eval_vjp_link


def _wrap_scatter(this: int, f: wp.Function, rest: wp.Function | None) -> wp.Function:
    @wp.func
    def scatter_link(model: wp.int32, mat: Material, wi: wp.vec3, lobe: wp.int32) -> Scattered:
        if wp.static(rest is not None):
            if model != wp.static(this):
                return rest(model, mat, wi, lobe)
        return f(mat, wi, lobe)

    return scatter_link


def _wrap_scatter_vjp(this: int, f: wp.Function, rest: wp.Function | None) -> wp.Function:
    @differentiable
    @wp.func
    def scatter_dot(mat: Material, wi: wp.vec3, lobe: wp.int32, w: wp.vec3, a_wo: wp.vec3) -> wp.float32:
        s = f(mat, wi, lobe)
        return wp.dot(w, s.value) + wp.dot(a_wo, s.wo)

    @wp.func
    def scatter_vjp_link(
        model: wp.int32, mat: Material, wi: wp.vec3, lobe: wp.int32, w: wp.vec3, a_wo: wp.vec3
    ) -> BsdfAdjoint:
        if wp.static(rest is not None):
            if model != wp.static(this):
                return rest(model, mat, wi, lobe, w, a_wo)
        a_mat, a_wi, _a_lobe, _a_w, _a_a_wo = wp.grad(scatter_dot)(mat, wi, lobe, w, a_wo)
        adjoint = BsdfAdjoint()
        adjoint.material = a_mat
        adjoint.wi = a_wi
        return adjoint

    return scatter_vjp_link


@wp.func
def _no_eval(model: wp.int32, mat: Material, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
    return wp.vec3(0.0, 0.0, 0.0)


@wp.func
def _no_pdf(model: wp.int32, mat: Material, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
    return 0.0


@wp.func
def _no_eval_vjp(model: wp.int32, mat: Material, wi: wp.vec3, wo: wp.vec3, w: wp.vec3) -> BsdfAdjoint:
    return BsdfAdjoint()


@wp.func
def _no_scatter(model: wp.int32, mat: Material, wi: wp.vec3, lobe: wp.int32) -> Scattered:
    return Scattered()


@wp.func
def _no_scatter_vjp(
    model: wp.int32, mat: Material, wi: wp.vec3, lobe: wp.int32, w: wp.vec3, a_wo: wp.vec3
) -> BsdfAdjoint:
    return BsdfAdjoint()

"""The scattering functions of a scene: those of its own models and no others.

``make_bsdf(("diffuse",))`` calls the diffuse functions directly; with several models a chain of comparisons with the
model's number, its place in that tuple, is compiled. A new model is a file with its declaration and a row in
``MODELS``, one made of models a row in ``COMPOSITES``.

All directions are local (z: shading normal) and unit, and point away from the surface: ``wi`` to the previous vertex,
``wo`` along the new direction. Models that do not transmit scatter on the side z > 0 only; for the back of a two-sided
surface the caller flips ``wi.z`` before and ``wo.z`` after the call.
"""

import functools
from collections.abc import Callable, Iterable
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import anchor, differentiable
from warp_psdr.kernels.bsdf.abc import ABC
from warp_psdr.kernels.bsdf.ashikhminshirley import ASHIKHMIN_SHIRLEY
from warp_psdr.kernels.bsdf.blendbsdf import BLEND
from warp_psdr.kernels.bsdf.bumpmap import BUMP_MAP
from warp_psdr.kernels.bsdf.composite import Composite, split_key
from warp_psdr.kernels.bsdf.conductor import CONDUCTOR
from warp_psdr.kernels.bsdf.decomposition import SignedLobes, Split
from warp_psdr.kernels.bsdf.dielectric import DIELECTRIC
from warp_psdr.kernels.bsdf.diffuse import DIFFUSE
from warp_psdr.kernels.bsdf.mask import MASK
from warp_psdr.kernels.bsdf.model import Functions, Model, key_of
from warp_psdr.kernels.bsdf.normalmap import NORMAL_MAP
from warp_psdr.kernels.bsdf.null import NULL
from warp_psdr.kernels.bsdf.orennayar import OREN_NAYAR
from warp_psdr.kernels.bsdf.plastic import PLASTIC
from warp_psdr.kernels.bsdf.principled import PRINCIPLED, TRANSMITTING_PRINCIPLED
from warp_psdr.kernels.bsdf.principledthin import PRINCIPLED_THIN
from warp_psdr.kernels.bsdf.record import (
    MaterialAlgebra,
    make_adjoint_record,
    make_material_algebra,
    make_material_record,
    merge_values,
)
from warp_psdr.kernels.bsdf.roughconductor import ROUGH_CONDUCTOR
from warp_psdr.kernels.bsdf.roughdielectric import ROUGH_DIELECTRIC
from warp_psdr.kernels.bsdf.roughplastic import ROUGH_PLASTIC
from warp_psdr.kernels.bsdf.thindielectric import THIN_DIELECTRIC
from warp_psdr.kernels.generated import make_generated, make_select
from warp_psdr.kernels.math import where3, where_number
from warp_psdr.kernels.structs import BsdfSample, Scattered

#: All scattering models.
MODELS: tuple[Model, ...] = (
    *(DIFFUSE, CONDUCTOR, DIELECTRIC, ROUGH_CONDUCTOR, PLASTIC, ROUGH_PLASTIC, ROUGH_DIELECTRIC),
    *(THIN_DIELECTRIC, NULL, PRINCIPLED, TRANSMITTING_PRINCIPLED, PRINCIPLED_THIN, OREN_NAYAR),
    *(ASHIKHMIN_SHIRLEY, ABC),
)
#: All models that are made of models; each for any children, so that they have no end.
COMPOSITES: tuple[Composite, ...] = (BLEND, NORMAL_MAP, BUMP_MAP, MASK)
#: Key of a variant -> model and the variant's name, in the order in which a scene numbers those that it has.
VARIANTS: dict[str, tuple[Model, str]] = {
    key_of(model.plugin, variant): (model, variant) for model in MODELS for variant in model.variants
}


#: Models that are computed for every path, at most.
MOST_SELECTED = 3


#: Functions of models that are selected among, and how.
SELECTED = {"sample": make_select(BsdfSample), "eval": where3, "pdf": where_number}


class BsdfFunctions(NamedTuple):
    """Warp functions over a set of models, ``model`` (its number) first. None: no model of the set provides it.

    Attributes:
        record: the struct of a material's values, ``mat``.
        adjoint: the struct of the partial derivatives of a weighted scattering value: ``material``, ``wi``, ``wo``.
        algebra: functions of ``record``.
        sample: ``(model, mat, wi, u, v) -> BsdfSample``. Primal only.
        has_smooth: ``(model) -> bool``: whether ``eval`` serves the model.
        has_delta: ``(model) -> bool``: whether ``scatter`` serves the model.
        eval: ``(model, mat, wi, wo) -> vec3``: smooth lobes, f_s times the cosine of ``wo``, 1/sr.
        pdf: ``(model, mat, wi, wo) -> float32``: density of ``sample`` in the smooth lobes, solid angle.
        eval_vjp: ``(model, mat, wi, wo, w) -> adjoint``, gradient of ``dot(w, eval)``.
        scatter: ``(model, mat, wi, lobe) -> Scattered``: direction and weight (not divided by the probability) of a
            delta lobe.
        scatter_vjp: ``(model, mat, wi, lobe, w, a_wo) -> adjoint``, gradient of ``dot(w, value) + dot(a_wo, wo)``; its
            ``wo`` is 0.
        probability: ``(model, mat, wi, lobe) -> float32``: of a delta lobe in ``sample``.
        transmits: ``(model) -> bool``.
        has_null: ``(model) -> bool``: whether light passes without being turned.
        mirrors: ``(model) -> bool``: whether there is a mirror reflection.
        relative_eta: ``(model, mat, wi) -> float32``: index behind the interface over the one in front; 1 where nothing
            is transmitted.
        slopes: ``(model, mat) -> vec2``: of a glossy lobe about the mirror direction; 0: there is none.
        normal: ``(model, mat, wi) -> vec3``: that lobes are about.
        glossy: ``(model) -> bool``: see ``Model``.
        split: see ``Split``.
        signed: see ``SignedLobes``.
        masked: ``(model) -> bool``: see ``Model``.
        each: the functions of every model by itself.
    """

    record: type
    adjoint: type
    algebra: MaterialAlgebra
    sample: wp.Function
    has_smooth: wp.Function
    has_delta: wp.Function
    eval: wp.Function | None
    pdf: wp.Function | None
    eval_vjp: wp.Function | None
    scatter: wp.Function | None
    scatter_vjp: wp.Function | None
    probability: wp.Function | None
    transmits: wp.Function
    has_null: wp.Function
    mirrors: wp.Function
    relative_eta: wp.Function | None
    slopes: wp.Function | None
    normal: wp.Function | None
    glossy: wp.Function
    split: Split | None
    signed: SignedLobes | None
    masked: wp.Function
    each: tuple[Functions, ...]


def declaration_of(key: str) -> tuple[Model, str]:
    """Return the model with a key and the name of its variant; of a composite, the model with its children.

    Raises:
        ValueError: There is no such model.
    """
    return VARIANTS[key] if key in VARIANTS else _nested_declaration(key)


@functools.cache
def _nested_declaration(key: str) -> tuple[Model, str]:
    plugin, variant, children = split_key(key)
    found = [composite for composite in COMPOSITES if composite.plugin == plugin]
    if not found:
        raise ValueError(f"{key!r} is no scattering model; expected one of {tuple(VARIANTS)}, or a nested one")
    return found[0].of(tuple(declaration_of(child) for child in children)), variant


def ordered(keys: Iterable[str]) -> tuple[str, ...]:
    """Return keys in the order in which a scene numbers its models, each once: as in ``VARIANTS``, then the nested."""
    given = set(keys)
    return (*(key for key in VARIANTS if key in given), *sorted(given - set(VARIANTS), key=str))


def models_of(keys: Iterable[str]) -> list[Model]:
    """Return the models with these keys."""
    return [declaration_of(key)[0] for key in keys]


def has_smooth_lobes(keys: Iterable[str]) -> bool:
    """Whether any of the models scatters other than in single directions."""
    return any(model.has_smooth for model in models_of(keys))


def has_delta_lobes(keys: Iterable[str]) -> bool:
    """Whether any of the models has a lobe of a single direction, as mirrors and glass have."""
    return any(model.has_delta for model in models_of(keys))


def has_chain_lobes(keys: Iterable[str], among_media: bool) -> bool:
    """Whether paths have vertices with a lobe of a single direction: a surface that is not there is none in media."""
    return any(model.has_delta and not (among_media and model is NULL) for model in models_of(keys))


def has_glossy_lobes(keys: Iterable[str]) -> bool:
    """Whether any of the models scatters at microfacets."""
    return any(model.glossy for model in models_of(keys))


def passing(keys: Iterable[str]) -> str:
    """Return the plugin of a model with smooth lobes behind its surface; empty: there is none."""
    return next((model.plugin for model in models_of(keys) if model.passes), "")


def has_null_lobes(keys: Iterable[str]) -> bool:
    """Whether light passes any of the models without being turned, as it does masks and thin glass."""
    return any(model.has_null for model in models_of(keys))


def is_diffuse(keys: Iterable[str]) -> bool:
    """Whether all is diffuse."""
    return set(keys) == {DIFFUSE.plugin}


@functools.cache
def make_bsdf(models: tuple[str, ...], selects: bool = False) -> BsdfFunctions:
    """Return the scattering functions for the models of a scene.

    Args:
        models: Distinct keys of ``VARIANTS`` and of nested models, ``ordered``, so that equal sets share one
            specialisation.
        selects: compute ``sample``, ``eval`` and ``pdf`` of a few models that do not branch, and select, rather than
            branch to the right one: for numbers side by side.

    Raises:
        ValueError: Empty, unsorted or unknown keys.
    """
    known = all(key in VARIANTS or (isinstance(key, str) and "(" in key) for key in models)
    if not models or not known or models != ordered(models):
        raise ValueError(
            f"got BSDF models {models!r}; expected some of {tuple(VARIANTS)}, each once and in this order, "
            "and nested ones behind them; pass ordered(keys)"
        )
    declared = models_of(models)
    record = make_material_record(tuple((value.name, value.type) for value in merge_values(declared)))
    adjoint = make_adjoint_record(record)
    functions = [model.make(record, variant) for model, variant in map(declaration_of, models)]
    types = {"record": record, "adjoint": adjoint, "BsdfSample": BsdfSample, "Scattered": Scattered}

    all_selected = selects and len(models) <= MOST_SELECTED and not any(f.branches for f in functions)

    def chain(name: str, signature: str, result: str, rest: str, make, *, of: str, anchored: bool = False):
        """Return the function that calls that of its model, or gives ``rest`` where a model has none."""
        own = {i: make(f) for i, f in enumerate(functions) if getattr(f, of) is not None}
        if all_selected and of in SELECTED:
            return _make_selection(name, signature, result, SELECTED[of], own, types)
        return _make_chain(name, signature, result, rest, own, len(functions), types, anchored)

    mat, wi, wo = "mat: record", "wi: wp.vec3", "wo: wp.vec3"
    lobe, weights = "lobe: wp.int32", "w: wp.vec3, a_wo: wp.vec3"
    black = "wp.vec3(0.0, 0.0, 0.0)"
    return BsdfFunctions(
        record=record,
        adjoint=adjoint,
        algebra=make_material_algebra(record),
        sample=chain(
            "sample", f"{mat}, {wi}, u: wp.float32, v: wp.vec2", "BsdfSample", "", lambda f: f.sample, of="sample"
        ),
        has_smooth=_make_test([model.has_smooth for model in declared]),
        has_delta=_make_test([model.has_delta for model in declared]),
        eval=chain("eval", f"{mat}, {wi}, {wo}", "wp.vec3", black, lambda f: f.eval, of="eval"),
        pdf=chain("pdf", f"{mat}, {wi}, {wo}", "wp.float32", "0.0", lambda f: f.pdf, of="pdf"),
        eval_vjp=chain(
            "eval_vjp", f"{mat}, {wi}, {wo}, w: wp.vec3", "adjoint", "adjoint()",
            lambda f: make_eval_vjp(record, adjoint, f.eval), of="eval", anchored=True,
        ),
        scatter=chain("scatter", f"{mat}, {wi}, {lobe}", "Scattered", "Scattered()", lambda f: f.scatter, of="scatter"),
        scatter_vjp=chain(
            "scatter_vjp", f"{mat}, {wi}, {lobe}, {weights}", "adjoint", "adjoint()",
            lambda f: _make_scatter_vjp(record, adjoint, f.scatter), of="scatter", anchored=True,
        ),
        probability=chain(
            "probability", f"{mat}, {wi}, {lobe}", "wp.float32", "0.0", lambda f: f.probability, of="probability"
        ),
        transmits=_make_test([model.transmits for model in declared]),
        has_null=_make_test([model.has_null for model in declared]),
        mirrors=_make_test([model.mirrors for model in declared]),
        relative_eta=chain(
            "relative_eta", f"{mat}, {wi}", "wp.float32", "1.0", lambda f: f.relative_eta, of="relative_eta"
        ),
        slopes=chain("slopes", mat, "wp.vec2", "wp.vec2(0.0, 0.0)", lambda f: f.slopes, of="slopes"),
        normal=chain(
            "normal", f"{mat}, {wi}", "wp.vec3", "wp.vec3(0.0, 0.0, 1.0)", lambda f: f.normal, of="normal"
        ),
        glossy=_make_test([model.glossy for model in declared]),
        split=_make_split(chain) if any(f.split is not None for f in functions) else None,
        signed=_make_signed(chain) if any(f.signed is not None for f in functions) else None,
        masked=_make_test([model.masked for model in declared]),
        each=tuple(functions),
    )  # fmt: skip


def _make_split(chain: Callable[..., wp.Function]) -> Split:
    """Return the functions of all models whose derivative by their roughness is split."""
    mat, axis = "mat: record, wi: wp.vec3", "axis: wp.int32"
    above = "wp.vec3(0.0, 0.0, 1.0)"
    return Split(
        chain(
            "split_draw",
            f"{mat}, {axis}, outer: wp.bool, u: wp.vec3",
            "wp.vec3",
            above,
            lambda f: f.split.draw,
            of="split",
        ),
        chain("split_density", f"{mat}, wo: wp.vec3", "wp.float32", "1.0", lambda f: f.split.density, of="split"),
        chain(
            "split_value",
            f"{mat}, wo: wp.vec3",
            "wp.vec3",
            "wp.vec3(0.0, 0.0, 0.0)",
            lambda f: f.split.value,
            of="split",
        ),
        chain("split_mass", f"mat: record, {axis}", "wp.float32", "0.0", lambda f: f.split.mass, of="split"),
        chain("split_rate", f"{mat}, wo: wp.vec3, {axis}", "wp.float32", "0.0", lambda f: f.split.rate, of="split"),
    )


def _make_signed(chain: Callable[..., wp.Function]) -> SignedLobes:
    """Return the functions of all models with derivatives that are sums of lobes of one sign."""
    mat, lobe = "mat: record, wi: wp.vec3", "number: wp.int32, second: wp.bool"
    below, none = "wp.vec3(0.0, 0.0, -1.0)", "wp.vec3(0.0, 0.0, 0.0)"
    return SignedLobes(
        chain("signed_draw", f"{mat}, {lobe}, u: wp.vec2", "wp.vec3", below, lambda f: f.signed.draw, of="signed"),
        chain("signed_weight", f"{mat}, wo: wp.vec3, {lobe}", "wp.vec3", none, lambda f: f.signed.weight, of="signed"),
    )


def _make_chain(
    name: str,
    signature: str,
    result: str,
    rest: str,
    own: dict[int, wp.Function],
    count: int,
    types: dict,
    anchored: bool,
) -> wp.Function | None:
    """Return ``name(model, ...)``: ``own[model](...)``, or ``rest`` where ``own`` has no such number."""
    if not own:
        return None
    arguments = ", ".join(part.split(":")[0].strip() for part in signature.split(","))
    lines = [f"def bsdf_{name}(model: wp.int32, {signature}) -> {result}:"]
    if anchored:
        lines.append("    _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py")
    *links, last = own
    if len(own) < count:
        links, otherwise = list(own), rest
    else:
        otherwise = f"f{last}({arguments})"
    for number in links:
        lines += [f"    if model == {number}:", f"        return f{number}({arguments})"]
    lines.append(f"    return {otherwise}\n")
    return make_generated("\n".join(lines), anchor=anchor, **types, **{f"f{number}": f for number, f in own.items()})


def _make_selection(
    name: str, signature: str, result: str, select: wp.Function, own: dict[int, wp.Function], types: dict
) -> wp.Function:
    """Return ``name(model, ...)``: what all functions give, of which that of the model is selected."""
    arguments = ", ".join(part.split(":")[0].strip() for part in signature.split(","))
    first, *others = own
    lines = [f"def bsdf_{name}_all(model: wp.int32, {signature}) -> {result}:", f"    r = f{first}({arguments})"]
    lines += [f"    r = select(model == {number}, f{number}({arguments}), r)" for number in others]
    lines.append("    return r\n")
    functions = {f"f{number}": f for number, f in own.items()}
    return make_generated("\n".join(lines), select=select, **types, **functions)


def _make_test(answers: list[bool]) -> wp.Function:
    """Return ``(model) -> bool``, whether the answer for a model is yes."""
    bits = sum(1 << number for number, answer in enumerate(answers) if answer)
    if all(answers) or not any(answers):

        @wp.func
        def answer_of_all(model: wp.int32) -> wp.bool:
            return wp.static(bits != 0)

        return answer_of_all

    @wp.func
    def answer_of(model: wp.int32) -> wp.bool:
        return ((wp.static(bits) >> model) & 1) == 1

    return answer_of


def make_eval_vjp(record: type, adjoint: type, f: wp.Function) -> wp.Function:
    """Return ``eval_vjp`` of one model, whose ``eval`` is ``f``; see ``BsdfFunctions``."""

    @differentiable
    @wp.func
    def eval_dot(mat: record, wi: wp.vec3, wo: wp.vec3, w: wp.vec3) -> wp.float32:
        return wp.dot(w, f(mat, wi, wo))

    @wp.func
    def eval_vjp_of(mat: record, wi: wp.vec3, wo: wp.vec3, w: wp.vec3) -> adjoint:
        a_mat, a_wi, a_wo, _a_w = wp.grad(eval_dot)(mat, wi, wo, w)
        result = adjoint()
        result.material = a_mat
        result.wi = a_wi
        result.wo = a_wo
        return result

    return eval_vjp_of


def _make_scatter_vjp(record: type, adjoint: type, f: wp.Function) -> wp.Function:
    @differentiable
    @wp.func
    def scatter_dot(mat: record, wi: wp.vec3, lobe: wp.int32, w: wp.vec3, a_wo: wp.vec3) -> wp.float32:
        s = f(mat, wi, lobe)
        return wp.dot(w, s.value) + wp.dot(a_wo, s.wo)

    @wp.func
    def scatter_vjp_of(mat: record, wi: wp.vec3, lobe: wp.int32, w: wp.vec3, a_wo: wp.vec3) -> adjoint:
        a_mat, a_wi, _a_lobe, _a_w, _a_a_wo = wp.grad(scatter_dot)(mat, wi, lobe, w, a_wo)
        result = adjoint()
        result.material = a_mat
        result.wi = a_wi
        return result

    return scatter_vjp_of

"""Values, samples and densities of several scattering models for all lanes in step (``path_lanes.py``), model by model.

A model that no path stands on is left out. A model that does not branch (``Functions.branches``) is a loop over all
lanes, which becomes SIMD; lanes on other materials are computed too, and keep their own results. A model that branches
is computed for the lanes that stand on it, one after the other.
"""

from collections.abc import Callable
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.dispatch import declaration_of, make_eval_vjp
from warp_psdr.kernels.bsdf.model import Functions
from warp_psdr.kernels.bsdf.record import make_add_where
from warp_psdr.kernels.generated import make_generated, make_select
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.lanes.lanes import ROWS, Rows, make_number, stack_rows
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.scattering import make_transmitted_more
from warp_psdr.kernels.structs import BsdfSample
from warp_psdr.kernels.vertex import LightConfig, SurfaceConfig

#: Models have a bit each, those from this number on a common one.
LAST_BIT = 30


@wp.struct
class ScatteringValue:
    """Scattering functions at a pair of directions."""

    value: wp.vec3  # f_s times the cosine, 1/sr
    pdf: wp.float32  # solid angle


class ModelLanes(NamedTuple):
    """What ``make_model_lanes`` makes. ``models``: the bits of those that paths stand on.

    Attributes:
        draw: ``(models, standing, rows)`` draws directions by the random numbers in the rows 4, 6 and 7.
        make_evaluate: ``light samples -> (models, standing, rows)``, which computes values towards lights.
        drawn: the directions, ``BsdfSample``.
        values: ``ScatteringValue``; anything on models without smooth lobes.
    """

    draw: wp.Function
    make_evaluate: Callable[[Rows], wp.Function]
    drawn: Rows
    values: Rows


@wp.func
def model_bit(model: wp.int32) -> wp.int32:
    return 1 << wp.min(model, LAST_BIT)


def make_model_lanes(
    surfaces: SurfaceConfig, lights: LightConfig, differential: bool, width: int, first: int, places: Rows
) -> ModelLanes:
    """Make the functions.

    Args:
        surfaces: what the surfaces need; there are several models.
        lights: what the lights need.
        differential: whether directions are drawn for derivatives.
        width: number of lanes.
        first: the first row that they may take; the last one is the last of ``values``.
        places: where the paths stand, interactions.
    """
    models = make_interaction(surfaces, lights).bsdf.each
    drawn, values = stack_rows(width, first, BsdfSample, ScatteringValue)
    numbers = make_number(width)[0]
    more = make_transmitted_more(surfaces, lights) if differential else None
    draws = {k: _make_draw(k, f, more, width, places, drawn, numbers) for k, f in enumerate(models)}

    def make_evaluate(light_samples: Rows) -> wp.Function:
        smooth = {k: f for k, f in enumerate(models) if f.eval is not None}
        return _make_each(
            "evaluate_models",
            {k: _make_evaluate(k, f, width, places, light_samples, values) for k, f in smooth.items()},
            len(models),
        )

    return ModelLanes(_make_each("draw_models", draws, len(models)), make_evaluate, drawn, values)


def _make_each(name: str, functions: dict[int, wp.Function], count: int, differentiates: bool = False) -> wp.Function:
    """Return ``name(models, standing, rows)``, which calls the functions of the models that paths stand on.

    ``count``: number of models in the scene; that of an only one is always called.
    """
    lines = [f"def {name}(models: wp.int32, standing: wp.int32, rows: ROWS):"]
    if differentiates:
        lines.append("    _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py")
    for k in functions:
        if count == 1:
            lines.append(f"    f{k}(standing, rows)")
        else:
            lines += [f"    if models & {1 << min(k, LAST_BIT)} > 0:", f"        f{k}(standing, rows)"]
    named = {f"f{k}": f for k, f in functions.items()}
    return make_generated("\n".join(lines) + "\n", ROWS=ROWS, anchor=anchor, **named)


def _make_draw(
    k: int, f: Functions, more: wp.Function | None, width: int, places: Rows, drawn: Rows, number: wp.Function
) -> wp.Function:
    """``more``: ``make_transmitted_more``'s."""
    sample, where_sample = f.sample, make_select(BsdfSample)
    rebalanced = more is not None and f.relative_eta is not None and f.scatter is not None

    @wp.func
    def draw_of_model(standing: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            at = places.get(rows, j)
            v = wp.vec2(number(rows, 6, j), number(rows, 7, j))
            found = sample(at.material, at.wi, number(rows, 4, j), v)
            drawn.put(rows, j, where_sample(at.model == k, found, drawn.get(rows, j)))
            j += 1

    @wp.func
    def draw_on_model(standing: wp.int32, rows: ROWS):
        for j in range(standing):
            at = places.get(rows, j)
            if at.model == k:
                u = number(rows, 4, j)
                found = sample(at.material, at.wi, u, wp.vec2(number(rows, 6, j), number(rows, 7, j)))
                if wp.static(rebalanced):
                    found = more(at, found, u)
                drawn.put(rows, j, found)

    return draw_on_model if f.branches else draw_of_model


def _make_evaluate(k: int, f: Functions, width: int, places: Rows, light_samples: Rows, values: Rows) -> wp.Function:
    value_of, pdf_of = f.eval, f.pdf

    @wp.func
    def evaluate_of_model(standing: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            at = places.get(rows, j)
            wo = enter_frame(at.frame, light_samples.get(rows, j).wi)
            found = values.get(rows, j)
            here = at.model == k
            found.value = where3(here, value_of(at.material, at.wi, wo), found.value)
            found.pdf = wp.where(here, pdf_of(at.material, at.wi, wo), found.pdf)
            values.put(rows, j, found)
            j += 1

    @wp.func
    def evaluate_on_model(standing: wp.int32, rows: ROWS):
        for j in range(standing):
            at = places.get(rows, j)
            if at.model == k:
                wo = enter_frame(at.frame, light_samples.get(rows, j).wi)
                found = ScatteringValue()
                found.value = value_of(at.material, at.wi, wo)
                found.pdf = pdf_of(at.material, at.wi, wo)
                values.put(rows, j, found)

    return evaluate_on_model if f.branches else evaluate_of_model


def make_adjoints_of_each(
    surfaces: SurfaceConfig, lights: LightConfig, width: int, places: Rows, weights: Rows, adjoints: Rows
) -> wp.Function:
    """Return ``(models, standing, rows)``, which adds adjoints of material values.

    Args:
        surfaces: what the surfaces need.
        lights: what the lights need.
        width: number of lanes.
        places: where the paths stand, interactions.
        weights: directions ``wo`` and weights ``w`` of the scattering values there; 0 where there is none.
        adjoints: the record of material values that they are added to.
    """
    bsdf = make_interaction(surfaces, lights).bsdf

    def make(k: int, f: Functions) -> wp.Function:
        vjp = make_eval_vjp(bsdf.record, bsdf.adjoint, f.eval)
        # A model reads few of the scene's values; the adjoints of the others are left alone.
        names = tuple(value.name for value in declaration_of(surfaces.bsdfs[k])[0].values)
        add_where = make_add_where(bsdf.record, names)

        @wp.func
        def add_adjoint_of_model(standing: wp.int32, rows: ROWS):
            _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
            j = wp.int32(0)
            while j < width:
                at = places.get(rows, j)
                weight = weights.get(rows, j)
                found = adjoints.get(rows, j)
                more = vjp(at.material, at.wi, weight.wo, weight.w)
                adjoints.put(rows, j, add_where(at.model == k, found, more.material))
                j += 1

        @wp.func
        def add_adjoint_on_model(standing: wp.int32, rows: ROWS):
            _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
            for j in range(standing):
                at = places.get(rows, j)
                if at.model == k:
                    weight = weights.get(rows, j)
                    if not vanishes(weight.w):
                        more = vjp(at.material, at.wi, weight.wo, weight.w)
                        adjoints.put(rows, j, add_where(True, adjoints.get(rows, j), more.material))

        return add_adjoint_on_model if f.branches else add_adjoint_of_model

    smooth = {k: make(k, f) for k, f in enumerate(bsdf.each) if f.eval is not None}
    return _make_each("add_adjoints_of_models", smooth, len(bsdf.each), differentiates=True)

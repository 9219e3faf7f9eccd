"""A mixture of two models by a texture (Mitsuba's ``blendbsdf``): f = (1 - w) f_1 + w f_2, w clamped to [0, 1].

A sample comes from the second model with probability p, and from the first with 1 - p. Smooth lobes have the density (1
- p) p_1 + p p_2. A delta lobe that both models have is one lobe, whose weights and probabilities add. A probability
never joins a density. (It does in Mitsuba, where half mirror, half paint reflects 0.40 in the mirror.) p is w, but at
least ``MIN_SHARE`` from 0 and 1, because a lobe of weight 0 has the derivative f_2 - f_1 by its weight.
"""

import warp as wp

from warp_psdr.kernels.bsdf.composite import BoundChild, Child, Composite
from warp_psdr.kernels.bsdf.model import Functions, Number
from warp_psdr.kernels.constants import (
    LOBE_DELTA_REFLECTION,
    LOBE_DELTA_TRANSMISSION,
    LOBE_SMOOTH,
    ONE_MINUS_EPSILON,
)
from warp_psdr.kernels.generated import make_select
from warp_psdr.kernels.math import clamp_unit, where3
from warp_psdr.kernels.structs import BsdfSample, Scattered

#: Least probability of either model.
MIN_SHARE = 0.05


@wp.func
def second_share(weight: wp.float32) -> wp.float32:
    """Probability of the second model."""
    return wp.clamp(weight, MIN_SHARE, 1.0 - MIN_SHARE)


def make_blend(record: type, _variant: str, children: tuple[Child, ...]) -> Functions:
    """Return the functions of the mixture of two models."""
    a, b = (child.bind(record) for child in children)
    smooth = any(child.model.has_smooth for child in children)
    delta = any(child.model.has_delta for child in children)

    @wp.func
    def blend_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        w = clamp_unit(mat.weight)
        return (1.0 - w) * a.eval(mat, wi, wo) + w * b.eval(mat, wi, wo)

    @wp.func
    def blend_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the smooth samples, solid angle."""
        p = second_share(mat.weight)
        return (1.0 - p) * a.pdf(mat, wi, wo) + p * b.pdf(mat, wi, wo)

    @wp.func
    def blend_scatter(mat: record, wi: wp.vec3, lobe: wp.int32) -> Scattered:
        """Direction and weight of a delta lobe; differentiable."""
        w = clamp_unit(mat.weight)
        from_a = a.scatter(mat, wi, lobe)
        from_b = b.scatter(mat, wi, lobe)
        value = ((1.0 - w) * a.sends(lobe)) * from_a.value + (w * b.sends(lobe)) * from_b.value
        return Scattered(where3(a.sends(lobe) == 1.0, from_a.wo, from_b.wo), value)

    @wp.func
    def blend_probability(mat: record, wi: wp.vec3, lobe: wp.int32) -> wp.float32:
        p = second_share(mat.weight)
        from_a = a.sends(lobe) * a.probability(mat, wi, lobe)
        return (1.0 - p) * from_a + p * (b.sends(lobe) * b.probability(mat, wi, lobe))

    where_sample = make_select(BsdfSample)

    @wp.func
    def blend_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Choose a model by ``u``, whose rest it samples with, and ask it for a direction."""
        p = second_share(mat.weight)
        second = u < p
        rest = wp.min(wp.where(second, u / p, (u - p) / (1.0 - p)), ONE_MINUS_EPSILON)
        s = where_sample(second, b.sample(mat, wi, rest, v), a.sample(mat, wi, rest, v))
        if wp.static(smooth):
            from_smooth = s.lobe == LOBE_SMOOTH
            s.pdf = wp.where(from_smooth, blend_pdf(mat, wi, s.wo), s.pdf)
            s.value = where3(from_smooth, blend_eval(mat, wi, s.wo), s.value)
        if wp.static(delta):
            single = s.lobe > LOBE_SMOOTH
            s.pdf = wp.where(single, blend_probability(mat, wi, s.lobe), s.pdf)
            s.value = where3(single, blend_scatter(mat, wi, s.lobe).value, s.value)
        return s

    glass = (bound for bound, child in zip((a, b), children, strict=True) if child.has(LOBE_DELTA_TRANSMISSION))
    through = next(glass, None)
    return Functions(
        blend_sample,
        blend_eval if smooth else None,
        blend_pdf if smooth else None,
        blend_scatter if delta else None,
        blend_probability if delta else None,
        relative_eta=through.relative_eta if through is not None and through.own.relative_eta is not None else None,
        slopes=_make_slopes(record, a, b),
        normal=_make_normal(record, a, b),
        branches=a.own.branches or b.own.branches,
    )


def _make_slopes(record: type, a: BoundChild, b: BoundChild) -> wp.Function | None:
    """Return the slopes of the glossy lobe, of the one with the greater weight if there are two."""
    if a.own.slopes is None or b.own.slopes is None:
        return a.slopes if a.own.slopes is not None else b.slopes if b.own.slopes is not None else None

    @wp.func
    def blend_slopes(mat: record) -> wp.vec2:
        slopes = a.slopes(mat)
        if mat.weight > 0.5:
            slopes = b.slopes(mat)
        return slopes

    return blend_slopes


def _make_normal(record: type, a: BoundChild, b: BoundChild) -> wp.Function | None:
    """Return the normal that a lobe is about, of the one with the greater weight."""
    if a.own.normal is None and b.own.normal is None:
        return None

    @wp.func
    def blend_normal(mat: record, wi: wp.vec3) -> wp.vec3:
        normal = a.normal(mat, wi)
        if mat.weight > 0.5:
            normal = b.normal(mat, wi)
        return normal

    return blend_normal


def refuse_blend(children: tuple[Child, ...]) -> str:
    """Say why two models cannot be mixed: a delta lobe of both that leaves in two directions."""
    if all(child.has(LOBE_DELTA_TRANSMISSION) for child in children):
        return "both refract, in two directions; give one of them a roughness, or blend their transmittances"
    if all(child.has(LOBE_DELTA_REFLECTION) for child in children) and any(child.model.framed for child in children):
        return "both have a mirror reflection, and a normal or bump map turns that of one; put the map around the blend"
    return ""


BLEND = Composite(
    "blendbsdf",
    (Number("weight"),),
    ("first", "second"),
    ("bsdf_0", "bsdf_1"),
    make_blend,
    refuse_blend,
    mixes=("weight",),
)

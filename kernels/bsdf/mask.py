"""A model that lets part of the light pass (Mitsuba's ``mask``): f = o f_nested, and a null lobe of weight 1 - o.

The opacity o is clamped to [0, 1]. A sample comes from the nested model with probability o; else it goes straight on.
If derivatives by an opacity are requested (the variant ``EXPLORED``), that probability keeps ``MIN_SHARE`` from 0 and
1: a lobe of weight 0 has a derivative by o, but only samples of the lobe can estimate it.
"""

import warp as wp

from warp_psdr.kernels.bsdf.composite import Child, Composite, split_key
from warp_psdr.kernels.bsdf.model import Functions, Number, key_of
from warp_psdr.kernels.constants import LOBE_NULL, LOBE_SMOOTH, ONE_MINUS_EPSILON
from warp_psdr.kernels.math import clamp_unit, where3, where_number
from warp_psdr.kernels.structs import BsdfSample, Scattered

#: Name of the variant that draws both lobes whatever the opacity is, and the least probability of either there.
EXPLORED, MIN_SHARE = "explored", 0.05


def make_mask(record: type, variant: str, children: tuple[Child, ...]) -> Functions:
    """Return the functions of a masked model."""
    nested = children[0].bind(record)
    smooth = children[0].model.has_smooth
    delta = children[0].model.has_delta
    least = MIN_SHARE if variant == EXPLORED else 0.0

    @wp.func
    def nested_share(mat: record) -> wp.float32:
        """Probability of the nested model."""
        return wp.clamp(mat.opacity, wp.static(least), wp.static(1.0 - least))

    @wp.func
    def mask_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        return clamp_unit(mat.opacity) * nested.eval(mat, wi, wo)

    @wp.func
    def mask_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the smooth samples, solid angle."""
        return nested_share(mat) * nested.pdf(mat, wi, wo)

    @wp.func
    def mask_scatter(mat: record, wi: wp.vec3, lobe: wp.int32) -> Scattered:
        """Direction and weight of a delta lobe; differentiable."""
        o = clamp_unit(mat.opacity)
        passed = where_number(lobe == LOBE_NULL, 1.0 - o, 0.0)
        value = wp.vec3(passed, passed, passed)
        wo = -wi
        if wp.static(delta):
            inner = nested.scatter(mat, wi, lobe)
            value += (o * nested.sends(lobe)) * inner.value
            wo = where3(lobe == LOBE_NULL, wo, inner.wo)
        return Scattered(wo, value)

    @wp.func
    def mask_probability(mat: record, wi: wp.vec3, lobe: wp.int32) -> wp.float32:
        """Probability of a delta lobe."""
        q = nested_share(mat)
        probability = where_number(lobe == LOBE_NULL, 1.0 - q, 0.0)
        if wp.static(delta):
            probability += q * (nested.sends(lobe) * nested.probability(mat, wi, lobe))
        return probability

    @wp.func
    def mask_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Ask the nested model with the rest of ``u``, or go straight on."""
        q = nested_share(mat)
        inner = u < q
        s = nested.sample(mat, wi, wp.min(u / where_number(inner, q, 1.0), ONE_MINUS_EPSILON), v)
        s.lobe = wp.where(inner, s.lobe, LOBE_NULL)
        s.eta = where_number(inner, s.eta, 1.0)
        s.wo = where3(inner, s.wo, -wi)
        if wp.static(smooth):
            passed = s.lobe == LOBE_SMOOTH
            s.pdf = where_number(passed, mask_pdf(mat, wi, s.wo), s.pdf)
            s.value = where3(passed, mask_eval(mat, wi, s.wo), s.value)
        single = s.lobe > LOBE_SMOOTH
        s.pdf = where_number(single, mask_probability(mat, wi, s.lobe), s.pdf)
        s.value = where3(single, mask_scatter(mat, wi, s.lobe).value, s.value)
        return s

    return Functions(
        mask_sample,
        mask_eval if smooth else None,
        mask_pdf if smooth else None,
        mask_scatter,
        mask_probability,
        relative_eta=nested.relative_eta if nested.own.relative_eta is not None else None,
        slopes=nested.slopes if nested.own.slopes is not None else None,
        normal=nested.normal if nested.own.normal is not None else None,
        branches=nested.own.branches,
    )


def explored(key: str) -> str:
    """Return the key of a model whose masks, also nested ones, draw all of their lobes."""
    if "mask(" not in key:
        return key
    plugin, variant, children = split_key(key)
    return key_of(plugin, EXPLORED if plugin == MASK.plugin else variant, tuple(map(explored, children)))


MASK = Composite(
    "mask",
    (Number("opacity", default=0.5),),
    ("nested",),
    ("nested_bsdf",),
    make_mask,
    lambda children: "",
    mixes=("opacity",),
    adds=(LOBE_NULL,),
)

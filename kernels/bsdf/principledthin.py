"""Disney's material for thin sheets (Mitsuba's ``principledthin``): paper, leaves, frosted panes, with two like sides.

With h the half vector of ``wi`` and ``wo``, both mirrored to the front of the sheet, c = <wi, h>, t = spec_trans and
d = diff_trans / 2,

    f_s = t F D G / (4 cos(wi) cos(wo)) + (1 - t) (1 - d) (base_color f_base / pi + sheen S(c) C_sheen)     (reflected),
    f_s = t base_color (1 - F_d) D' G' / (4 cos(wi) cos(wo)) + (1 - t) d base_color / pi                (transmitted),

where D' is GGX's density at the roughness (0.65 eta - 0.35) roughness: a sheet bends light back, and only blurs it
[Burley 2015]. All lobes are compiled whatever their weights are, so that a lobe with weight 0 has its derivative, too.

Derivation: ``docs/theory/materials.md#thin-sheets``.
"""

import functools
import math

import warp as wp

from warp_psdr.kernels.bsdf.diffuse import diffuse_pdf
from warp_psdr.kernels.bsdf.microfacet import MIN_COSINE, make_reflection
from warp_psdr.kernels.bsdf.model import MIN_INDEX, Color, Functions, Model, Number, Rate
from warp_psdr.kernels.bsdf.plastic import MIN_SHARE
from warp_psdr.kernels.bsdf.principled import (
    base_scattering,
    principled_alphas,
    schlick_of_index,
    sheen_color,
    stretched_alphas,
    tint_of,
    tinted_reflectance,
)
from warp_psdr.kernels.bsdf.roughdielectric import turned
from warp_psdr.kernels.bsdf.roughplastic import WIDE_SLOPE
from warp_psdr.kernels.constants import INV_PI, LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.fresnel import coat_reflectance, coat_transmittance
from warp_psdr.kernels.math import clamp_unit
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere
from warp_psdr.kernels.structs import BsdfSample


@wp.func
def transmitted_alphas(roughness: wp.float32, anisotropic: wp.float32, eta: wp.float32) -> wp.vec2:
    """Slopes of the lobe that passes the sheet [Burley 2015, figure 15]."""
    return stretched_alphas((0.65 * eta - 0.35) * clamp_unit(roughness), anisotropic)


@functools.cache
def make_principled_thin(record: type, _variant: str) -> Functions:
    """Return the model's functions."""
    reflection = make_reflection("ggx")

    @wp.func
    def passing_share(mat: record) -> wp.float32:
        """d: the share of diffuse light that passes."""
        return clamp_unit(0.5 * mat.diff_trans)

    @wp.func
    def principled_thin_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        i = turned(wi, wp.sign(wi[2]))
        o = turned(wo, wp.sign(wo[2]))
        if i[2] <= MIN_COSINE or o[2] <= MIN_COSINE:
            return wp.vec3(0.0, 0.0, 0.0)
        h = i + o
        c = 0.5 * wp.sqrt(wp.dot(h, h))
        glossy = clamp_unit(mat.spec_trans)
        through = passing_share(mat)
        base = mat.base_color
        if wi[2] * wo[2] < 0.0:
            alphas = transmitted_alphas(mat.roughness, mat.anisotropic, mat.ior)
            blurred = glossy * coat_transmittance(c, mat.ior) * reflection.value(i, o, alphas[0], alphas[1])
            return (blurred + (1.0 - glossy) * through * INV_PI * o[2]) * base
        alphas = principled_alphas(mat.roughness, mat.anisotropic)
        dielectric = coat_reflectance(c, mat.ior) * wp.vec3(1.0, 1.0, 1.0)
        tinted = tinted_reflectance(tint_of(base), mat.ior, schlick_of_index(c, mat.ior))
        fresnel = dielectric + clamp_unit(mat.spec_tint) * (tinted - dielectric)
        mirrored = (glossy * reflection.value(i, o, alphas[0], alphas[1])) * fresnel
        matte = (INV_PI * base_scattering(mat.roughness, mat.flatness, i[2], o[2], c)) * base
        matte = matte + sheen_color(base, mat.sheen, mat.sheen_tint, c)
        return mirrored + ((1.0 - glossy) * (1.0 - through) * o[2]) * matte

    @wp.func
    def thin_weights(mat: record) -> wp.vec4:
        """Weights among samples, which add up to 1: glossy and diffuse, each reflected and passing the sheet.

        No lobe has weight 0: what is not drawn has no derivative.
        """
        glossy = wp.clamp(mat.spec_trans, MIN_SHARE, 1.0 - MIN_SHARE)
        through = wp.clamp(0.5 * mat.diff_trans, MIN_SHARE, 1.0 - MIN_SHARE)
        w = wp.vec4(
            0.5 * glossy * mat.specular_reflectance_sampling_rate,
            0.5 * glossy * mat.specular_transmittance_sampling_rate,
            (1.0 - glossy) * (1.0 - through) * mat.diffuse_reflectance_sampling_rate,
            (1.0 - glossy) * through * mat.diffuse_transmittance_sampling_rate,
        )
        return w / (w[0] + w[1] + w[2] + w[3])

    @wp.func
    def principled_thin_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the sampled directions, solid angle."""
        i = turned(wi, wp.sign(wi[2]))
        o = turned(wo, wp.sign(wo[2]))
        if i[2] <= MIN_COSINE or o[2] <= MIN_COSINE:
            return 0.0
        weights = thin_weights(mat)
        if wi[2] * wo[2] < 0.0:
            alphas = transmitted_alphas(mat.roughness, mat.anisotropic, mat.ior)
            return weights[1] * reflection.pdf(i, o, alphas[0], alphas[1]) + weights[3] * diffuse_pdf(i, o)
        alphas = principled_alphas(mat.roughness, mat.anisotropic)
        return weights[0] * reflection.pdf(i, o, alphas[0], alphas[1]) + weights[2] * diffuse_pdf(i, o)

    @wp.func
    def principled_thin_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Choose a lobe by ``u``, a direction by ``v``; none where a reflected direction points into the sheet."""
        s = BsdfSample()
        s.eta = 1.0
        s.lobe = LOBE_NONE
        up = wp.sign(wi[2])
        i = turned(wi, up)
        if i[2] > MIN_COSINE:
            weights = thin_weights(mat)
            glossy = weights[0] + weights[1]
            passes = (u >= weights[0] and u < glossy) or u >= glossy + weights[2]
            alphas = principled_alphas(mat.roughness, mat.anisotropic)
            if passes:
                alphas = transmitted_alphas(mat.roughness, mat.anisotropic, mat.ior)
            o = square_to_cosine_hemisphere(v)
            if u < glossy:
                o = reflection.sample(i, alphas[0], alphas[1], v)
            if o[2] > MIN_COSINE:
                s.wo = turned(o, wp.where(passes, -up, up))
                s.pdf = principled_thin_pdf(mat, wi, s.wo)
                if s.pdf > 0.0:
                    s.value = principled_thin_eval(mat, wi, s.wo)
                    s.lobe = LOBE_SMOOTH
        return s

    @wp.func
    def slopes(mat: record) -> wp.vec2:
        alphas = principled_alphas(mat.roughness, mat.anisotropic)
        return wp.vec2(wp.max(alphas[0], WIDE_SLOPE), wp.max(alphas[1], WIDE_SLOPE))

    return Functions(principled_thin_sample, principled_thin_eval, principled_thin_pdf, slopes=slopes)


PRINCIPLED_THIN = Model(
    "principledthin",
    (
        Color("base_color", 0.5),
        Number("roughness", default=0.5),
        *(Number(name, default=0.0) for name in ("anisotropic", "spec_trans")),
        Number("eta", MIN_INDEX, math.inf, 1.5, read="ior"),
        *(Number(name, default=0.0) for name in ("spec_tint", "sheen", "sheen_tint", "flatness")),
        Number("diff_trans", 0.0, 2.0, 0.0),
        *(Rate(f"specular_{way}_sampling_rate", 1.0, low=1.0e-3) for way in ("reflectance", "transmittance")),
        *(Rate(f"diffuse_{way}_sampling_rate", 1.0, low=1.0e-3) for way in ("reflectance", "transmittance")),
    ),
    (LOBE_SMOOTH,),
    make_principled_thin,
    brushed=True,
    passes=True,
    mixes=("spec_trans", "spec_tint", "sheen", "sheen_tint", "flatness", "diff_trans"),
)

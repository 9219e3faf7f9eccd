"""A rough mirror of metal (Mitsuba's ``roughconductor`` with ``sample_visible``), GGX or Beckmann.

    f_s(wi, wo) cos(wo) = F(dot(wi, h)) D(h) G_1(wi) G_1(wo) / (4 cos(wi))    [WMLT07, eq. 20]

with h the half vector. For unit directions |wi + wo| is twice dot(wi, h), and h itself is never normalised.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA, make_microfacet
from warp_psdr.kernels.constants import LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.fresnel import fresnel_conductor_rgb
from warp_psdr.kernels.structs import BsdfSample, Material

#: Below it a cosine counts as zero; keeps slopes and their squares inside float32's range.
MIN_COSINE = 1.0e-7


class RoughConductor(NamedTuple):
    """Warp functions of the model; see ``BsdfFunctions`` in ``dispatch.py``."""

    eval: wp.Function
    pdf: wp.Function
    sample: wp.Function


@functools.cache
def make_rough_conductor(distribution: str) -> RoughConductor:
    """Return the functions of the rough conductor with ``distribution`` "ggx" or "beckmann"."""
    ndf, smith_over_cos, projected_area, sample_visible = make_microfacet(distribution)

    @wp.func
    def normals(h: wp.vec3, alpha_u: wp.float32, alpha_v: wp.float32) -> wp.float32:
        """Density D of microfacet normals along ``h`` (any length), 1/sr."""
        sx = h[0] / h[2]
        sy = h[1] / h[2]
        tx = sx / alpha_u
        ty = sy / alpha_v
        inv_cos2 = 1.0 + sx * sx + sy * sy
        return ndf(tx * tx + ty * ty) * inv_cos2 * inv_cos2 / (alpha_u * alpha_v)

    @wp.func
    def squared_tangent_part(w: wp.vec3, alpha_u: wp.float32, alpha_v: wp.float32) -> wp.float32:
        x = alpha_u * w[0]
        y = alpha_v * w[1]
        return x * x + y * y

    @wp.func
    def rough_conductor_eval(mat: Material, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        if wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE:
            return wp.vec3(0.0, 0.0, 0.0)
        alpha_u = wp.max(mat.s0, MIN_ALPHA)
        alpha_v = wp.max(mat.s1, MIN_ALPHA)
        h = wi + wo
        g_i = smith_over_cos(wi[2], squared_tangent_part(wi, alpha_u, alpha_v))
        g_o = smith_over_cos(wo[2], squared_tangent_part(wo, alpha_u, alpha_v))
        microfacets = 0.25 * normals(h, alpha_u, alpha_v) * g_i * g_o * wo[2]
        # 0.5 |h| <= 1 up to rounding, which the Fresnel equations tolerate.
        fresnel = fresnel_conductor_rgb(0.5 * wp.sqrt(wp.dot(h, h)), mat.c1, mat.c2)
        return wp.cw_mul(mat.c0, fresnel) * microfacets

    @wp.func
    def rough_conductor_pdf(mat: Material, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the sampled directions, solid angle: that of visible normals over 4 dot(wi, h)."""
        if wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE:
            return 0.0
        alpha_u = wp.max(mat.s0, MIN_ALPHA)
        alpha_v = wp.max(mat.s1, MIN_ALPHA)
        area = projected_area(wi[2], squared_tangent_part(wi, alpha_u, alpha_v))
        return 0.25 * normals(wi + wo, alpha_u, alpha_v) / area

    @wp.func
    def rough_conductor_sample(mat: Material, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Reflect ``wi`` at a visible microfacet normal; no sample where that points below the surface."""
        s = BsdfSample()
        s.eta = 1.0
        s.lobe = LOBE_NONE
        if wi[2] > MIN_COSINE:
            alpha_u = wp.max(mat.s0, MIN_ALPHA)
            alpha_v = wp.max(mat.s1, MIN_ALPHA)
            stretched = wp.normalize(wp.vec3(alpha_u * wi[0], alpha_v * wi[1], wi[2]))
            m = sample_visible(stretched, v)
            n = wp.normalize(wp.vec3(alpha_u * m[0], alpha_v * m[1], m[2]))
            s.wo = wp.normalize(2.0 * wp.dot(wi, n) * n - wi)
            s.pdf = rough_conductor_pdf(mat, wi, s.wo)
            if s.pdf > 0.0:
                s.value = rough_conductor_eval(mat, wi, s.wo)
                s.lobe = LOBE_SMOOTH
        return s

    return RoughConductor(rough_conductor_eval, rough_conductor_pdf, rough_conductor_sample)

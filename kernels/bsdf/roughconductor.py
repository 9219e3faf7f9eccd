"""A rough mirror of metal (Mitsuba's ``roughconductor`` with ``sample_visible``), GGX or Beckmann.

f_s(wi, wo) cos(wo) = F(dot(wi, h)) D(h) G_1(wi) G_1(wo) / (4 cos(wi)) [WMLT07, eq. 20]. The slope of h is corrected by
a second measurement, that wo - wi is normal to h, so that it keeps its digits at every angle down to alpha = 1e-5.

Derivation: ``docs/theory/materials.md#digits-of-a-rough-conductor``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA, make_microfacet
from warp_psdr.kernels.bsdf.model import Accepted, Choice, Color, ComplexIndex, Functions, Model, Roughness
from warp_psdr.kernels.constants import LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.fresnel import fresnel_conductor_rgb
from warp_psdr.kernels.structs import BsdfSample

#: Below it a cosine counts as zero; keeps slopes and their squares inside float32's range.
MIN_COSINE = 1.0e-7


@wp.func
def at_least_min(alpha: wp.float32) -> wp.float32:
    """The roughness in use. In a tie the second argument of ``max`` has the derivative: 1 at MIN_ALPHA, 0 below."""
    return wp.max(MIN_ALPHA, alpha)


@functools.cache
def make_rough_conductor(record: type, distribution: str) -> Functions:
    """Return the model's functions for ``distribution`` "ggx" or "beckmann"."""
    ndf, smith_over_cos, projected_area, sample_visible = make_microfacet(distribution)

    @wp.func
    def normals(wi: wp.vec3, wo: wp.vec3, alpha_u: wp.float32, alpha_v: wp.float32) -> wp.float32:
        """Density D of microfacet normals along the half vector, 1/sr."""
        h = wi + wo
        d = wo - wi
        sx = h[0] / h[2]
        sy = h[1] / h[2]
        r = (d[0] * sx + d[1] * sy + d[2]) / (h[2] * h[2] + d[0] * d[0] + d[1] * d[1])
        sx = sx - d[0] * r
        sy = sy - d[1] * r
        tx = sx / alpha_u
        ty = sy / alpha_v
        return ndf(tx * tx + ty * ty, 1.0 + sx * sx + sy * sy) / (alpha_u * alpha_v)

    @wp.func
    def squared_tangent_part(w: wp.vec3, alpha_u: wp.float32, alpha_v: wp.float32) -> wp.float32:
        x = alpha_u * w[0]
        y = alpha_v * w[1]
        return x * x + y * y

    @wp.func
    def rough_conductor_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        if wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE:
            return wp.vec3(0.0, 0.0, 0.0)
        alpha_u = at_least_min(mat.alpha_u)
        alpha_v = at_least_min(mat.alpha_v)
        h = wi + wo
        g_i = smith_over_cos(wi[2], squared_tangent_part(wi, alpha_u, alpha_v))
        g_o = smith_over_cos(wo[2], squared_tangent_part(wo, alpha_u, alpha_v))
        microfacets = 0.25 * normals(wi, wo, alpha_u, alpha_v) * g_i * g_o * wo[2]
        # 0.5 |h| <= 1 up to rounding, which the Fresnel equations tolerate.
        fresnel = fresnel_conductor_rgb(0.5 * wp.sqrt(wp.dot(h, h)), mat.eta, mat.k)
        return wp.cw_mul(mat.specular_reflectance, fresnel) * microfacets

    @wp.func
    def rough_conductor_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the sampled directions, solid angle: that of visible normals over 4 dot(wi, h)."""
        if wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE:
            return 0.0
        alpha_u = at_least_min(mat.alpha_u)
        alpha_v = at_least_min(mat.alpha_v)
        area = projected_area(wi[2], squared_tangent_part(wi, alpha_u, alpha_v))
        return 0.25 * normals(wi, wo, alpha_u, alpha_v) / area

    @wp.func
    def rough_conductor_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Reflect ``wi`` at a visible microfacet normal; no sample where that points below the surface."""
        s = BsdfSample()
        s.eta = 1.0
        s.lobe = LOBE_NONE
        # This and the next are for speed: without a density there is no sample.
        if wi[2] > MIN_COSINE:
            alpha_u = at_least_min(mat.alpha_u)
            alpha_v = at_least_min(mat.alpha_v)
            stretched = wp.normalize(wp.vec3(alpha_u * wi[0], alpha_v * wi[1], wi[2]))
            m = sample_visible(stretched, v)
            n = wp.normalize(wp.vec3(alpha_u * m[0], alpha_v * m[1], m[2]))
            s.wo = wp.normalize(2.0 * wp.dot(wi, n) * n - wi)
            s.pdf = rough_conductor_pdf(mat, wi, s.wo)
            if s.pdf > 0.0:
                s.value = rough_conductor_eval(mat, wi, s.wo)
                s.lobe = LOBE_SMOOTH
        return s

    @wp.func
    def slopes(mat: record) -> wp.vec2:
        return wp.vec2(at_least_min(mat.alpha_u), at_least_min(mat.alpha_v))

    return Functions(rough_conductor_sample, rough_conductor_eval, rough_conductor_pdf, slopes=slopes)


ROUGH_CONDUCTOR = Model(
    "roughconductor",
    (
        Color("specular_reflectance"),
        ComplexIndex(),
        Roughness(0.1, MIN_ALPHA),
        Choice("distribution", "beckmann", ("ggx", "beckmann")),
        Accepted("sample_visible", True, "visible normals are always sampled"),
    ),
    (LOBE_SMOOTH,),
    make_rough_conductor,
)

"""A rough mirror of metal (Mitsuba's ``roughconductor`` with ``sample_visible``), GGX or Beckmann.

f_s(wi, wo) cos(wo) = F(dot(wi, h)) D(h) G_1(wi) G_1(wo) / (4 cos(wi)) [WMLT07, eq. 20].

Derivation: ``docs/theory/materials.md#digits-of-a-rough-conductor``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA, MIN_COSINE, at_least_min, make_reflection
from warp_psdr.kernels.bsdf.model import Accepted, Choice, Color, ComplexIndex, Functions, Model, Roughness
from warp_psdr.kernels.bsdf.reflected import make_reflected_sample
from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.fresnel import fresnel_conductor_rgb


@functools.cache
def make_rough_conductor(record: type, distribution: str) -> Functions:
    """Return the model's functions for ``distribution`` "ggx" or "beckmann"."""
    reflection = make_reflection(distribution)

    @wp.func
    def rough_conductor_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        if wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE:
            return wp.vec3(0.0, 0.0, 0.0)
        h = wi + wo
        microfacets = reflection.value(wi, wo, at_least_min(mat.alpha_u), at_least_min(mat.alpha_v))
        # 0.5 |h| <= 1 up to rounding, which the Fresnel equations tolerate.
        fresnel = fresnel_conductor_rgb(0.5 * wp.sqrt(wp.dot(h, h)), mat.eta, mat.k)
        return wp.cw_mul(mat.specular_reflectance, fresnel) * microfacets

    @wp.func
    def rough_conductor_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the sampled directions, solid angle: that of visible normals over 4 dot(wi, h)."""
        if wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE:
            return 0.0
        return reflection.pdf(wi, wo, at_least_min(mat.alpha_u), at_least_min(mat.alpha_v))

    @wp.func
    def draw(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> wp.vec3:
        """Reflect ``wi`` at a visible microfacet normal."""
        return reflection.sample(wi, at_least_min(mat.alpha_u), at_least_min(mat.alpha_v), v)

    @wp.func
    def slopes(mat: record) -> wp.vec2:
        return wp.vec2(at_least_min(mat.alpha_u), at_least_min(mat.alpha_v))

    rough_conductor_sample = make_reflected_sample(record, draw, rough_conductor_eval, rough_conductor_pdf)
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

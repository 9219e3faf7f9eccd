"""A rough mirror of metal (Mitsuba's ``roughconductor`` with ``sample_visible``), GGX or Beckmann.

f_s(wi, wo) cos(wo) = F(dot(wi, h)) D(h) G_1(wi) G_1(wo) / (4 cos(wi)) [WMLT07, eq. 20].

Derivation: ``docs/theory/materials.md#digits-of-a-rough-conductor``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA, MIN_COSINE, at_least_min, make_reflection, or_upright
from warp_psdr.kernels.bsdf.model import Accepted, Choice, Color, ComplexIndex, Functions, Model, Roughness
from warp_psdr.kernels.bsdf.reflected import make_reflected_sample
from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.fresnel import fresnel_conductor_rgb
from warp_psdr.kernels.math import where3


@functools.cache
def make_rough_conductor(record: type, distribution: str) -> Functions:
    """Return the model's functions for ``distribution`` "ggx" or "beckmann"."""
    reflection = make_reflection(distribution)

    @wp.func
    def rough_conductor_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        above = not (wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE)
        i = or_upright(above, wi)
        o = or_upright(above, wo)
        h = i + o
        microfacets = reflection.value(i, o, at_least_min(mat.alpha_u), at_least_min(mat.alpha_v))
        # 0.5 |h| <= 1 up to rounding, which the Fresnel equations tolerate.
        fresnel = fresnel_conductor_rgb(0.5 * wp.sqrt(wp.dot(h, h)), mat.eta, mat.k)
        value = wp.cw_mul(mat.specular_reflectance, fresnel) * microfacets
        return where3(above, value, wp.vec3(0.0, 0.0, 0.0))

    @wp.func
    def rough_conductor_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the sampled directions, solid angle: that of visible normals over 4 dot(wi, h)."""
        above = not (wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE)
        i = or_upright(above, wi)
        density = reflection.pdf(i, or_upright(above, wo), at_least_min(mat.alpha_u), at_least_min(mat.alpha_v))
        return wp.where(above, density, 0.0)

    @wp.func
    def draw(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> wp.vec3:
        """Reflect ``wi`` at a visible microfacet normal."""
        return reflection.sample(wi, at_least_min(mat.alpha_u), at_least_min(mat.alpha_v), v)

    @wp.func
    def slopes(mat: record) -> wp.vec2:
        return wp.vec2(at_least_min(mat.alpha_u), at_least_min(mat.alpha_v))

    rough_conductor_sample = make_reflected_sample(record, draw, rough_conductor_eval, rough_conductor_pdf)
    return Functions(
        rough_conductor_sample, rough_conductor_eval, rough_conductor_pdf, slopes=slopes, branches=distribution != "ggx"
    )


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
    glossy=True,
)

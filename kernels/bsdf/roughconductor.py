"""A rough mirror of metal (Mitsuba's ``roughconductor`` with ``sample_visible``), GGX or Beckmann.

f_s(wi, wo) cos(wo) = F(dot(wi, h)) D(h) G_1(wi) G_1(wo) / (4 cos(wi)) [WMLT07, eq. 20].

Derivation: ``docs/theory/materials.md#digits-of-a-rough-conductor``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.decomposition import ACROSS, Split, make_decomposition
from warp_psdr.kernels.bsdf.microfacet import (
    MIN_ALPHA,
    MIN_COSINE,
    at_least_min,
    half_slope,
    make_reflection,
    or_upright,
)
from warp_psdr.kernels.bsdf.model import Accepted, Choice, Color, ComplexIndex, Functions, Model, Roughness
from warp_psdr.kernels.bsdf.reflected import make_reflected_sample
from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.fresnel import fresnel_conductor_rgb
from warp_psdr.kernels.math import unit_vector, where3


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

    lobes = make_decomposition(distribution)

    @wp.func
    def split_draw(mat: record, wi: wp.vec3, axis: wp.int32, outer: wp.bool, u: wp.vec3) -> wp.vec3:
        s = lobes.draw(axis, outer, u)
        h = unit_vector(wp.vec3(at_least_min(mat.alpha_u) * s[0], at_least_min(mat.alpha_v) * s[1], 1.0))
        c = wp.dot(wi, h)
        return where3(c > 0.0, unit_vector(2.0 * c * h - wi), wp.vec3(0.0, 0.0, -1.0))

    @wp.func
    def split_density(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        h = wi + wo
        d = reflection.normals(wi, wo, at_least_min(mat.alpha_u), at_least_min(mat.alpha_v))
        return 0.5 * d * h[2] / wp.dot(h, h)

    @wp.func
    def split_mass(mat: record, axis: wp.int32) -> wp.float32:
        return lobes.mass(axis) / at_least_min(wp.where(axis == ACROSS, mat.alpha_v, mat.alpha_u))

    @wp.func
    def split_rate(mat: record, wi: wp.vec3, wo: wp.vec3, axis: wp.int32) -> wp.float32:
        s = half_slope(wi, wo)
        u = at_least_min(mat.alpha_u)
        v = at_least_min(mat.alpha_v)
        return lobes.rate(s[0] / u, s[1] / v, axis) / wp.where(axis == ACROSS, v, u)

    rough_conductor_sample = make_reflected_sample(record, draw, rough_conductor_eval, rough_conductor_pdf)
    return Functions(
        rough_conductor_sample,
        rough_conductor_eval,
        rough_conductor_pdf,
        slopes=slopes,
        split=Split(split_draw, split_density, rough_conductor_eval, split_mass, split_rate),
        branches=False,
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
    splits=("alpha_u", "alpha_v"),
    masked=True,
)

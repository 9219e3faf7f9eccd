"""A rough interface between two transparent media (Mitsuba's ``roughdielectric``): smooth lobes on both sides.

With ``eta`` the index on the other side over that on the side of ``wi``, F the reflectance of a smooth interface, and h
the half vector of the reflection or of the refraction, turned to the side of ``wi``,

    f_s cos(wo) = specular_reflectance F D(h) G_1(wi) G_1(wo) / (4 cos(wi))                             (reflected),
    f_s cos(wo) = specular_transmittance (1 - F) D(h) G_1(wi) G_1(wo) <wi, h> |<wo, h>|
                  / (cos(wi) |wi + eta wo|^2)                                                         (transmitted)

[WMLT07, eq. 20 and 21]. In the second, the squared eta of the half vector's Jacobian cancels the one that scales
radiance at the interface. Value and density are 0 if a direction lies on the wrong side of the half vector.

Derivation: ``docs/theory/materials.md#rough-glass``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.microfacet import (
    MIN_ALPHA,
    MIN_COSINE,
    at_least_min,
    make_rough_interface,
    make_visible_normal,
    or_upright,
)
from warp_psdr.kernels.bsdf.model import Accepted, Choice, Color, Functions, Model, RelativeIndex, Roughness
from warp_psdr.kernels.constants import LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.fresnel import (
    coat_reflectance,
    coat_transmittance,
    fresnel_dielectric,
    index_behind,
    refracted_cosine,
)
from warp_psdr.kernels.math import refract_at, unit_vector, where3, where_number
from warp_psdr.kernels.structs import BsdfSample

#: How far from 1 the ratio of indices has to be: nearer, the half vector is a difference of nearly equal vectors.
MIN_GAP = 1.0e-3


@wp.struct
class InterfacePair:
    """Two directions at a rough interface, ``wi`` above."""

    wi: wp.vec3
    wo: wp.vec3
    eta: wp.float32  # index below over that above
    share: wp.float32  # reflectance or transmittance
    shown: wp.int32  # 1: there are normals between them


@wp.func
def turned(w: wp.vec3, up: wp.float32) -> wp.vec3:
    """``w``, mirrored at the surface if ``up`` is -1: the distribution of normals is the same on both sides."""
    return wp.vec3(w[0], w[1], up * w[2])


@functools.cache
def make_rough_dielectric(record: type, distribution: str) -> Functions:
    """Return the model's functions for ``distribution`` "ggx" or "beckmann"."""
    interface = make_rough_interface(distribution)
    visible_normal = make_visible_normal(distribution)

    @wp.func
    def at_interface(mat: record, wi: wp.vec3, wo: wp.vec3) -> InterfacePair:
        """Both directions with ``wi`` turned up; a pair without a half vector is one that goes straight back."""
        pair = InterfacePair()
        up = where_number(wi[2] < 0.0, -1.0, 1.0)
        i = turned(wi, up)
        o = turned(wo, up)
        pair.eta = index_behind(mat.ior, wi[2])
        aside = not (i[2] <= MIN_COSINE or wp.abs(o[2]) <= MIN_COSINE)
        i = or_upright(aside, i)
        o = or_upright(aside, o)
        c = interface.cosine(i, o, pair.eta)
        shown = aside and c > 0.0
        pair.shown = wp.where(shown, 1, 0)
        pair.wi = or_upright(shown, i)
        pair.wo = or_upright(shown, o)
        # At grazing angles parts of the share that is not selected are infinite, and their adjoints no numbers.
        above = pair.wo[2] > 0.0
        reflectance = coat_reflectance(where_number(shown and above, c, 1.0), pair.eta)
        transmittance = coat_transmittance(where_number(above, 1.0, c), pair.eta)
        pair.share = where_number(above, reflectance, transmittance)
        return pair

    @wp.func
    def rough_dielectric_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        pair = at_interface(mat, wi, wo)
        alpha_u = at_least_min(mat.alpha_u)
        alpha_v = at_least_min(mat.alpha_v)
        scale = pair.share * interface.value(pair.wi, pair.wo, pair.eta, alpha_u, alpha_v)
        color = where3(pair.wo[2] > 0.0, mat.specular_reflectance, mat.specular_transmittance)
        return where3(pair.shown == 1, scale * color, wp.vec3(0.0, 0.0, 0.0))

    @wp.func
    def rough_dielectric_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the sampled directions on both sides, solid angle."""
        pair = at_interface(mat, wi, wo)
        alpha_u = at_least_min(mat.alpha_u)
        alpha_v = at_least_min(mat.alpha_v)
        density = pair.share * interface.pdf(pair.wi, pair.wo, pair.eta, alpha_u, alpha_v)
        return where_number(pair.shown == 1, density, 0.0)

    @wp.func
    def rough_dielectric_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Reflect or refract ``wi`` at a visible normal, by its reflectance; none that ends on the wrong side."""
        aside = not wp.abs(wi[2]) <= MIN_COSINE
        up = where_number(wi[2] < 0.0, -1.0, 1.0)
        i = or_upright(aside, turned(wi, up))
        eta = index_behind(mat.ior, wi[2])
        n = visible_normal(i, at_least_min(mat.alpha_u), at_least_min(mat.alpha_v), v)
        c = wp.dot(i, n)
        g = refracted_cosine(c, eta)
        reflected = u < fresnel_dielectric(c, g, eta)
        o = where3(reflected, 2.0 * c * n - i, refract_at(i, n, c, g, eta))
        right = aside and c > 0.0 and o[2] * where_number(reflected, 1.0, -1.0) > 0.0
        s = BsdfSample()
        s.eta = where_number(reflected, 1.0, eta)
        s.wo = where3(right, turned(unit_vector(o), up), wp.vec3(0.0, 0.0, 0.0))
        s.pdf = where_number(right, rough_dielectric_pdf(mat, wi, s.wo), 0.0)
        drawn = s.pdf > 0.0
        s.value = where3(drawn, rough_dielectric_eval(mat, wi, s.wo), wp.vec3(0.0, 0.0, 0.0))
        s.lobe = wp.where(drawn, LOBE_SMOOTH, LOBE_NONE)
        return s

    @wp.func
    def rough_dielectric_relative_eta(mat: record, wi: wp.vec3) -> wp.float32:
        return index_behind(mat.ior, wi[2])

    return Functions(
        rough_dielectric_sample,
        rough_dielectric_eval,
        rough_dielectric_pdf,
        relative_eta=rough_dielectric_relative_eta,
        branches=False,
    )


ROUGH_DIELECTRIC = Model(
    "roughdielectric",
    (
        Color("specular_reflectance"),
        Color("specular_transmittance"),
        RelativeIndex("bk7", gap=MIN_GAP),
        Roughness(0.1, MIN_ALPHA),
        Choice("distribution", "beckmann", ("ggx", "beckmann")),
        Accepted("sample_visible", True, "visible normals are always sampled"),
    ),
    (LOBE_SMOOTH,),
    make_rough_dielectric,
    passes=True,
    glossy=True,
)

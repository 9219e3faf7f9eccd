"""A rough interface between two transparent media (Mitsuba's ``roughdielectric``): smooth lobes on both sides.

With ``eta`` the index on the other side over that on the side of ``wi``, F the reflectance of a smooth interface, and h
the half vector of the reflection or of the refraction, turned to the side of ``wi``,

    f_s cos(wo) = specular_reflectance F D(h) G_1(wi) G_1(wo) / (4 cos(wi))                             (reflected),
    f_s cos(wo) = specular_transmittance (1 - F) D(h) G_1(wi) G_1(wo) <wi, h> |<wo, h>|
                  / (cos(wi) |wi + eta wo|^2)                                                         (transmitted)

[WMLT07, eq. 20 and 21]; in the second the squared eta of the half vector's Jacobian meets that by which radiance is
scaled where it crosses the interface. Half vectors of which a direction lies on the wrong side have value and density
0.

Derivation: ``docs/theory/materials.md#rough-glass``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.microfacet import (
    MIN_ALPHA,
    MIN_COSINE,
    at_least_min,
    make_reflection,
    make_refraction,
    make_visible_normal,
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
from warp_psdr.kernels.math import refract_at
from warp_psdr.kernels.structs import BsdfSample

#: How far from 1 the ratio of indices has to be: nearer, the half vector is a difference of nearly equal vectors.
MIN_GAP = 1.0e-3


@wp.func
def turned(w: wp.vec3, up: wp.float32) -> wp.vec3:
    """``w``, mirrored at the surface if ``up`` is -1: the distribution of normals is the same on both sides."""
    return wp.vec3(w[0], w[1], up * w[2])


@functools.cache
def make_rough_dielectric(record: type, distribution: str) -> Functions:
    """Return the model's functions for ``distribution`` "ggx" or "beckmann"."""
    reflection = make_reflection(distribution)
    refraction = make_refraction(distribution)
    visible_normal = make_visible_normal(distribution)

    @wp.func
    def rough_dielectric_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        if wp.abs(wi[2]) <= MIN_COSINE or wp.abs(wo[2]) <= MIN_COSINE:
            return wp.vec3(0.0, 0.0, 0.0)
        up = wp.where(wi[2] < 0.0, -1.0, 1.0)
        i = turned(wi, up)
        o = turned(wo, up)
        eta = index_behind(mat.ior, wi[2])
        alpha_u = at_least_min(mat.alpha_u)
        alpha_v = at_least_min(mat.alpha_v)
        if o[2] > 0.0:
            h = i + o
            fresnel = coat_reflectance(0.5 * wp.sqrt(wp.dot(h, h)), eta)
            return (fresnel * reflection.value(i, o, alpha_u, alpha_v)) * mat.specular_reflectance
        c = refraction.cosine(i, o, eta)
        if c <= 0.0:
            return wp.vec3(0.0, 0.0, 0.0)
        through = coat_transmittance(c, eta) * refraction.value(i, o, eta, alpha_u, alpha_v)
        return through * mat.specular_transmittance

    @wp.func
    def rough_dielectric_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the sampled directions on both sides, solid angle."""
        if wp.abs(wi[2]) <= MIN_COSINE or wp.abs(wo[2]) <= MIN_COSINE:
            return 0.0
        up = wp.where(wi[2] < 0.0, -1.0, 1.0)
        i = turned(wi, up)
        o = turned(wo, up)
        eta = index_behind(mat.ior, wi[2])
        alpha_u = at_least_min(mat.alpha_u)
        alpha_v = at_least_min(mat.alpha_v)
        if o[2] > 0.0:
            h = i + o
            return coat_reflectance(0.5 * wp.sqrt(wp.dot(h, h)), eta) * reflection.pdf(i, o, alpha_u, alpha_v)
        c = refraction.cosine(i, o, eta)
        if c <= 0.0:
            return 0.0
        return coat_transmittance(c, eta) * refraction.pdf(i, o, eta, alpha_u, alpha_v)

    @wp.func
    def rough_dielectric_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Reflect or refract ``wi`` at a visible normal, by its reflectance; none that ends on the wrong side."""
        s = BsdfSample()
        s.eta = 1.0
        s.lobe = LOBE_NONE
        if wp.abs(wi[2]) > MIN_COSINE:
            up = wp.where(wi[2] < 0.0, -1.0, 1.0)
            i = turned(wi, up)
            eta = index_behind(mat.ior, wi[2])
            n = visible_normal(i, at_least_min(mat.alpha_u), at_least_min(mat.alpha_v), v)
            c = wp.dot(i, n)
            g = refracted_cosine(c, eta)
            o = 2.0 * c * n - i
            right = wp.bool(True)
            if u < fresnel_dielectric(c, g, eta):
                right = o[2] > 0.0
            else:
                o = refract_at(i, n, c, g, eta)
                s.eta = eta
                right = o[2] < 0.0
            if right and c > 0.0:
                s.wo = turned(wp.normalize(o), up)
                s.pdf = rough_dielectric_pdf(mat, wi, s.wo)
                if s.pdf > 0.0:
                    s.value = rough_dielectric_eval(mat, wi, s.wo)
                    s.lobe = LOBE_SMOOTH
        return s

    @wp.func
    def rough_dielectric_relative_eta(mat: record, wi: wp.vec3) -> wp.float32:
        return index_behind(mat.ior, wi[2])

    return Functions(
        rough_dielectric_sample,
        rough_dielectric_eval,
        rough_dielectric_pdf,
        relative_eta=rough_dielectric_relative_eta,
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

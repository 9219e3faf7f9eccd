"""A diffuse base under a rough dielectric coat (Mitsuba's ``roughplastic``): two smooth lobes.

With the coat's microfacet lobe, of a dielectric's reflectance F, its transmittance T and the reflectance R that light
from the base meets at it from below,

    f_s(wi, wo) = specular_reflectance F(<wi, h>) D(h) G_1(wi) G_1(wo) / (4 cos(wi) cos(wo))
                + rho / (1 - rho R) T(wi) T(wo) / (pi eta^2)                          (nonlinear; else 1 - R).

T and R depend on alpha and eta. The host tabulates them with their derivatives at the values alpha_0 and eta_0 of the
last update (``warp_psdr/scene/materials/rough_transmittance.py``); here they are T + (alpha - alpha_0) dT/dalpha + (eta
- eta_0) dT/deta, whose differences are 0 and whose derivatives are those of the table.

Derivation: ``docs/theory/materials.md#rough-plastic``; by the index, whose F and T weigh the two lobes,
``docs/theory/interior.md#lobes-of-one-sign``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.decomposition import SignedLobes
from warp_psdr.kernels.bsdf.diffuse import diffuse_pdf
from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA, MIN_COSINE, at_least_min, make_reflection, or_upright
from warp_psdr.kernels.bsdf.model import (
    Accepted,
    Choice,
    Color,
    Flag,
    Functions,
    Model,
    RelativeIndex,
    Table,
    UniformRoughness,
    table_entry,
)
from warp_psdr.kernels.bsdf.plastic import share_of_coat
from warp_psdr.kernels.bsdf.reflected import make_reflected_sample
from warp_psdr.kernels.constants import INV_PI, LOBE_SMOOTH
from warp_psdr.kernels.fresnel import coat_reflectance, coat_reflectance_by_index
from warp_psdr.kernels.math import where3, where_number
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere

#: Cosines at which the transmittance is tabulated, 0 to 1.
RESOLUTION = 64
#: The table holds rows of three: (alpha_0, eta_0, -), then (value, derivative by alpha, derivative by eta) of R and of
#: T at every cosine. Where the rows of T begin, and its size:
HEADER = 6
TABLE_SIZE = HEADER + 3 * RESOLUTION
#: Least slope of the lobe that edges are sampled by: a narrower one would stand alone, without that of the base.
WIDE_SLOPE = 0.11


@wp.func
def entry_near(table: wp.uint64, index: wp.int32, alpha: wp.float32, ior: wp.float32) -> wp.float32:
    """A value of the table, to first order about where it was computed."""
    from_alpha = alpha - table_entry(table, 0)
    from_ior = ior - table_entry(table, 1)
    at = table_entry(table, index)
    return at + from_alpha * table_entry(table, index + 1) + from_ior * table_entry(table, index + 2)


@wp.func
def rough_through(table: wp.uint64, c: wp.float32, alpha: wp.float32, ior: wp.float32) -> wp.float32:
    """Transmittance T of the coat at the cosine ``c``; linear between those of the table."""
    x = c * wp.static(float(RESOLUTION - 1))
    # At least 0 also for what is not a number: lanes without a vertex hold anything.
    i = wp.clamp(wp.int32(x), 0, wp.static(RESOLUTION - 2))
    f = x - wp.float32(i)
    low = entry_near(table, HEADER + 3 * i, alpha, ior)
    high = entry_near(table, HEADER + 3 * i + 3, alpha, ior)
    return (1.0 - f) * low + f * high


@wp.func
def rough_through_by_index(table: wp.uint64, c: wp.float32) -> wp.float32:
    """dT/deta at the cosine ``c``; linear between those of the table, as T is."""
    x = c * wp.static(float(RESOLUTION - 1))
    i = wp.clamp(wp.int32(x), 0, wp.static(RESOLUTION - 2))
    f = x - wp.float32(i)
    first = HEADER + 3 * i + 2
    return (1.0 - f) * table_entry(table, first) + f * table_entry(table, first + 3)


@functools.cache
def make_rough_plastic(record: type, variant: str) -> Functions:
    """Return the model's functions; ``variant``: the distribution, and "nonlinear" as for ``plastic``."""
    distribution, *flags = variant.split()
    nonlinear = "nonlinear" in flags
    reflection = make_reflection(distribution)

    @wp.func
    def rough_share(mat: record, wi: wp.vec3) -> wp.float32:
        """Probability of the coat's lobe."""
        through = rough_through(mat.transmittance, wi[2], mat.alpha, mat.ior)
        reflectance = wp.clamp(1.0 - through, 0.0, 1.0)
        return share_of_coat(mat.specular_reflectance, mat.diffuse_reflectance, reflectance)

    @wp.func
    def rough_plastic_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        above = not (wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE)
        i = or_upright(above, wi)
        o = or_upright(above, wo)
        alpha = at_least_min(mat.alpha)
        h = i + o
        fresnel = coat_reflectance(0.5 * wp.sqrt(wp.dot(h, h)), mat.ior)
        coat = (fresnel * reflection.value(i, o, alpha, alpha)) * mat.specular_reflectance
        table = mat.transmittance
        inside = entry_near(table, 3, mat.alpha, mat.ior)
        rho = mat.diffuse_reflectance
        through = rough_through(table, i[2], mat.alpha, mat.ior) * rough_through(table, o[2], mat.alpha, mat.ior)
        scale = INV_PI * o[2] * through / (mat.ior * mat.ior)
        if wp.static(nonlinear):
            base = scale * wp.vec3(
                rho[0] / (1.0 - rho[0] * inside), rho[1] / (1.0 - rho[1] * inside), rho[2] / (1.0 - rho[2] * inside)
            )
        else:
            base = (scale / (1.0 - inside)) * rho
        return where3(above, coat + base, wp.vec3(0.0, 0.0, 0.0))

    @wp.func
    def rough_plastic_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the sampled directions, solid angle."""
        above = not (wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE)
        i = or_upright(above, wi)
        o = or_upright(above, wo)
        alpha = at_least_min(mat.alpha)
        share = rough_share(mat, i)
        density = share * reflection.pdf(i, o, alpha, alpha) + (1.0 - share) * diffuse_pdf(i, o)
        return where_number(above, density, 0.0)

    @wp.func
    def draw(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> wp.vec3:
        """Choose the coat or the base by ``u``, and a direction by ``v``."""
        alpha = at_least_min(mat.alpha)
        coat = u < rough_share(mat, wi)
        return where3(coat, reflection.sample(wi, alpha, alpha, v), square_to_cosine_hemisphere(v))

    @wp.func
    def slopes(mat: record) -> wp.vec2:
        wide = wp.max(mat.alpha, WIDE_SLOPE)
        return wp.vec2(wide, wide)

    @wp.func
    def signed_plastic_draw(mat: record, wi: wp.vec3, number: wp.int32, second: wp.bool, u: wp.vec2) -> wp.vec3:
        """A direction of the coat (first) or of the base (second)."""
        alpha = at_least_min(mat.alpha)
        wo = square_to_cosine_hemisphere(u)
        if not second:
            wo = reflection.sample(or_upright(wi[2] > MIN_COSINE, wi), alpha, alpha, u)
        return wo

    @wp.func
    def signed_plastic_weight(mat: record, wi: wp.vec3, wo: wp.vec3, number: wp.int32, second: wp.bool) -> wp.vec3:
        """That lobe's derivative by the index over its density."""
        table = mat.transmittance
        ior = mat.ior
        rho = mat.diffuse_reflectance
        weight = wp.vec3(0.0, 0.0, 0.0)
        if second:
            inside = entry_near(table, 3, mat.alpha, ior)
            inside_dot = table_entry(table, 5)
            t_i = rough_through(table, wi[2], mat.alpha, ior)
            t_o = rough_through(table, wo[2], mat.alpha, ior)
            through = t_i * t_o
            through_dot = rough_through_by_index(table, wi[2]) * t_o + t_i * rough_through_by_index(table, wo[2])
            through_dot -= 2.0 * through / ior
            for channel in range(3):
                # 1 / (1 - again R), and its derivative.
                again = wp.float32(1.0)
                if wp.static(nonlinear):
                    again = rho[channel]
                kept = 1.0 / (1.0 - again * inside)
                weight[channel] = (
                    rho[channel] * kept * (through_dot + through * kept * again * inside_dot) / (ior * ior)
                )
        else:
            alpha = at_least_min(mat.alpha)
            pdf = reflection.pdf(wi, wo, alpha, alpha)
            if pdf > 0.0:
                h = wi + wo
                fresnel_dot = coat_reflectance_by_index(0.5 * wp.sqrt(wp.dot(h, h)), ior)
                weight = (fresnel_dot * reflection.value(wi, wo, alpha, alpha) / pdf) * mat.specular_reflectance
        return weight

    rough_plastic_sample = make_reflected_sample(record, draw, rough_plastic_eval, rough_plastic_pdf)
    signed = SignedLobes(signed_plastic_draw, signed_plastic_weight)
    return Functions(
        rough_plastic_sample, rough_plastic_eval, rough_plastic_pdf, slopes=slopes, signed=signed, branches=False
    )


ROUGH_PLASTIC = Model(
    "roughplastic",
    (
        Color("diffuse_reflectance", 0.5),
        Color("specular_reflectance"),
        UniformRoughness(0.1, MIN_ALPHA),
        RelativeIndex("polypropylene", gap=0.0),
        Table("transmittance", TABLE_SIZE, ("alpha", "ior")),
        Choice("distribution", "beckmann", ("ggx", "beckmann")),
        Flag("nonlinear"),
        Accepted("sample_visible", True, "visible normals are always sampled"),
    ),
    (LOBE_SMOOTH,),
    make_rough_plastic,
    glossy=True,
    signed=("ior",),
)

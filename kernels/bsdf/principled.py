"""Disney's material for artists (Mitsuba's ``principled``): a diffuse base, sheen, a main and a clear coat.

With the half vector h, c = <wi, h> and the Schlick weight S(x) = (1 - x)^5 [Burley 2012],

    f_s = (1 - metallic) (base_color / pi ((1 - flatness) (f_d + f_retro) + flatness f_ss) + sheen S(c) C_sheen)
        + F D G / (4 cos(wi) cos(wo)) + clearcoat / 4 (0.04 + 0.96 S(c)) D_1 G_1/4,

where F mixes the reflectances of a dielectric, of a tinted one and of a metal, D is GGX's density of normals and D_1
that of GTR1, whose tails are longer. All lobes are compiled whatever their weights are, so that a lobe with weight 0
has its derivative, too. Formulas and the choice of lobes: ``docs/theory/materials.md#principled``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.diffuse import diffuse_pdf
from warp_psdr.kernels.bsdf.microfacet import (
    MIN_COSINE,
    half_slope,
    make_microfacet,
    make_reflection,
    make_rough_interface,
    make_visible_normal,
    or_upright,
    squared_tangent_part,
)
from warp_psdr.kernels.bsdf.model import Color, Functions, Model, Number, Rate, SpecularIndex
from warp_psdr.kernels.bsdf.plastic import MIN_SHARE
from warp_psdr.kernels.bsdf.reflected import make_reflected_sample
from warp_psdr.kernels.bsdf.roughdielectric import MIN_GAP, turned
from warp_psdr.kernels.bsdf.roughplastic import WIDE_SLOPE
from warp_psdr.kernels.constants import INV_PI, LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.exponentials import exponential, logarithm, smooth_logarithm
from warp_psdr.kernels.fresnel import coat_reflectance, coat_transmittance, index_behind, refracted_cosine
from warp_psdr.kernels.math import at_least, clamp_unit, refract_at, unit_vector, where3, where_number
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere, unit_circle
from warp_psdr.kernels.structs import BsdfSample

#: Least slope of the main lobe.
MIN_ROUGH_ALPHA = 1.0e-3
#: Slopes of the clear coat at gloss 0 and 1, and the slope of its masking.
DULL_COAT, GLOSSY_COAT, COAT_MASKING = 0.1, 1.0e-3, 0.25
#: Reflectance of the clear coat at normal incidence.
COAT_REFLECTANCE = 0.04
#: Added to the base colour and to its luminance before they are divided: a black base has the tint 1, as in Mitsuba,
#: and a derivative.
TINT_BLACK = 1.0e-5
#: Added to 0.08 ``specular``, whose root has no derivative at 0.
MIN_NORMAL_REFLECTANCE = 1.0e-7
#: Luminance of linear sRGB.
RED, GREEN, BLUE = 0.212671, 0.715160, 0.072169


@wp.func
def schlick_weight(c: wp.float32) -> wp.float32:
    m = clamp_unit(1.0 - c)
    m2 = m * m
    return m2 * m2 * m


@wp.func
def schlick_of_index(c: wp.float32, eta: wp.float32) -> wp.float32:
    """Schlick's weight at the cosine ``c``; in front of a thinner medium that of the refracted ray."""
    refracted = refracted_cosine(c, eta) / eta
    return schlick_weight(where_number(eta > 1.0, c, refracted))


@wp.func
def tint_of(color: wp.vec3) -> wp.vec3:
    """The colour at luminance 1."""
    y = RED * color[0] + GREEN * color[1] + BLUE * color[2]
    black = wp.vec3(TINT_BLACK, TINT_BLACK, TINT_BLACK)
    return (color + black) / (y + TINT_BLACK)


@wp.func
def principled_index(ior: wp.float32, specular: wp.float32) -> wp.float32:
    """Index of refraction: ``ior``, or where that is 0, the one that reflects 0.08 ``specular`` at normal incidence."""
    root = wp.sqrt(0.08 * clamp_unit(specular) + MIN_NORMAL_REFLECTANCE)
    return where_number(ior > 0.0, ior, (1.0 + root) / (1.0 - root))


@wp.func
def aspect_of(anisotropic: wp.float32) -> wp.float32:
    return wp.sqrt(1.0 - 0.9 * clamp_unit(anisotropic))


@wp.func
def alpha_along(r: wp.float32, anisotropic: wp.float32) -> wp.float32:
    """Slope along the first tangent at a roughness of any size; by itself, for a ``vec2`` keeps loops from SIMD."""
    return at_least(MIN_ROUGH_ALPHA, r * r / aspect_of(anisotropic))


@wp.func
def alpha_across(r: wp.float32, anisotropic: wp.float32) -> wp.float32:
    return at_least(MIN_ROUGH_ALPHA, r * r * aspect_of(anisotropic))


@wp.func
def stretched_alphas(r: wp.float32, anisotropic: wp.float32) -> wp.vec2:
    """Slopes along the tangents at a roughness of any size."""
    return wp.vec2(alpha_along(r, anisotropic), alpha_across(r, anisotropic))


@wp.func
def principled_alphas(roughness: wp.float32, anisotropic: wp.float32) -> wp.vec2:
    """Slopes of the main lobe along the tangents."""
    return stretched_alphas(clamp_unit(roughness), anisotropic)


@wp.func
def coat_slope(gloss: wp.float32) -> wp.float32:
    g = clamp_unit(gloss)
    return DULL_COAT + (GLOSSY_COAT - DULL_COAT) * g


@wp.func
def coat_normals(wi: wp.vec3, wo: wp.vec3, a: wp.float32) -> wp.float32:
    """Density D_1 of normals of the clear coat (GTR1) along the half vector, 1/sr, in squared slopes s^2.

    D_1 = (1 - a^2) (1 + s^2) / (-pi ln(a^2) (a^2 + s^2)), in which nothing cancels at small ``a``.
    """
    s = half_slope(wi, wo)
    s2 = wp.dot(s, s)
    a2 = a * a
    return (INV_PI * (a2 - 1.0) / smooth_logarithm(a2)) * ((1.0 + s2) / (a2 + s2))


@wp.func
def coat_sample(wi: wp.vec3, a: wp.float32, v: wp.vec2) -> wp.vec3:
    """``wi`` reflected at a normal drawn with the density D_1 cos; it may point below. A unit vector up to rounding."""
    length = -2.0 * logarithm(a)
    s2 = a * a * (exponential(length * v[1]) - 1.0) / (1.0 - exponential(length * (v[1] - 1.0)))
    slope = wp.sqrt(wp.max(s2, 0.0))
    around = unit_circle(v[0])
    n = unit_vector(wp.vec3(slope * around[0], slope * around[1], 1.0))
    return 2.0 * wp.dot(wi, n) * n - wi


@wp.func
def base_scattering(
    roughness: wp.float32, flatness: wp.float32, ci: wp.float32, co: wp.float32, c: wp.float32
) -> wp.float32:
    """Scattering of the diffuse base times pi: diffuse and retro-reflected light, or, flat, what lies under a skin."""
    si = schlick_weight(ci)
    so = schlick_weight(co)
    retro = 2.0 * clamp_unit(roughness) * c * c
    rough = (1.0 - 0.5 * si) * (1.0 - 0.5 * so) + retro * (so + si + so * si * (retro - 1.0))
    f90 = 0.5 * retro - 1.0
    under = 1.25 * ((1.0 + f90 * so) * (1.0 + f90 * si) * (1.0 / (co + ci) - 0.5) + 0.5)
    return rough + clamp_unit(flatness) * (under - rough)


@wp.func
def tinted_reflectance(tint: wp.vec3, eta: wp.float32, schlick: wp.float32) -> wp.vec3:
    """Schlick's reflectance of a dielectric with a tint at normal incidence."""
    white = wp.vec3(1.0, 1.0, 1.0)
    r = (eta - 1.0) / (eta + 1.0)
    normal = (r * r) * tint
    return normal + schlick * (white - normal)


@wp.func
def sheen_color(base: wp.vec3, sheen: wp.float32, sheen_tint: wp.float32, c: wp.float32) -> wp.vec3:
    """Light that fibres at grazing angles add, without the cosine."""
    white = wp.vec3(1.0, 1.0, 1.0)
    color = white + clamp_unit(sheen_tint) * (tint_of(base) - white)
    return (clamp_unit(sheen) * schlick_weight(c)) * color


@wp.func
def root_of(color: wp.vec3) -> wp.vec3:
    """The root of a colour, 0 with a derivative at 0."""
    return wp.vec3(
        color[0] / wp.sqrt(color[0] + TINT_BLACK),
        color[1] / wp.sqrt(color[1] + TINT_BLACK),
        color[2] / wp.sqrt(color[2] + TINT_BLACK),
    )


@functools.cache
def make_principled(record: type, variant: str) -> Functions:
    """Return the model's functions; ``variant`` "spec_trans": light passes the surface."""
    transmits = variant == "spec_trans"
    reflection = make_reflection("ggx")
    interface = make_rough_interface("ggx")
    visible_normal = make_visible_normal("ggx")
    smith_over_cos = make_microfacet("ggx").smith_over_cos

    @wp.func
    def transmitted_share(mat: record) -> wp.float32:
        """Share of what is not metal that lets light through."""
        share = wp.float32(0.0)
        if wp.static(transmits):
            share = clamp_unit(mat.spec_trans)
        return share

    @wp.func
    def principled_fresnel(mat: record, c: wp.float32, eta: wp.float32, schlick: wp.float32) -> wp.vec3:
        """Reflectance of the main lobe: (1 - metallic) (dielectric, by ``spec_tint`` tinted) + metallic."""
        metallic = clamp_unit(mat.metallic)
        tinted = clamp_unit(mat.spec_tint)
        base = mat.base_color
        white = wp.vec3(1.0, 1.0, 1.0)
        dielectric = coat_reflectance(c, eta) * white
        tint = tinted_reflectance(tint_of(base), eta, schlick)
        metal = base + schlick * (white - base)
        return (1.0 - metallic) * (dielectric + tinted * (tint - dielectric)) + metallic * metal

    @wp.func
    def front_value(mat: record, wi: wp.vec3, wo: wp.vec3, eta: wp.float32) -> wp.vec3:
        """What is reflected on the upper side."""
        r = clamp_unit(mat.roughness)
        alpha_u = alpha_along(r, mat.anisotropic)
        alpha_v = alpha_across(r, mat.anisotropic)
        h = wi + wo
        c = 0.5 * wp.sqrt(wp.dot(h, h))
        schlick = schlick_of_index(c, eta)
        # ---- Main lobe ----
        value = reflection.value(wi, wo, alpha_u, alpha_v) * principled_fresnel(mat, c, eta, schlick)
        # ---- Clear coat ----
        masked_i = wi[2] * smith_over_cos(wi[2], squared_tangent_part(wi, COAT_MASKING, COAT_MASKING))
        masked_o = wo[2] * smith_over_cos(wo[2], squared_tangent_part(wo, COAT_MASKING, COAT_MASKING))
        fresnel = COAT_REFLECTANCE + (1.0 - COAT_REFLECTANCE) * schlick
        normals = coat_normals(wi, wo, coat_slope(mat.clearcoat_gloss))
        coat = 0.25 * clamp_unit(mat.clearcoat) * normals * masked_i * masked_o * fresnel * wo[2]
        # ---- Base and sheen ----
        opaque = (1.0 - transmitted_share(mat)) * INV_PI
        base = (opaque * base_scattering(mat.roughness, mat.flatness, wi[2], wo[2], c)) * mat.base_color
        white = wp.vec3(1.0, 1.0, 1.0)
        sheen = sheen_color(mat.base_color, mat.sheen, mat.sheen_tint, c)
        matte = (1.0 - clamp_unit(mat.metallic)) * wo[2]
        return value + coat * white + matte * (base + sheen)

    @wp.func
    def reflecting_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr, where nothing passes."""
        above = not (wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE)
        eta = principled_index(mat.ior, mat.specular)
        value = front_value(mat, or_upright(above, wi), or_upright(above, wo), eta)
        return where3(above, value, wp.vec3(0.0, 0.0, 0.0))

    @wp.func
    def transmitting_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        alphas = principled_alphas(mat.roughness, mat.anisotropic)
        eta = principled_index(mat.ior, mat.specular)
        if wp.abs(wi[2]) <= MIN_COSINE or wp.abs(wo[2]) <= MIN_COSINE:
            return wp.vec3(0.0, 0.0, 0.0)
        if wi[2] > 0.0 and wo[2] > 0.0:
            return front_value(mat, wi, wo, eta)
        up = where_number(wi[2] < 0.0, -1.0, 1.0)
        i = turned(wi, up)
        o = turned(wo, up)
        behind = index_behind(eta, wi[2])
        glass = (1.0 - clamp_unit(mat.metallic)) * transmitted_share(mat)
        if o[2] > 0.0:
            h = i + o
            inner = coat_reflectance(0.5 * wp.sqrt(wp.dot(h, h)), behind)
            inner = glass * inner * reflection.value(i, o, alphas[0], alphas[1])
            return wp.vec3(inner, inner, inner)
        c = interface.cosine(i, o, behind)
        if c <= 0.0:
            return wp.vec3(0.0, 0.0, 0.0)
        through = coat_transmittance(c, behind) * interface.value(i, o, behind, alphas[0], alphas[1])
        return (glass * through) * root_of(mat.base_color)

    @wp.func
    def lobe_weights(mat: record) -> wp.vec3:
        """Weights of the base, the clear coat and the main lobe among samples; they add up to 1."""
        base = (1.0 - clamp_unit(mat.metallic)) * (1.0 - transmitted_share(mat))
        base = wp.max(base, MIN_SHARE) * mat.diffuse_reflectance_sampling_rate
        coat = 0.25 * clamp_unit(mat.clearcoat) * mat.clearcoat_sampling_rate
        main = mat.main_specular_sampling_rate
        return wp.vec3(base, coat, main) / (base + coat + main)

    @wp.func
    def refracting_share(mat: record, wi: wp.vec3, transmittance: wp.float32) -> wp.float32:
        """Share of the samples of the main lobe that are refracted, by the transmittance at their normal."""
        glass = (1.0 - clamp_unit(mat.metallic)) * transmitted_share(mat)
        return where_number(wi[2] < 0.0, 1.0, wp.max(glass, MIN_SHARE)) * transmittance

    @wp.func
    def front_pdf(mat: record, wi: wp.vec3, wo: wp.vec3, weights: wp.vec3, refracted: wp.float32) -> wp.float32:
        """Density of what is reflected; ``refracted``: the share of the main lobe that is not."""
        r = clamp_unit(mat.roughness)
        density = reflection.pdf(wi, wo, alpha_along(r, mat.anisotropic), alpha_across(r, mat.anisotropic))
        h = wi + wo
        coat = coat_normals(wi, wo, coat_slope(mat.clearcoat_gloss)) * 0.5 * h[2] / wp.dot(h, h)
        main = (1.0 - refracted) * density
        return weights[0] * diffuse_pdf(wi, wo) + weights[1] * coat + weights[2] * main

    @wp.func
    def reflecting_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the sampled directions, solid angle, where nothing passes."""
        above = not (wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE)
        density = front_pdf(mat, or_upright(above, wi), or_upright(above, wo), lobe_weights(mat), 0.0)
        return where_number(above, density, 0.0)

    @wp.func
    def draw(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> wp.vec3:
        """Choose the base, the clear coat or the main lobe by ``u``, a direction by ``v``, where nothing passes."""
        weights = lobe_weights(mat)
        r = clamp_unit(mat.roughness)
        n = visible_normal(wi, alpha_along(r, mat.anisotropic), alpha_across(r, mat.anisotropic), v)
        glossy = where3(
            u < weights[0] + weights[1],
            coat_sample(wi, coat_slope(mat.clearcoat_gloss), v),
            2.0 * wp.dot(wi, n) * n - wi,
        )
        return unit_vector(where3(u < weights[0], square_to_cosine_hemisphere(v), glossy))

    @wp.func
    def transmitting_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the sampled directions, solid angle."""
        up = where_number(wi[2] < 0.0, -1.0, 1.0)
        i = turned(wi, up)
        o = turned(wo, up)
        if i[2] <= MIN_COSINE or wp.abs(o[2]) <= MIN_COSINE:
            return 0.0
        behind = index_behind(principled_index(mat.ior, mat.specular), wi[2])
        weights = lobe_weights(mat)
        if wi[2] < 0.0:
            weights = wp.vec3(0.0, 0.0, 1.0)
        if o[2] > 0.0:
            h = i + o
            refracted = refracting_share(mat, wi, coat_transmittance(0.5 * wp.sqrt(wp.dot(h, h)), behind))
            return front_pdf(mat, i, o, weights, refracted)
        c = interface.cosine(i, o, behind)
        if c > 0.0:
            alphas = principled_alphas(mat.roughness, mat.anisotropic)
            refracted = refracting_share(mat, wi, coat_transmittance(c, behind))
            return weights[2] * refracted * interface.pdf(i, o, behind, alphas[0], alphas[1])
        return 0.0

    @wp.func
    def transmitting_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Choose the base, the clear coat or the main lobe by ``u``, a direction by ``v``; none on the wrong side."""
        s = BsdfSample()
        s.eta = 1.0
        s.lobe = LOBE_NONE
        up = where_number(wi[2] < 0.0, -1.0, 1.0)
        i = turned(wi, up)
        if i[2] > MIN_COSINE:
            weights = lobe_weights(mat)
            if wi[2] < 0.0:
                weights = wp.vec3(0.0, 0.0, 1.0)
            o = wp.vec3(0.0, 0.0, 0.0)
            side = wp.float32(1.0)
            if u < weights[0]:
                o = square_to_cosine_hemisphere(v)
            elif u < weights[0] + weights[1]:
                o = coat_sample(i, coat_slope(mat.clearcoat_gloss), v)
            else:
                alphas = principled_alphas(mat.roughness, mat.anisotropic)
                n = visible_normal(i, alphas[0], alphas[1], v)
                c = wp.dot(i, n)
                o = 2.0 * c * n - i
                behind = index_behind(principled_index(mat.ior, mat.specular), wi[2])
                rest = (u - weights[0] - weights[1]) / weights[2]
                if rest < refracting_share(mat, wi, coat_transmittance(c, behind)):
                    g = refracted_cosine(c, behind)
                    o = refract_at(i, n, c, g, behind)
                    s.eta = behind
                    side = -1.0
            if o[2] * side > 0.0:
                s.wo = turned(wp.normalize(o), up)
                s.pdf = transmitting_pdf(mat, wi, s.wo)
                if s.pdf > 0.0:
                    s.value = transmitting_eval(mat, wi, s.wo)
                    s.lobe = LOBE_SMOOTH
        return s

    @wp.func
    def slopes(mat: record) -> wp.vec2:
        alphas = principled_alphas(mat.roughness, mat.anisotropic)
        return wp.vec2(wp.max(alphas[0], WIDE_SLOPE), wp.max(alphas[1], WIDE_SLOPE))

    @wp.func
    def principled_relative_eta(mat: record, wi: wp.vec3) -> wp.float32:
        return index_behind(principled_index(mat.ior, mat.specular), wi[2])

    if transmits:
        return Functions(
            transmitting_sample,
            transmitting_eval,
            transmitting_pdf,
            relative_eta=principled_relative_eta,
            slopes=slopes,
        )
    sample = make_reflected_sample(record, draw, reflecting_eval, reflecting_pdf)
    return Functions(sample, reflecting_eval, reflecting_pdf, slopes=slopes, branches=False)


_REFLECTING = (
    Color("base_color", 0.5),
    Number("roughness", default=0.5),
    *(Number(name, default=0.0) for name in ("anisotropic", "metallic", "spec_tint", "sheen", "sheen_tint")),
    *(Number(name, default=0.0) for name in ("flatness", "clearcoat", "clearcoat_gloss")),
    Rate("main_specular_sampling_rate", 1.0, low=1.0e-3),
    Rate("clearcoat_sampling_rate", 1.0),
    Rate("diffuse_reflectance_sampling_rate", 1.0),
)
#: What the value is linear in.
MIXES = ("metallic", "spec_tint", "sheen", "sheen_tint", "flatness", "clearcoat")
#: Without ``spec_trans``, or with the number 0: nothing passes.
PRINCIPLED = Model(
    "principled",
    (*_REFLECTING, SpecularIndex(0.5)),
    (LOBE_SMOOTH,),
    make_principled,
    brushed=True,
    glossy=True,
    mixes=MIXES,
)
TRANSMITTING_PRINCIPLED = Model(
    "principled",
    (*_REFLECTING, Number("spec_trans"), SpecularIndex(0.5, gap=MIN_GAP)),
    (LOBE_SMOOTH,),
    make_principled,
    brushed=True,
    passes=True,
    glossy=True,
    mixes=(*MIXES, "spec_trans"),
    when="spec_trans",
)

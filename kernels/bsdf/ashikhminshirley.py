"""Ashikhmin and Shirley's anisotropic Phong model: a glossy lobe over a diffuse base that gets the remaining energy.

With h the half vector, c = <wi, h> and S(x) = (1 - x)^5 [Ashikhmin and Shirley 2000, eqs. 4 and 5],

    f_s = D(h) F(c) / (4 c max(cos(wi), cos(wo)))
        + 28 rho_d / (23 pi) (1 - rho_s) (1 - S(cos(wi) / 2)) (1 - S(cos(wo) / 2)),
    D(h) = sqrt((nu + 1) (nv + 1)) / (2 pi) h_z^(nu cos^2(phi) + nv sin^2(phi)),   F(c) = rho_s + (1 - rho_s) S(c).

Digits: ``docs/theory/materials.md#ashikhmin-and-shirley``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.decomposition import ACROSS, Split, make_decomposition
from warp_psdr.kernels.bsdf.diffuse import diffuse_pdf
from warp_psdr.kernels.bsdf.microfacet import MIN_COSINE, half_slope
from warp_psdr.kernels.bsdf.model import Color, Functions, Model, Number
from warp_psdr.kernels.bsdf.plastic import MIN_SHARE
from warp_psdr.kernels.bsdf.principled import schlick_weight
from warp_psdr.kernels.bsdf.reflected import make_reflected_sample
from warp_psdr.kernels.bsdf.roughplastic import WIDE_SLOPE
from warp_psdr.kernels.constants import INV_PI, LOBE_SMOOTH
from warp_psdr.kernels.math import exp_ratio, log_ratio, where3
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere

#: Greatest exponent: a lobe of some 0.3 degrees.
MAX_EXPONENT = 1.0e5
#: Scale of the base, with which the model loses little light and makes none.
BASE = 28.0 / 23.0


@wp.func
def phong_exponent(n: wp.float32) -> wp.float32:
    """The exponent in use; in a tie of ``max`` or ``min`` the second argument has the derivative."""
    return wp.max(0.0, wp.min(MAX_EXPONENT, n))


@wp.func
def phong_normals(wi: wp.vec3, wo: wp.vec3, nu: wp.float32, nv: wp.float32) -> wp.float32:
    """Density D of normals along the half vector, 1/sr; it integrates to 1 without a cosine."""
    s = half_slope(wi, wo)
    power = 0.5 * (nu * s[0] * s[0] + nv * s[1] * s[1]) * log_ratio(wp.dot(s, s))
    return 0.5 * INV_PI * wp.sqrt((nu + 1.0) * (nv + 1.0)) * wp.exp(-power)


@wp.func
def phong_sample(wi: wp.vec3, nu: wp.float32, nv: wp.float32, v: wp.vec2) -> wp.vec3:
    """``wi`` reflected at a normal drawn with the density D; it may point below."""
    # The quadrant, and the angle in it [eqs. 9 and 10].
    quarter = wp.floor(4.0 * v[0])
    angle = wp.static(0.5 * wp.pi) * (4.0 * v[0] - quarter)
    x = wp.sqrt(nv + 1.0) * wp.cos(angle)
    y = wp.sqrt(nu + 1.0) * wp.sin(angle)
    r = wp.sqrt(x * x + y * y)
    x = x / r * wp.where(quarter == 1.0 or quarter == 2.0, -1.0, 1.0)
    y = y / r * wp.where(quarter >= 2.0, -1.0, 1.0)
    cosine = wp.pow(1.0 - v[1], 1.0 / (nu * x * x + nv * y * y + 1.0))
    sine = wp.sqrt(wp.max(0.0, (1.0 - cosine) * (1.0 + cosine)))
    n = wp.vec3(sine * x, sine * y, cosine)
    return wp.normalize(2.0 * wp.dot(wi, n) * n - wi)


@functools.cache
def make_ashikhmin_shirley(record: type, _variant: str) -> Functions:
    """Return the model's functions."""

    @wp.func
    def glossy_share(mat: record, wi: wp.vec3) -> wp.float32:
        """Probability of the glossy lobe."""
        rs = mat.specular_reflectance
        s = wp.min((rs[0] + rs[1] + rs[2]) / 3.0, 1.0)
        glossy = s + (1.0 - s) * schlick_weight(wi[2])
        base = (1.0 - s) * (mat.reflectance[0] + mat.reflectance[1] + mat.reflectance[2]) / 3.0
        return wp.clamp(glossy / wp.max(glossy + base, MIN_COSINE), MIN_SHARE, 1.0 - MIN_SHARE)

    @wp.func
    def phong_value(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """The glossy lobe, times the cosine of ``wo``, 1/sr."""
        if wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE:
            return wp.vec3(0.0, 0.0, 0.0)
        h = wi + wo
        c = 0.5 * wp.sqrt(wp.dot(h, h))
        rs = mat.specular_reflectance
        d = phong_normals(wi, wo, phong_exponent(mat.nu), phong_exponent(mat.nv))
        glossy = d * 0.25 / c * (wo[2] / wp.max(wi[2], wo[2]))
        return glossy * (rs + schlick_weight(c) * (wp.vec3(1.0, 1.0, 1.0) - rs))

    @wp.func
    def ashikhmin_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        if wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE:
            return wp.vec3(0.0, 0.0, 0.0)
        below = (1.0 - schlick_weight(0.5 * wi[2])) * (1.0 - schlick_weight(0.5 * wo[2]))
        left = wp.cw_mul(mat.reflectance, wp.vec3(1.0, 1.0, 1.0) - mat.specular_reflectance)
        return phong_value(mat, wi, wo) + (BASE * INV_PI * below * wo[2]) * left

    @wp.func
    def ashikhmin_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the sampled directions, solid angle."""
        if wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE:
            return 0.0
        h = wi + wo
        glossy = phong_normals(wi, wo, phong_exponent(mat.nu), phong_exponent(mat.nv)) * 0.5 / wp.sqrt(wp.dot(h, h))
        share = glossy_share(mat, wi)
        return share * glossy + (1.0 - share) * diffuse_pdf(wi, wo)

    @wp.func
    def draw(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> wp.vec3:
        """Choose the glossy lobe or the base by ``u``, and a direction by ``v``."""
        wo = square_to_cosine_hemisphere(v)
        if u < glossy_share(mat, wi):
            wo = phong_sample(wi, phong_exponent(mat.nu), phong_exponent(mat.nv), v)
        return wo

    @wp.func
    def slopes(mat: record) -> wp.vec2:
        along = wp.sqrt(2.0 / (phong_exponent(mat.nu) + 2.0))
        across = wp.sqrt(2.0 / (phong_exponent(mat.nv) + 2.0))
        return wp.vec2(wp.max(along, WIDE_SLOPE), wp.max(across, WIDE_SLOPE))

    split = make_phong_split(record, phong_value)
    ashikhmin_sample = make_reflected_sample(record, draw, ashikhmin_eval, ashikhmin_pdf)
    return Functions(ashikhmin_sample, ashikhmin_eval, ashikhmin_pdf, slopes=slopes, split=split)


@functools.cache
def make_phong_split(record: type, value: wp.Function) -> Split:
    """Return the two lobes of the derivative by an exponent: Beckmann's, in (X, Y) = sqrt(y) (cos(psi), sin(psi)).

    Derivation: ``docs/theory/interior.md#decomposed-branches``.
    """
    lobes = make_decomposition("beckmann")

    @wp.func
    def phong_lobe_draw(mat: record, wi: wp.vec3, axis: wp.int32, outer: wp.bool, u: wp.vec3) -> wp.vec3:
        s = lobes.draw(axis, outer, u)
        nu = phong_exponent(mat.nu) + 1.0
        nv = phong_exponent(mat.nv) + 1.0
        x = s[0] / wp.sqrt(nu)
        y = s[1] / wp.sqrt(nv)
        r2 = wp.max(x * x + y * y, 1.0e-30)
        # -log of the cosine of the normal: (X^2 + Y^2) / (n + 1), n + 1 = (nu x^2 + nv y^2) / r^2.
        depth = wp.dot(s, s) * r2 / wp.max(nu * x * x + nv * y * y, 1.0e-30)
        sine = wp.sqrt(2.0 * depth * exp_ratio(-2.0 * depth) / r2)
        h = wp.vec3(sine * x, sine * y, wp.exp(-depth))
        c = wp.dot(wi, h)
        return where3(c > 0.0, wp.normalize(2.0 * c * h - wi), wp.vec3(0.0, 0.0, -1.0))

    @wp.func
    def phong_density(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        h = wi + wo
        return phong_normals(wi, wo, phong_exponent(mat.nu), phong_exponent(mat.nv)) * 0.5 / wp.sqrt(wp.dot(h, h))

    @wp.func
    def moving(mat: record, axis: wp.int32) -> wp.float32:
        return 2.0 * (phong_exponent(wp.where(axis == ACROSS, mat.nv, mat.nu)) + 1.0)

    @wp.func
    def phong_mass(mat: record, axis: wp.int32) -> wp.float32:
        return -lobes.mass(axis) / moving(mat, axis)

    @wp.func
    def phong_rate(mat: record, wi: wp.vec3, wo: wp.vec3, axis: wp.int32) -> wp.float32:
        s = half_slope(wi, wo)
        size = 0.5 * log_ratio(wp.dot(s, s))
        x = s[0] * wp.sqrt((phong_exponent(mat.nu) + 1.0) * size)
        y = s[1] * wp.sqrt((phong_exponent(mat.nv) + 1.0) * size)
        return -lobes.rate(x, y, axis) / moving(mat, axis)

    return Split(phong_lobe_draw, phong_density, value, phong_mass, phong_rate)


ASHIKHMIN_SHIRLEY = Model(
    "ashikhminshirley",
    (
        Color("reflectance", 0.5),
        Color("specular_reflectance", 0.04),
        Number("nu", 0.0, MAX_EXPONENT, default=100.0),
        Number("nv", 0.0, MAX_EXPONENT, default=100.0),
    ),
    (LOBE_SMOOTH,),
    make_ashikhmin_shirley,
    brushed=True,
    glossy=True,
    splits=("nu", "nv"),
)

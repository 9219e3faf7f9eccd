"""Microfacet distributions: GGX [WMLT07] (Trowbridge-Reitz) and Beckmann, anisotropic, with visible-normal sampling.

In slopes s = (-h_x / h_z, -h_y / h_z) and t = (s_x / alpha_u)^2 + (s_y / alpha_v)^2, D(h) = P(t) / (alpha_u alpha_v
h_z^4), P(t) = exp(-t) / pi (Beckmann) or 1 / (pi (1 + t)^2) (GGX). Nothing in it cancels at small roughness.

Derivation: ``docs/theory/materials.md#microfacet-distributions``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.constants import INV_PI
from warp_psdr.kernels.exponentials import exponential, inverse_erf, logarithm, scaled_erfc
from warp_psdr.kernels.math import at_least, at_most, unit_vector, where3, where_number
from warp_psdr.kernels.sampling import square_to_disk

#: Smallest roughness: narrower lobes are the business of ``conductor``, and float32 directions do not resolve them.
MIN_ALPHA = 1.0e-5
#: Squared slope over the roughness beyond which exp(-t) counts as zero: it is 2e-38, the end of float32's normal range.
BECKMANN_CUTOFF = 87.0
#: The fit of Beckmann's G_1 holds below this cotangent over the roughness and is 1 above it.
BECKMANN_UNMASKED = 1.6
#: Cotangent over the roughness from which on nothing is masked: erf and exp have their limits.
BECKMANN_SHOWN = 9.0
#: Slopes beyond this many standard deviations have a probability below that of the smallest random number.
BECKMANN_MAX_SLOPE = 4.2
#: Where the inversion of Beckmann's visible slopes starts, polynomial in the sine of the angle (see there).
START_0, START_1, START_2 = 1.142, -1.19, 0.4389
#: Smallest denominator of a step of the inversion.
LEAST_STEP = 1.0e-30
INV_SQRT_PI = 0.5641895835477563
#: Below it a cosine counts as zero; keeps slopes and their squares inside float32's range.
MIN_COSINE = 1.0e-7
#: Squared length of wi + eta wo below which there is no half vector: the indices are equal, up to float32.
MIN_HALF = 1.0e-12


class Microfacet(NamedTuple):
    """Warp functions of one distribution; the first three are differentiable.

    Attributes:
        ndf: ``(t, r) -> float32``, P(t) r^2 with r = 1 / h_z^2, in factors that all stay within float32's range.
        smith_over_cos: ``(z, r2) -> float32`` of a stretched vector with cosine ``z`` and ``r2 = r^2``.
        projected_area: ``(z, r2) -> float32`` likewise.
        sample_visible: ``(w, v) -> vec3``: the stretched, unnormalised microfacet normal visible from the stretched
            unit vector ``w`` with positive z, for roughness one.
    """

    ndf: wp.Function
    smith_over_cos: wp.Function
    projected_area: wp.Function
    sample_visible: wp.Function


class Interface(NamedTuple):
    """Warp functions of a rough interface without its reflectance and transmittance; nothing branches.

    ``wi`` lies above, ``wo`` on either side, both beyond ``MIN_COSINE``; ``eta`` is the index below over that above.
    The half vector is wi + wo, or wi + eta wo turned up: ``wi`` has to lie above and ``wo`` below its microfacet.

    Attributes:
        cosine: ``(wi, wo, eta) -> float32`` between ``wi`` and the half vector; 0 where a side is wrong.
        value: ``(wi, wo, eta, alpha_u, alpha_v) -> float32``, 1/sr, of directions with a ``cosine`` above 0: f_s of
            radiance times the cosine of ``wo`` for a reflectance or transmittance of one, as ``Reflection.value`` or
            D G_1(wi) G_1(wo) <wi, h> |<wo, h>| / (cos(wi) |wi + eta wo|^2) [WMLT07, eq. 21, over eta^2];
            differentiable.
        pdf: ``(wi, wo, eta, alpha_u, alpha_v) -> float32``: density of visible normals that reflect or refract ``wi``
            into ``wo``, solid angle of ``wo``.
    """

    cosine: wp.Function
    value: wp.Function
    pdf: wp.Function


class Reflection(NamedTuple):
    """Warp functions of a rough mirror without its reflectance; ``wi`` and ``wo`` lie above, beyond ``MIN_COSINE``.

    Attributes:
        value: ``(wi, wo, alpha_u, alpha_v) -> float32``, D G_1(wi) G_1(wo) / (4 cos(wi)), 1/sr: f_s times the cosine of
            ``wo`` for a reflectance of one; differentiable.
        pdf: ``(wi, wo, alpha_u, alpha_v) -> float32``: density of ``sample``, solid angle.
        sample: ``(wi, alpha_u, alpha_v, v) -> vec3``: ``wi`` reflected at a visible normal; it may point below.
        normals: ``(wi, wo, alpha_u, alpha_v) -> float32``: D along the half vector, 1/sr.
    """

    value: wp.Function
    pdf: wp.Function
    sample: wp.Function
    normals: wp.Function


@wp.func
def at_least_min(alpha: wp.float32) -> wp.float32:
    """The roughness in use, with derivative 1 at MIN_ALPHA, 0 below."""
    return at_least(MIN_ALPHA, alpha)


@wp.func
def or_upright(above: wp.bool, w: wp.vec3) -> wp.vec3:
    """``w`` where it lies above the surface, else the normal, with which all is finite, and nothing used."""
    return where3(above, w, wp.vec3(0.0, 0.0, 1.0))


@wp.func
def squared_tangent_part(w: wp.vec3, alpha_u: wp.float32, alpha_v: wp.float32) -> wp.float32:
    """Squared length of the horizontal part of the stretched ``w``."""
    x = alpha_u * w[0]
    y = alpha_v * w[1]
    return x * x + y * y


@functools.cache
def make_visible_normal(distribution: str) -> wp.Function:
    """Return ``visible_normal(wi, alpha_u, alpha_v, v) -> vec3``: a unit microfacet normal that is seen from ``wi``."""
    sample_visible = make_microfacet(distribution).sample_visible

    @wp.func
    def visible_normal(wi: wp.vec3, alpha_u: wp.float32, alpha_v: wp.float32, v: wp.vec2) -> wp.vec3:
        m = sample_visible(unit_vector(wp.vec3(alpha_u * wi[0], alpha_v * wi[1], wi[2])), v)
        return unit_vector(wp.vec3(alpha_u * m[0], alpha_v * m[1], m[2]))

    return visible_normal


@wp.func
def half_slope(wi: wp.vec3, wo: wp.vec3) -> wp.vec2:
    """Slope (h_x, h_y) / h_z of the half vector of two directions above the surface.

    It is corrected by a second measurement, that wo - wi is normal to the half vector, so that it keeps its digits at
    every angle down to alpha = 1e-5.

    Derivation: ``docs/theory/materials.md#digits-of-a-rough-conductor``.
    """
    h = wi + wo
    d = wo - wi
    sx = h[0] / h[2]
    sy = h[1] / h[2]
    r = (d[0] * sx + d[1] * sy + d[2]) / (h[2] * h[2] + d[0] * d[0] + d[1] * d[1])
    return wp.vec2(sx - d[0] * r, sy - d[1] * r)


@functools.cache
def make_reflection(distribution: str) -> Reflection:
    """Return the functions of a rough mirror.

    Derivation: ``docs/theory/materials.md#digits-of-a-rough-conductor``.
    """
    ndf, smith_over_cos, projected_area, _sample_visible = make_microfacet(distribution)
    visible_normal = make_visible_normal(distribution)

    @wp.func
    def normals(wi: wp.vec3, wo: wp.vec3, alpha_u: wp.float32, alpha_v: wp.float32) -> wp.float32:
        """Density D of microfacet normals along the half vector, 1/sr."""
        s = half_slope(wi, wo)
        tx = s[0] / alpha_u
        ty = s[1] / alpha_v
        return ndf(tx * tx + ty * ty, 1.0 + s[0] * s[0] + s[1] * s[1]) / (alpha_u * alpha_v)

    @wp.func
    def reflected_value(wi: wp.vec3, wo: wp.vec3, alpha_u: wp.float32, alpha_v: wp.float32) -> wp.float32:
        g_i = smith_over_cos(wi[2], squared_tangent_part(wi, alpha_u, alpha_v))
        g_o = smith_over_cos(wo[2], squared_tangent_part(wo, alpha_u, alpha_v))
        return 0.25 * normals(wi, wo, alpha_u, alpha_v) * g_i * g_o * wo[2]

    @wp.func
    def reflected_pdf(wi: wp.vec3, wo: wp.vec3, alpha_u: wp.float32, alpha_v: wp.float32) -> wp.float32:
        area = projected_area(wi[2], squared_tangent_part(wi, alpha_u, alpha_v))
        return 0.25 * normals(wi, wo, alpha_u, alpha_v) / area

    @wp.func
    def reflected_sample(wi: wp.vec3, alpha_u: wp.float32, alpha_v: wp.float32, v: wp.vec2) -> wp.vec3:
        n = visible_normal(wi, alpha_u, alpha_v, v)
        return unit_vector(2.0 * wp.dot(wi, n) * n - wi)

    return Reflection(reflected_value, reflected_pdf, reflected_sample, normals)


@wp.func
def refraction_cosine(wi: wp.vec3, wo: wp.vec3, eta: wp.float32) -> wp.float32:
    h = wi + eta * wo
    turned = where_number(h[2] < 0.0, -1.0, 1.0)
    squared = wp.dot(h, h)
    seen = turned * wp.dot(wi, h)
    upright = squared > MIN_HALF and wp.abs(h[2]) > MIN_COSINE
    between = upright and seen > 0.0 and turned * wp.dot(wo, h) < 0.0
    # It exceeds 1 by rounding.
    return where_number(between, at_most(1.0, seen / wp.sqrt(where_number(between, squared, 1.0))), 0.0)


@wp.struct
class HalfVector:
    """The half vector of two directions at an interface: its slopes, and what of a density of directions they make."""

    slope: wp.vec2
    jacobian: wp.float32  # from normals to directions, times <wi, h>


@wp.func
def interface_cosine(wi: wp.vec3, wo: wp.vec3, eta: wp.float32) -> wp.float32:
    above = wo[2] > 0.0
    h = wi + or_upright(above, wo)
    return where_number(above, 0.5 * wp.sqrt(wp.dot(h, h)), refraction_cosine(wi, wo, eta))


@wp.func
def interface_half_vector(wi: wp.vec3, wo: wp.vec3, eta: wp.float32) -> HalfVector:
    """Both kinds are computed, of directions that have one: adjoints of what is not selected are 0, if it is finite."""
    above = wo[2] > 0.0
    reflected = half_slope(wi, or_upright(above, wo))
    i = where3(above, wp.vec3(0.0, 0.0, 1.0), wi)
    o = where3(above, wp.vec3(0.0, 0.0, -1.0), wo)
    h = i + where_number(above, 0.5, eta) * o
    squared = wp.dot(h, h)
    result = HalfVector()
    result.slope = wp.vec2(
        where_number(above, reflected[0], h[0] / h[2]),
        where_number(above, reflected[1], h[1] / h[2]),
    )
    through = (wp.abs(wp.dot(i, h)) / squared) * (wp.abs(wp.dot(o, h)) / squared)
    result.jacobian = where_number(above, 0.25, through)
    return result


@functools.cache
def make_rough_interface(distribution: str) -> Interface:
    """Return the functions of a rough interface.

    Derivation: ``docs/theory/materials.md#rough-glass``.
    """
    ndf, smith_over_cos, projected_area, _sample_visible = make_microfacet(distribution)

    @wp.func
    def interface_normals(h: HalfVector, alpha_u: wp.float32, alpha_v: wp.float32) -> wp.float32:
        """D(h) times the Jacobian."""
        tx = h.slope[0] / alpha_u
        ty = h.slope[1] / alpha_v
        inv_cos2 = 1.0 + h.slope[0] * h.slope[0] + h.slope[1] * h.slope[1]
        return h.jacobian * ndf(tx * tx + ty * ty, inv_cos2) / (alpha_u * alpha_v)

    @wp.func
    def interface_value(
        wi: wp.vec3, wo: wp.vec3, eta: wp.float32, alpha_u: wp.float32, alpha_v: wp.float32
    ) -> wp.float32:
        c = wp.abs(wo[2])
        g_i = smith_over_cos(wi[2], squared_tangent_part(wi, alpha_u, alpha_v))
        g_o = smith_over_cos(c, squared_tangent_part(wo, alpha_u, alpha_v))
        return interface_normals(interface_half_vector(wi, wo, eta), alpha_u, alpha_v) * g_i * g_o * c

    @wp.func
    def interface_pdf(
        wi: wp.vec3, wo: wp.vec3, eta: wp.float32, alpha_u: wp.float32, alpha_v: wp.float32
    ) -> wp.float32:
        area = projected_area(wi[2], squared_tangent_part(wi, alpha_u, alpha_v))
        scale = where_number(wo[2] > 0.0, 1.0, eta * eta)
        return interface_normals(interface_half_vector(wi, wo, eta), alpha_u, alpha_v) * (scale / area)

    return Interface(interface_cosine, interface_value, interface_pdf)


@functools.cache
def make_microfacet(distribution: str) -> Microfacet:
    """Return the functions of ``distribution``, "ggx" or "beckmann"."""
    if distribution == "ggx":
        return Microfacet(_ggx_ndf, _ggx_smith_over_cos, _ggx_projected_area, _ggx_sample_visible)
    if distribution == "beckmann":
        return Microfacet(_beckmann_ndf, _beckmann_smith_over_cos, _beckmann_projected_area, _beckmann_sample_visible)
    raise ValueError(f"unknown microfacet distribution {distribution!r}; expected 'ggx' or 'beckmann'")


@wp.func
def _ggx_ndf(t: wp.float32, inv_cos2: wp.float32) -> wp.float32:
    # The ratio lies between the squared roughness and 1; the squares of its parts, and their adjoints, overflow.
    ratio = inv_cos2 / (1.0 + t)
    return INV_PI * ratio * ratio


@wp.func
def _ggx_smith_over_cos(z: wp.float32, r2: wp.float32) -> wp.float32:
    return 2.0 / (z + wp.sqrt(z * z + r2))


@wp.func
def _ggx_projected_area(z: wp.float32, r2: wp.float32) -> wp.float32:
    return 0.5 * (z + wp.sqrt(z * z + r2))


@wp.func
def _ggx_sample_visible(w: wp.vec3, v: wp.vec2) -> wp.vec3:
    """Add ``w`` to a uniform point of the sphere's cap that faces it [Dupuy and Benyoub 2023, listing 3].

    With c = 1 + w.z the cap has the heights z = 1 - c d, d uniform in [0, 1): the squared radius of a point uniform on
    the disk, which is then moved outwards from radius sqrt(d) to sqrt(1 - z^2) = sqrt(d) sqrt(c (2 - c d)).
    """
    p = square_to_disk(v)
    c = 1.0 + w[2]
    cd = wp.min(c * wp.dot(p, p), 2.0)
    k = wp.sqrt(c * (2.0 - cd))
    return wp.vec3(k * p[0], k * p[1], 1.0 - cd) + w


@wp.func
def _beckmann_ndf(t: wp.float32, inv_cos2: wp.float32) -> wp.float32:
    return where_number(t < BECKMANN_CUTOFF, INV_PI * exponential(-t) * inv_cos2 * inv_cos2, 0.0)


@wp.func
def _beckmann_smith_over_cos(z: wp.float32, r2: wp.float32) -> wp.float32:
    # Unmasked is also the normal direction, r = 0, where the root of r2 has no derivative. The minimum closes the gap
    # of 6e-5 that the published coefficients leave between the two pieces.
    masked = z * z < wp.static(BECKMANN_UNMASKED**2) * r2
    r = wp.sqrt(where_number(masked, r2, 1.0))
    fit = (3.535 * r + 2.181 * z) / (r * r + 2.276 * z * r + 2.577 * z * z)
    return where_number(masked, at_most(1.0 / z, fit), 1.0 / z)


@wp.func
def visible_below(x: wp.float32, z: wp.float32, r: wp.float32) -> wp.float32:
    """C(x) of ``_beckmann_sample_visible``: visible slopes up to x, unnormalised."""
    e = exponential(-x * x)
    tail = e * scaled_erfc(wp.abs(x))
    return 0.5 * (z * where_number(x > 0.0, 2.0 - tail, tail) + INV_SQRT_PI * r * e)


@wp.func
def _beckmann_projected_area(z: wp.float32, r2: wp.float32) -> wp.float32:
    masked = z * z < wp.static(BECKMANN_SHOWN**2) * r2
    r = wp.sqrt(where_number(masked, r2, 1.0))
    return where_number(masked, visible_below(z / r, z, r), z)


@wp.func
def _beckmann_sample_visible(w: wp.vec3, v: wp.vec2) -> wp.vec3:
    """Sample the slope along ``w`` by inverting its cumulative distribution, the one across it directly.

    In the plane of incidence (z = cos, r = sin) the visible slopes x < z / r have the unnormalised cumulative

        C(x) = z erfc(-x) / 2 + r exp(-x^2) / (2 sqrt(pi)),

    a sum of positive terms. Two steps of Halley's method on log C, which is concave, solve C(x) = (1 - v.x) C(z / r) to
    2e-7 of the right side. They start where erf(x) lies between -1 and its largest value as 1 - v.x^k does between 0
    and 1: k = 1 is right at normal incidence, and k(r) is the quadratic that leaves least after a step [cf. Jakob 2014,
    An Improved Visible Normal Sampling Routine for the Beckmann Distribution].
    """
    z = w[2]
    squared = w[0] * w[0] + w[1] * w[1]
    upright = squared <= 0.0
    r = wp.sqrt(where_number(upright, 1.0, squared))
    cos_phi = where_number(upright, 1.0, w[0] / r)
    sin_phi = where_number(upright, 0.0, w[1] / r)
    r = where_number(upright, 0.0, r)
    high = where_number(z < BECKMANN_MAX_SLOPE * r, z / where_number(upright, 1.0, r), BECKMANN_MAX_SLOPE)
    # erfc of the largest slope, and of its opposite.
    e = exponential(-high * high)
    beyond = e * scaled_erfc(high)
    total = 0.5 * (z * (2.0 - beyond) + INV_SQRT_PI * r * e)
    target = (1.0 - v[0]) * total
    share = exponential((START_0 + r * (START_1 + r * START_2)) * logarithm(v[0]))
    below = (2.0 - beyond) * (1.0 - share)
    x = wp.clamp(inverse_erf(below, beyond + (2.0 - beyond) * share), -BECKMANN_MAX_SLOPE, high)
    for _ in range(2):
        gauss = INV_SQRT_PI * exponential(-x * x)
        c = visible_below(x, z, r)
        excess = logarithm(c / target)
        slope = (z - x * r) * gauss
        bend = (r * gauss + 2.0 * x * slope) * c + slope * slope
        rate = 2.0 * slope * slope + excess * bend
        step = where_number(rate > LEAST_STEP, 2.0 * excess * slope * c / wp.max(rate, LEAST_STEP), 0.0)
        x = wp.clamp(x - step, -BECKMANN_MAX_SLOPE, high)
    y = inverse_erf(wp.max(2.0 * v[1], 1.0e-7), wp.max(2.0 - 2.0 * v[1], 1.0e-7))
    # From the plane of incidence back to the frame of w; normal (-slope, 1).
    return wp.vec3(-(cos_phi * x - sin_phi * y), -(sin_phi * x + cos_phi * y), 1.0)

"""Rough diffuse reflection by Oren and Nayar's qualitative model: V-shaped grooves of Lambertian facets.

sigma is the standard deviation of the facets' slope angle, radians. With A = 1 - sigma^2 / (2 (sigma^2 + 0.33)) and
B = 0.45 sigma^2 / (sigma^2 + 0.09) [Oren and Nayar 1994, eq. 30],

    f_s = reflectance / pi (A + B max(0, cos(phi_i - phi_o)) sin(alpha) tan(beta)),

alpha the greater and beta the lesser of the two angles from the normal. The sines and cosines of a pair of unit vectors
are (x_i x_o + y_i y_o) / max(cos(theta_i), cos(theta_o)): nothing is divided by a small number that stays.

By sigma: ``docs/theory/interior.md#lobes-of-one-sign``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.decomposition import SignedLobes
from warp_psdr.kernels.bsdf.diffuse import diffuse_pdf
from warp_psdr.kernels.bsdf.model import Color, Functions, Model, Number
from warp_psdr.kernels.constants import INV_PI, LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.math import at_least, at_most, where3
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere
from warp_psdr.kernels.structs import BsdfSample

#: Greatest sigma, a right angle.
MAX_SIGMA = 1.5707963
#: Least cosine that is divided by; both directions lie in the surface there.
LEAST_COSINE = 1.0e-20
#: Angles below which a series stands for a difference, and Newton steps of the inversion, which converge from above.
NARROW, ANGLE_STEPS = wp.constant(0.3), 6


@wp.func
def sine_square_integral(x: wp.float32) -> wp.float32:
    """Twice the integral of sin^2 up to the angle x, x - sin(x) cos(x)."""
    x2 = x * x
    series = 2.0 / 3.0 * x * x2 * (1.0 - x2 * (0.2 - x2 * (2.0 / 105.0 - x2 / 945.0)))
    return wp.where(x < NARROW, series, x - wp.sin(x) * wp.cos(x))


@wp.func
def sine_square_angle(most: wp.float32, u: wp.float32) -> wp.float32:
    """An angle up to ``most``, at most a right one, with a density proportional to sin^2."""
    whole = u * sine_square_integral(most)
    # The integral is at least 6 / pi^2 of (2 / 3) x^3 up to a right angle, and convex: from above Newton stays above.
    x = wp.min(wp.pow(wp.static(0.25 * wp.pi * wp.pi) * whole, 1.0 / 3.0), most)
    for _i in range(wp.static(ANGLE_STEPS)):
        sine = wp.sin(x)
        x = wp.clamp(x - (sine_square_integral(x) - whole) / wp.max(2.0 * sine * sine, 1.0e-30), 0.0, most)
    return x


@wp.func
def groove_shares(wi: wp.vec3) -> wp.vec2:
    """Integrals of sin(alpha) tan(beta) cos(theta_o) sin(theta_o) over theta_o, above and below theta_i."""
    sine2 = wi[0] * wi[0] + wi[1] * wi[1]
    sine = wp.sqrt(sine2)
    # tan (1 - sin^3) without the difference.
    below = sine * wi[2] * (1.0 + sine + sine2) / (3.0 * (1.0 + sine))
    return wp.vec2(0.5 * sine * sine_square_integral(wp.atan2(sine, wi[2])), below)


@wp.func
def groove_direction(wi: wp.vec3, u: wp.vec2) -> wp.vec3:
    """A direction with a density proportional to max(0, cos(phi_i - phi_o)) sin(alpha) tan(beta) cos(theta_o)."""
    shares = groove_shares(wi)
    sine_i = wp.sqrt(wi[0] * wi[0] + wi[1] * wi[1])
    at = u[1] * (shares[0] + shares[1])
    sine = wp.float32(0.0)
    cosine = wp.float32(1.0)
    if at < shares[0]:
        x = sine_square_angle(wp.atan2(sine_i, wi[2]), at / shares[0])
        sine = wp.sin(x)
        cosine = wp.cos(x)
    else:
        # 1 - sin^3 from the cosine: digits stay near the horizon.
        rest = (1.0 - wp.clamp((at - shares[0]) / wp.max(shares[1], LEAST_COSINE), 0.0, 1.0)) * (
            wi[2] * wi[2] * (1.0 + sine_i + sine_i * sine_i) / (1.0 + sine_i)
        )
        sine = wp.pow(wp.max(1.0 - rest, 0.0), 1.0 / 3.0)
        cosine = wp.sqrt(wp.max(rest * (1.0 + sine) / (1.0 + sine + sine * sine), 0.0))
    across = 2.0 * u[0] - 1.0
    along = wp.sqrt(wp.max(1.0 - across * across, 0.0))
    x_i = wp.where(sine_i > 0.0, wi[0] / wp.max(sine_i, LEAST_COSINE), 1.0)
    y_i = wi[1] / wp.max(sine_i, LEAST_COSINE)
    return wp.vec3(sine * (along * x_i - across * y_i), sine * (along * y_i + across * x_i), cosine)


@functools.cache
def make_oren_nayar(record: type, _variant: str) -> Functions:
    """Return the model's functions."""

    @wp.func
    def oren_nayar_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        above = not (wi[2] <= 0.0 or wo[2] <= 0.0)
        sigma = at_least(0.0, at_most(MAX_SIGMA, mat.sigma))
        s2 = sigma * sigma
        a = 1.0 - s2 / (2.0 * (s2 + 0.33))
        b = 0.45 * s2 / (s2 + 0.09)
        across = at_least(0.0, wi[0] * wo[0] + wi[1] * wo[1])
        # At most 1: the cosine of ``wo`` is taken in here.
        share = wo[2] / at_least(LEAST_COSINE, at_least(wi[2], wo[2]))
        return where3(above, (INV_PI * (a * wo[2] + b * across * share)) * mat.reflectance, wp.vec3(0.0, 0.0, 0.0))

    @wp.func
    def oren_nayar_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the sampled directions, proportional to their cosine, solid angle."""
        return diffuse_pdf(wi, wo)

    @wp.func
    def oren_nayar_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Sample a direction proportional to its cosine; ``u`` is not used."""
        s = BsdfSample()
        s.eta = 1.0
        s.wo = square_to_cosine_hemisphere(v)
        above = wi[2] > 0.0 and s.wo[2] > 0.0
        s.pdf = wp.where(above, INV_PI * s.wo[2], 0.0)
        s.value = oren_nayar_eval(mat, wi, s.wo)
        s.lobe = wp.where(above, LOBE_SMOOTH, LOBE_NONE)
        return s

    @wp.func
    def signed_oren_nayar_draw(mat: record, wi: wp.vec3, number: wp.int32, second: wp.bool, u: wp.vec2) -> wp.vec3:
        """A direction of the term by A (first) or by B (second)."""
        wo = square_to_cosine_hemisphere(u)
        if second:
            wo = groove_direction(wi, u)
        return wo

    @wp.func
    def signed_oren_nayar_weight(mat: record, wi: wp.vec3, wo: wp.vec3, number: wp.int32, second: wp.bool) -> wp.vec3:
        """A' reflectance, and B' reflectance / pi times the integral of the grooves' term."""
        sigma = wp.max(0.0, wp.min(MAX_SIGMA, mat.sigma))
        s2 = sigma * sigma
        shares = groove_shares(wi)
        weight = -0.33 * sigma / ((s2 + 0.33) * (s2 + 0.33))
        if second:
            weight = 0.081 * sigma / ((s2 + 0.09) * (s2 + 0.09)) * 2.0 * INV_PI * (shares[0] + shares[1])
        return weight * mat.reflectance

    signed = SignedLobes(signed_oren_nayar_draw, signed_oren_nayar_weight)
    return Functions(oren_nayar_sample, oren_nayar_eval, oren_nayar_pdf, signed=signed, branches=False)


OREN_NAYAR = Model(
    "orennayar",
    (Color("reflectance", 0.5), Number("sigma", 0.0, MAX_SIGMA, default=0.3)),
    (LOBE_SMOOTH,),
    make_oren_nayar,
    signed=("sigma",),
)

"""Glossy reflection by the ABC distribution of microfacet normals, which has long tails.

With h the half vector and x = 1 - h_z [Löw, Kronander, Ynnerman and Unger 2012, eq. 20],

    f_s = F(<wi, h>) S(x) G / (cos(wi) cos(wo)),   S(x) = A / (1 + B x)^C,

where F is the Fresnel reflectance of a conductor and G the masking of V-shaped grooves. ``A`` scales the lobe and is
not bounded by energy. Each derivative of S has one sign, so the model serves to compare estimators of derivatives
[BXB*24].

Sampling and digits: ``docs/theory/materials.md#the-abc-distribution``; by A, B and C:
``docs/theory/interior.md#lobes-of-one-sign``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.decomposition import SignedLobes
from warp_psdr.kernels.bsdf.microfacet import MIN_COSINE, half_slope
from warp_psdr.kernels.bsdf.model import Color, ComplexIndex, Functions, Model, Number
from warp_psdr.kernels.bsdf.reflected import make_reflected_sample
from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.fresnel import fresnel_conductor_rgb
from warp_psdr.kernels.math import exp_ratio, log_ratio, where3

#: Greatest ``B``, a lobe of some 0.1 degrees, and greatest ``C``.
MAX_B, MAX_C = 1.0e6, 100.0
#: Range of the widths that edges are sampled by.
MIN_WIDTH, MAX_WIDTH = 1.0e-3, 1.0
#: Values whose derivatives are drawn, and their places.
SIGNED = ("A", "B", "C")
BY_A, BY_B, BY_C = 0, 1, 2
#: Below these, series stand for differences that have no digits left.
MOMENT_SERIES, STEP_SERIES = 0.5, 0.02
#: Newton steps of the inversion, with bisection where they leave the bracket.
INVERSION_STEPS = 12


@wp.func
def clamp_to(x: wp.float32, high: wp.float32) -> wp.float32:
    """The value in use; in a tie of ``max`` or ``min`` the second argument has the derivative."""
    return wp.max(0.0, wp.min(high, x))


@wp.func
def sagitta(wi: wp.vec3, wo: wp.vec3) -> wp.float32:
    """1 - h_z, from the slope of the half vector: without the difference."""
    s = half_slope(wi, wo)
    s2 = wp.dot(s, s)
    q = wp.sqrt(1.0 + s2)
    return s2 / (q * (1.0 + q))


@wp.func
def log_abc(x: wp.float32, b: wp.float32, c: wp.float32) -> wp.float32:
    """log(S / A)."""
    return -c * b * x * log_ratio(b * x)


@wp.func
def abc_integral(b: wp.float32, c: wp.float32) -> wp.float32:
    """Integral of S / A over x in [0, 1]: ((1 + B)^(1 - C) - 1) / (B (1 - C)), without its poles."""
    mean = log_ratio(b)
    return mean * exp_ratio((1.0 - c) * b * mean)


@wp.func
def abc_draw(b: wp.float32, c: wp.float32, u: wp.float32) -> wp.float32:
    """X in [0, 1] with a density proportional to S, by inversion of its integral."""
    y = u * abc_integral(b, c)
    log_base = b * y * log_ratio(wp.max((1.0 - c) * b * y, -0.9999999))
    return wp.min(y * log_ratio(wp.max((1.0 - c) * b * y, -0.9999999)) * exp_ratio(log_base), 1.0)


@wp.func
def exp_moment(z: wp.float32) -> wp.float32:
    """Integral of t exp(z t) over t in [0, 1]: the derivative of ``exp_ratio``."""
    near = wp.abs(z) < MOMENT_SERIES
    x = wp.where(near, z, 0.0)
    series = 0.5 + x * (1.0 / 3.0 + x * (0.125 + x * (1.0 / 30.0 + x * (1.0 / 144.0 + x / 840.0))))
    far = wp.where(near, 1.0, z)
    return wp.where(near, series, ((far - 1.0) * wp.exp(far) + 1.0) / (far * far))


@wp.func
def exp_ratio_step(z: wp.float32, v: wp.float32) -> wp.float32:
    """(exp_ratio(z + v) - exp_ratio(z)) / v, v >= 0: the integral of exp(z t) (exp(v t) - 1) / v over t in [0, 1]."""
    near = v < STEP_SERIES
    far = wp.where(near, 1.0, v)
    return wp.where(near, exp_moment(z + 0.5 * v), (exp_ratio(z + far) - exp_ratio(z)) / far)


@wp.func
def abc_lobe_share(number: wp.int32, t: wp.float32, size: wp.float32, c: wp.float32) -> wp.float32:
    """Integral up to t of the derivative's density in t, see ``abc_lobe_density``."""
    by_b = exp_ratio_step(-c * size * t, size * t)
    return t * t * wp.where(number == BY_B, by_b, exp_moment((1.0 - c) * size * t))


@wp.func
def abc_lobe_density(number: wp.int32, t: wp.float32, size: wp.float32, c: wp.float32) -> wp.float32:
    """Of t = log(1 + B x) / size, not normalised: x / (1 + B x)^(C + 1) or log(1 + B x) / (1 + B x)^C, times dx/dt."""
    return t * wp.exp(-c * size * t) * wp.where(number == BY_B, exp_ratio(size * t), wp.exp(size * t))


@wp.func
def abc_lobe_draw(number: wp.int32, b: wp.float32, c: wp.float32, u: wp.float32) -> wp.float32:
    """X in [0, 1] with a density proportional to the derivative of S by B or C."""
    mean = log_ratio(b)
    size = b * mean
    whole = u * abc_lobe_share(number, 1.0, size, c)
    low = wp.float32(0.0)
    high = wp.float32(1.0)
    t = wp.min(wp.sqrt(2.0 * whole), 1.0)
    for _i in range(wp.static(INVERSION_STEPS)):
        f = abc_lobe_share(number, t, size, c) - whole
        high = wp.where(f > 0.0, t, high)
        low = wp.where(f > 0.0, low, t)
        newton = t - f / wp.max(abc_lobe_density(number, t, size, c), 1.0e-30)
        t = wp.where(newton >= low and newton <= high, newton, 0.5 * (low + high))
    return wp.min(t * mean * exp_ratio(size * t), 1.0)


@functools.cache
def make_abc(record: type, _variant: str) -> Functions:
    """Return the model's functions."""

    @wp.func
    def beside_normals(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo`` over S, of two directions above: F G / cos(wi)."""
        h = wi + wo
        length = wp.sqrt(wp.dot(h, h))
        c = 0.5 * length
        # G / cos(wi): grooves hide nothing, or the lower one of the two directions.
        hidden = 2.0 * (h[2] / length) / c * (wo[2] / wp.max(wi[2], wo[2]))
        masking = wp.min(1.0 / wi[2], hidden)
        return masking * wp.cw_mul(mat.specular_reflectance, fresnel_conductor_rgb(c, mat.eta, mat.k))

    @wp.func
    def abc_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        if wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE:
            return wp.vec3(0.0, 0.0, 0.0)
        s = wp.exp(log_abc(sagitta(wi, wo), clamp_to(mat.B, MAX_B), clamp_to(mat.C, MAX_C)))
        return (wp.max(0.0, mat.A) * s) * beside_normals(mat, wi, wo)

    @wp.func
    def abc_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the sampled directions, solid angle."""
        if wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE:
            return 0.0
        h = wi + wo
        b = clamp_to(mat.B, MAX_B)
        c = clamp_to(mat.C, MAX_C)
        normals = wp.exp(log_abc(sagitta(wi, wo), b, c)) / (wp.static(2.0 * wp.pi) * abc_integral(b, c))
        return 0.5 * normals / wp.sqrt(wp.dot(h, h))

    @wp.func
    def normal_at(x: wp.float32, u: wp.float32) -> wp.vec3:
        """The normal with 1 - h_z = x, in a random direction around."""
        r = wp.sqrt(x * (2.0 - x))
        phi = wp.static(2.0 * wp.pi) * u
        return wp.vec3(r * wp.cos(phi), r * wp.sin(phi), 1.0 - x)

    @wp.func
    def draw(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> wp.vec3:
        """``wi`` reflected at a normal drawn in proportion to S; it may point below."""
        n = normal_at(abc_draw(clamp_to(mat.B, MAX_B), clamp_to(mat.C, MAX_C), v[1]), v[0])
        return wp.normalize(2.0 * wp.dot(wi, n) * n - wi)

    @wp.func
    def signed_abc_draw(mat: record, wi: wp.vec3, number: wp.int32, second: wp.bool, u: wp.vec2) -> wp.vec3:
        """A direction of the inner or the outer half of the derivative's one lobe."""
        b = clamp_to(mat.B, MAX_B)
        c = clamp_to(mat.C, MAX_C)
        half = 0.5 * (u[1] + wp.where(second, 1.0, 0.0))
        x = wp.float32(0.0)
        if number == BY_A:
            x = abc_draw(b, c, half)
        else:
            x = abc_lobe_draw(number, b, c, half)
        n = normal_at(x, u[0])
        cosine = wp.dot(wi, n)
        return where3(cosine > 0.0, wp.normalize(2.0 * cosine * n - wi), wp.vec3(0.0, 0.0, -1.0))

    @wp.func
    def signed_abc_weight(mat: record, wi: wp.vec3, wo: wp.vec3, number: wp.int32, second: wp.bool) -> wp.vec3:
        """The integral of the derivative of S over normals, halved, times 4 <wi, h> F G / cos(wi)."""
        b = clamp_to(mat.B, MAX_B)
        c = clamp_to(mat.C, MAX_C)
        a = wp.max(0.0, mat.A)
        mean = log_ratio(b)
        mass = abc_integral(b, c)
        if number == BY_B:
            mass = -a * c * mean * mean * abc_lobe_share(BY_B, 1.0, b * mean, c)
        if number == BY_C:
            mass = -a * b * mean * mean * abc_lobe_share(BY_C, 1.0, b * mean, c)
        return (wp.static(2.0 * wp.pi) * mass * wp.length(wi + wo)) * beside_normals(mat, wi, wo)

    @wp.func
    def slopes(mat: record) -> wp.vec2:
        """Where S has fallen to a half."""
        exponent = wp.min(0.6931472 / wp.max(clamp_to(mat.C, MAX_C), 0.1), 8.0)
        x = (wp.exp(exponent) - 1.0) / wp.max(clamp_to(mat.B, MAX_B), 1.0)
        width = wp.clamp(wp.sqrt(2.0 * x), MIN_WIDTH, MAX_WIDTH)
        return wp.vec2(width, width)

    signed = SignedLobes(signed_abc_draw, signed_abc_weight)
    abc_sample = make_reflected_sample(record, draw, abc_eval, abc_pdf)
    return Functions(abc_sample, abc_eval, abc_pdf, slopes=slopes, signed=signed)


ABC = Model(
    "abc",
    (
        Color("specular_reflectance"),
        ComplexIndex(),
        Number("A", high=float("inf")),
        Number("B", high=MAX_B),
        Number("C", high=MAX_C),
    ),
    (LOBE_SMOOTH,),
    make_abc,
    glossy=True,
    signed=SIGNED,
)

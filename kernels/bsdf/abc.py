"""Glossy reflection by the ABC distribution of microfacet normals, whose tails are long.

With h the half vector and x = 1 - h_z [Löw, Kronander, Ynnerman and Unger 2012, eq. 20],

    f_s = F(<wi, h>) S(x) G / (cos(wi) cos(wo)),   S(x) = A / (1 + B x)^C,

F the Fresnel reflectance of a conductor and G the masking of V-shaped grooves. ``A`` scales the lobe and is not bound
by energy. Each derivative of S has one sign: the model serves to compare estimators of derivatives [BXB*24].

Sampling and digits: ``docs/theory/materials.md#the-abc-distribution``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.microfacet import MIN_COSINE, half_slope
from warp_psdr.kernels.bsdf.model import Color, ComplexIndex, Functions, Model, Number
from warp_psdr.kernels.bsdf.reflected import make_reflected_sample
from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.fresnel import fresnel_conductor_rgb
from warp_psdr.kernels.math import exp_ratio, log_ratio

#: Greatest ``B``, a lobe of some 0.1 degrees, and greatest ``C``.
MAX_B, MAX_C = 1.0e6, 100.0
#: Range of the widths that edges are sampled by.
MIN_WIDTH, MAX_WIDTH = 1.0e-3, 1.0


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


@functools.cache
def make_abc(record: type, _variant: str) -> Functions:
    """Return the model's functions."""

    @wp.func
    def abc_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        if wi[2] <= MIN_COSINE or wo[2] <= MIN_COSINE:
            return wp.vec3(0.0, 0.0, 0.0)
        h = wi + wo
        length = wp.sqrt(wp.dot(h, h))
        c = 0.5 * length
        # G / cos(wi): grooves hide nothing, or the lower one of the two directions.
        hidden = 2.0 * (h[2] / length) / c * (wo[2] / wp.max(wi[2], wo[2]))
        masking = wp.min(1.0 / wi[2], hidden)
        s = wp.exp(log_abc(sagitta(wi, wo), clamp_to(mat.B, MAX_B), clamp_to(mat.C, MAX_C)))
        fresnel = wp.cw_mul(mat.specular_reflectance, fresnel_conductor_rgb(c, mat.eta, mat.k))
        return (wp.max(0.0, mat.A) * s * masking) * fresnel

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
    def draw(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> wp.vec3:
        """``wi`` reflected at a normal drawn in proportion to S; it may point below."""
        x = abc_draw(clamp_to(mat.B, MAX_B), clamp_to(mat.C, MAX_C), v[1])
        r = wp.sqrt(x * (2.0 - x))
        phi = wp.static(2.0 * wp.pi) * v[0]
        n = wp.vec3(r * wp.cos(phi), r * wp.sin(phi), 1.0 - x)
        return wp.normalize(2.0 * wp.dot(wi, n) * n - wi)

    @wp.func
    def slopes(mat: record) -> wp.vec2:
        """Where S has fallen to a half."""
        exponent = wp.min(0.6931472 / wp.max(clamp_to(mat.C, MAX_C), 0.1), 8.0)
        x = (wp.exp(exponent) - 1.0) / wp.max(clamp_to(mat.B, MAX_B), 1.0)
        width = wp.clamp(wp.sqrt(2.0 * x), MIN_WIDTH, MAX_WIDTH)
        return wp.vec2(width, width)

    return Functions(make_reflected_sample(record, draw, abc_eval, abc_pdf), abc_eval, abc_pdf, slopes=slopes)


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
)

"""Exponentials and related functions by polynomials without branches, so that loops over lanes become SIMD.

The math library's functions take one number at a time. ``exponential`` and ``smooth_logarithm`` have derivatives, those
of their polynomials; the other functions give values only.
"""

import warp as wp

from warp_psdr.kernels.math import at_least, at_most

#: Arguments of ``exponential`` between which it is a normal float32.
LEAST_EXPONENT, MOST_EXPONENT = -87.0, 88.0
#: ln 2 in two parts; multiples of the first by whole numbers are exact.
LN2_HIGH, LN2_LOW = 0.693359375, -2.12194440e-4
LN2, INV_LN2 = 0.6931471805599453, 1.4426950408889634
#: Bits of 1 and of the root of 1/2 as float32, and where its exponent begins.
ONE_BITS, ROOT_HALF_BITS, EXPONENT_SHIFT = 0x3F800000, 0x3F3504F3, 23
#: Least argument of ``logarithm``, a normal float32.
LEAST_POSITIVE = 2.0e-38
#: Largest -log of ``inverse_erf``, where its fit ends.
LAST_TAIL = 17.0


@wp.func
def exponential(x: wp.float32) -> wp.float32:
    """exp(x), relative error below 2e-7; ``x`` is clamped to ``LEAST_EXPONENT`` and ``MOST_EXPONENT``."""
    y = at_least(LEAST_EXPONENT, at_most(MOST_EXPONENT, x))
    n = wp.floor(y * INV_LN2 + 0.5)
    f = (y - n * LN2_HIGH) - n * LN2_LOW
    # The series to its seventh power: the derivative is as good as the value.
    p = 1.0 / 720.0 + f * (1.0 / 5040.0)
    p = 1.0 + f * (1.0 + f * (0.5 + f * (1.0 / 6.0 + f * (1.0 / 24.0 + f * (1.0 / 120.0 + f * p)))))
    return p * wp.cast(ONE_BITS + (wp.int32(n) << EXPONENT_SHIFT), wp.float32)


@wp.func
def logarithm(x: wp.float32) -> wp.float32:
    """log(x) for positive ``x``, relative error below 3e-7, also next to 1."""
    bits = wp.cast(at_least(LEAST_POSITIVE, x), wp.int32)
    exponent = (bits - ROOT_HALF_BITS) >> EXPONENT_SHIFT
    # Between the roots of 1/2 and of 2; log(m) = 2 artanh((m - 1) / (m + 1)).
    m = wp.cast(bits - (exponent << EXPONENT_SHIFT), wp.float32)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    p = 0.6666677608911971 + z * (0.39977573593262195 + z * 0.29870948387878804)
    return wp.float32(exponent) * LN2 + s * (2.0 + z * p)


@wp.func
def smooth_logarithm(x: wp.float32) -> wp.float32:
    """``logarithm`` with its derivative, which is lost where bits are taken apart: that of a difference of value 0."""
    positive = at_least(LEAST_POSITIVE, x)
    fixed = wp.cast(wp.cast(positive, wp.int32), wp.float32)
    return logarithm(positive) + (positive - fixed) / fixed


@wp.func
def scaled_erfc(x: wp.float32) -> wp.float32:
    """exp(x^2) erfc(x) for ``x`` in [0, 10], relative error below 3e-7: a polynomial in 1 / (1 + x / 2)."""
    t = 1.0 / (1.0 + 0.5 * x)
    p = 0.28456208982847486 + t * -0.059066048214178574
    p = 0.27804225018042567 + t * (-0.4871757966562667 + t * p)
    p = 0.20268091768435725 + t * (-0.026610151115778163 + t * p)
    return t * (0.2820864269284289 + t * (0.28237513597753183 + t * (0.24310513281803972 + t * p)))


@wp.func
def inverse_erf(below: wp.float32, above: wp.float32) -> wp.float32:
    """X with erf(x) = ``below`` - 1 = 1 - ``above``, two positive numbers that add up to 2: tails keep their digits.

    [Giles 2012, Approximating the erfinv Function, single precision.]
    """
    w = wp.min(-logarithm(below * above), LAST_TAIL)
    a = w - 2.5
    p = 3.43273939e-07 + a * 2.81022636e-08
    p = -4.39150654e-06 + a * (-3.5233877e-06 + a * p)
    p = -0.00125372503 + a * (0.00021858087 + a * p)
    p = 1.50140941 + a * (0.246640727 + a * (-0.00417768164 + a * p))
    b = wp.sqrt(w) - 3.0
    q = 0.000100950558 + b * -0.000200214257
    q = -0.00367342844 + b * (0.00134934322 + b * q)
    q = -0.0076224613 + b * (0.00573950773 + b * q)
    q = 2.83297682 + b * (1.00167406 + b * (0.00943887047 + b * q))
    return wp.where(w < 5.0, p, q) * wp.where(below < above, below - 1.0, 1.0 - above)

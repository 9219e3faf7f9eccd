"""Silhouette points on a circle of a tube, as an eye sees them: all roots of a quadratic equation in (cos, sin).

The vector from the eye has the components alpha, beta along two axes across the tube. grad phi . (x - eye) = 0 reads

    (D - r (gamma cos + delta sin)) (alpha cos + beta sin + rho) = K.

In z = tan(theta / 2), or of the opposite angle, this is a quartic equation for -1 <= z <= 1. A polynomial is monotone
between the roots of its derivative, so no root is missed. The first axis is turned by ``TURN`` away from that vector:
from a direction, a tube of one radius has its silhouette at right angles to the vector, and roots at z = 1 would be
found twice, or in neither half.

Derivation: ``docs/theory/implicit.md#silhouettes-of-tubes``.
"""

import warp as wp

#: Coefficients of 1, z, ... z^4.
QUARTIC = wp.types.vector(length=5, dtype=wp.float32)
#: Most rounds of a search between two signs: bisections alone would leave 2^-24.
SEARCHES = 24
#: Step at which a search ends: half of the last digit of 1. Newton's steps double the digits, so that four to six do.
CLOSED = 6.0e-8
#: Cosine and sine of the angle from the way to the first axis, -85 degrees.
TURN = wp.constant(wp.vec2(0.08715574, -0.9961947))
#: Stands for no root.
NOWHERE = 2.0


@wp.struct
class CircleRoots:
    """Cosines and sines of up to four angles."""

    count: wp.int32
    cosine: wp.vec4
    sine: wp.vec4


@wp.func
def quartic_at(p: QUARTIC, z: wp.float32) -> wp.float32:
    return p[0] + z * (p[1] + z * (p[2] + z * (p[3] + z * p[4])))


@wp.func
def quartic_slope(p: QUARTIC) -> QUARTIC:
    return QUARTIC(p[1], 2.0 * p[2], 3.0 * p[3], 4.0 * p[4], 0.0)


@wp.func
def root_between(p: QUARTIC, a: wp.float32, b: wp.float32) -> wp.float32:
    """The root where a polynomial is monotone, by Newton's steps inside of a bracket; ``NOWHERE``: there is none."""
    below = quartic_at(p, a) < 0.0
    if below == (quartic_at(p, b) < 0.0):
        return wp.static(NOWHERE)
    slope = quartic_slope(p)
    low = wp.float32(a)
    high = wp.float32(b)
    z = 0.5 * (a + b)
    k = wp.int32(0)
    while k < wp.static(SEARCHES):
        value = quartic_at(p, z)
        if (value < 0.0) == below:
            low = z
        else:
            high = z
        fall = quartic_at(slope, z)
        following = z - value / wp.where(fall == 0.0, 1.0, fall)
        # False for NaN, too.
        if not (following > low and following < high):
            following = 0.5 * (low + high)
        k = wp.where(wp.abs(following - z) < wp.static(CLOSED), wp.static(SEARCHES), k + 1)
        z = following
    return z


@wp.func
def or_else(root: wp.float32, end: wp.float32) -> wp.float32:
    return wp.where(root == wp.static(NOWHERE), end, root)


@wp.func
def quartic_roots(p: QUARTIC) -> wp.vec4:
    """The roots in [-1, 1]; ``NOWHERE`` for those that are missing."""
    slope = quartic_slope(p)
    bend = quartic_slope(slope)
    # Roots of bend[0] + bend[1] z + bend[2] z^2.
    low = wp.float32(1.0)
    high = wp.float32(1.0)
    discriminant = bend[1] * bend[1] - 4.0 * bend[0] * bend[2]
    if discriminant > 0.0:
        q = -0.5 * (bend[1] + wp.where(bend[1] < 0.0, -1.0, 1.0) * wp.sqrt(discriminant))
        first = bend[0] / wp.where(q == 0.0, 1.0e-30, q)
        second = q / wp.where(bend[2] == 0.0, 1.0e-30, bend[2])
        low = wp.clamp(wp.min(first, second), -1.0, 1.0)
        high = wp.clamp(wp.max(first, second), -1.0, 1.0)
    m0 = or_else(root_between(slope, -1.0, low), low)
    m1 = or_else(root_between(slope, low, high), high)
    m2 = or_else(root_between(slope, high, 1.0), 1.0)
    return wp.vec4(
        root_between(p, -1.0, m0), root_between(p, m0, m1), root_between(p, m1, m2), root_between(p, m2, 1.0)
    )


@wp.func
def circle_roots(
    d: wp.float32,
    alpha: wp.float32,
    beta: wp.float32,
    gamma: wp.float32,
    delta: wp.float32,
    rho: wp.float32,
    k: wp.float32,
) -> CircleRoots:
    """Angles with (d - gamma cos - delta sin) (alpha cos + beta sin + rho) = k and a positive first factor."""
    cosines = wp.vec4(0.0, 0.0, 0.0, 0.0)
    sines = wp.vec4(0.0, 0.0, 0.0, 0.0)
    count = wp.int32(0)
    half = wp.int32(0)
    while half < 2:
        sign = 1.0 - 2.0 * wp.float32(half)
        a0 = d - sign * gamma
        a1 = -2.0 * sign * delta
        a2 = d + sign * gamma
        b0 = rho + sign * alpha
        b1 = 2.0 * sign * beta
        b2 = rho - sign * alpha
        p = QUARTIC(
            a0 * b0 - k,
            a0 * b1 + a1 * b0,
            a0 * b2 + a1 * b1 + a2 * b0 - 2.0 * k,
            a1 * b2 + a2 * b1,
            a2 * b2 - k,
        )
        roots = quartic_roots(p)
        i = wp.int32(0)
        while i < 4:
            z = roots[i]
            inverse = sign / (1.0 + z * z)
            cosine = (1.0 - z * z) * inverse
            sine = 2.0 * z * inverse
            if z != wp.static(NOWHERE) and d - gamma * cosine - delta * sine > 0.0 and count < 4:
                cosines[count] = cosine
                sines[count] = sine
                count += 1
            i += 1
        half += 1
    found = CircleRoots()
    found.count = count
    found.cosine = cosines
    found.sine = sines
    return found

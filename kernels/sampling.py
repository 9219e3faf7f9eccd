"""Warps from the unit square to directions and points, and the weights of multiple importance sampling."""

import warp as wp

from warp_psdr.kernels.constants import INV_FOUR_PI, INV_TWO_PI, PI, TWO_PI


@wp.func
def square_to_disk(u: wp.vec2) -> wp.vec2:
    """Uniform point on the unit disk; keeps areas and neighbours [Shirley and Chiu 1997]."""
    x = 2.0 * u[0] - 1.0
    y = 2.0 * u[1] - 1.0
    wide = wp.abs(x) > wp.abs(y)
    r = wp.where(wide, x, y)
    other = wp.where(wide, y, x)
    t = wp.where(r != 0.0, 0.25 * PI * (other / r), 0.0)
    # sin and cos on [-pi/4, pi/4] (minimax, error below 3e-7): a tenth of the cost of the library's.
    t2 = t * t
    sine = r * t * (1.0 + t2 * (-0.16666667 + t2 * (0.0083333310 + t2 * (-0.00019840874 + t2 * 2.7525562e-06))))
    cosine = r * (1.0 + t2 * (-0.5 + t2 * (0.041666645 + t2 * (-0.0013888216 + t2 * 2.4669870e-05))))
    return wp.vec2(wp.where(wide, cosine, sine), wp.where(wide, sine, cosine))


@wp.func
def disk_to_square(p: wp.vec2) -> wp.vec2:
    """The inverse of ``square_to_disk``."""
    wide = wp.abs(p[0]) > wp.abs(p[1])
    major = wp.where(wide, p[0], p[1])
    minor = wp.where(wide, p[1], p[0])
    r = wp.where(major < 0.0, -wp.length(p), wp.length(p))
    other = r * (4.0 / PI) * wp.atan(minor / wp.where(major == 0.0, 1.0, major))
    x = wp.where(wide, r, other)
    y = wp.where(wide, other, r)
    return wp.vec2(0.5 * (x + 1.0), 0.5 * (y + 1.0))


@wp.func
def square_to_cosine_hemisphere(u: wp.vec2) -> wp.vec3:
    """Direction about +z with density cos(theta) / pi [1/sr]."""
    p = square_to_disk(u)
    return wp.vec3(p[0], p[1], wp.sqrt(wp.max(0.0, 1.0 - p[0] * p[0] - p[1] * p[1])))


@wp.func
def unit_circle(turns: wp.float32) -> wp.vec2:
    """Cosine and sine of 2 pi ``turns`` for 0 <= ``turns`` <= 1, error below 3e-7: polynomials, nothing branches."""
    quarter = wp.floor(4.0 * turns + 0.5)
    t = 0.5 * PI * (4.0 * turns - quarter)
    t2 = t * t
    sine = t * (1.0 + t2 * (-0.16666667 + t2 * (0.0083333310 + t2 * (-0.00019840874 + t2 * 2.7525562e-06))))
    cosine = 1.0 + t2 * (-0.5 + t2 * (0.041666645 + t2 * (-0.0013888216 + t2 * 2.4669870e-05)))
    upright = quarter == 1.0 or quarter == 3.0
    x = wp.where(upright, -sine, cosine)
    y = wp.where(upright, cosine, sine)
    sign = wp.where(quarter == 2.0 or quarter == 3.0, -1.0, 1.0)
    return wp.vec2(sign * x, sign * y)


@wp.func
def square_to_sphere(u: wp.vec2) -> wp.vec3:
    """Uniform direction."""
    z = 1.0 - 2.0 * u[1]
    # (1 - z)(1 + z) instead of 1 - z^2: no cancellation near the poles.
    r = 2.0 * wp.sqrt(u[1] * (1.0 - u[1]))
    phi = TWO_PI * u[0]
    return wp.vec3(r * wp.cos(phi), r * wp.sin(phi), z)


@wp.func
def sphere_to_square(w: wp.vec3) -> wp.vec2:
    """The inverse of ``square_to_sphere``."""
    turn = wp.atan2(w[1], w[0]) * INV_TWO_PI
    return wp.vec2(wp.where(turn < 0.0, turn + 1.0, turn), 0.5 * (1.0 - w[2]))


@wp.func
def sphere_pdf() -> wp.float32:
    """Density of `square_to_sphere` [1/sr]."""
    return INV_FOUR_PI


@wp.func
def square_to_triangle(u: wp.vec2) -> wp.vec2:
    """Barycentrics (b1, b2), uniform in area; no square root, halves keep their neighbours [Heitz 2019]."""
    half = 0.5 * wp.min(u[0], u[1])
    first = u[0] < u[1]
    return wp.vec2(wp.where(first, half, u[0] - half), wp.where(first, u[1] - half, half))


@wp.func
def mis_weight(a: wp.float32, b: wp.float32) -> wp.float32:
    """Power heuristic a^2 / (a^2 + b^2) of two densities [Veach 1997, eq. 9.13]; the weights of a pair add up to one.

    Works with the ratio, so that neither a tiny nor an infinite density overflows; (0, 0) gives 0.
    """
    larger = a > b
    r = wp.where(larger, b, a) / wp.where(larger, a, b)
    weight = wp.where(larger, 1.0, r * r) / (1.0 + r * r)
    return wp.where(a == b, wp.where(a > 0.0, 0.5, 0.0), weight)

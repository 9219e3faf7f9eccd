"""Inverse trigonometric functions by polynomials, four times as fast as the math library's on the CPU. No derivatives.

Coefficients are near-minimax for the *relative* error (weighted least squares over Chebyshev nodes, reweighted by the
residual). Results therefore stay accurate next to zero, which the pole of an environment map needs. The errors named
below are those in float32, rounding included.
"""

import warp as wp

from warp_psdr.kernels.constants import PI


@wp.func
def arctan2(y: wp.float32, x: wp.float32) -> wp.float32:
    """Angle of the point (x, y) in [-pi, pi], relative error below 4e-7; 0 at the origin."""
    ax = wp.abs(x)
    ay = wp.abs(y)
    large = wp.max(ax, ay)
    a = wp.float32(0.0)
    if large > 0.0:
        a = wp.min(ax, ay) / large
    z = a * a
    # arctan(a) / a for a in [0, 1], a polynomial in a^2.
    p = -0.01606861501932144 + z * 0.0028498864267021418
    p = 0.04269149899482727 + z * p
    p = -0.07504292577505112 + z * p
    p = 0.10640933364629745 + z * p
    p = -0.14203643798828125 + z * p
    p = 0.1999261975288391 + z * p
    p = -0.3333307206630707 + z * p
    p = a * (1.0 + z * p)
    p = wp.where(ay > ax, 0.5 * PI - p, p)
    p = wp.where(x < 0.0, PI - p, p)
    return wp.where(y < 0.0, -p, p)


@wp.func
def sin_quarter(x: wp.float32) -> wp.float32:
    """sin(x pi / 2) for x in [-1, 1], relative error below 3e-7."""
    z = x * x
    p = -0.004673766437917948 + z * 0.00015148513193707913
    p = 0.07968968152999878 + z * p
    p = -0.645963728427887 + z * p
    return x * (1.5707963705062866 + z * p)


@wp.func
def circle(turns: wp.float32) -> wp.vec2:
    """Cosine and sine of 2 pi ``turns``, any non-negative number of them, error below 3e-7."""
    quarters = 4.0 * turns
    whole = wp.floor(quarters)
    s = sin_quarter(quarters - whole)
    c = sin_quarter(1.0 - (quarters - whole))
    quadrant = wp.int32(whole) & 3
    swap = (quadrant & 1) == 1
    x = wp.where(swap, s, c)
    y = wp.where(swap, c, s)
    return wp.vec2(wp.where(quadrant == 1 or quadrant == 2, -x, x), wp.where(quadrant >= 2, -y, y))

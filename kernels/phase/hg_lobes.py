"""The two lobes of one sign of the derivative of ``hg`` by g [BXB*24]: negative backward, positive forward.

With 1 + g^2 - 2 g mu = (1 - g y)^2, so that mu = y + g (1 - y^2) / 2, a cosine lies below mu with a probability whose
derivative by g is -K(y), K(y) = (1 - y^2) (3 - 2 g y - g^2) / (4 (1 - g y)^3). Nothing cancels as g vanishes. K is
greatest where the derivative of the density changes its sign, at mu = g (5 - g^2) / (3 + g^2).

Derivation: ``docs/theory/media.md#lobes-of-a-phase-function``.
"""

import warp as wp

from warp_psdr.kernels.phase.hg import hg_slope

#: Steps of Newton's method, with bisection where it leaves the bracket.
LOBE_STEPS = 12


@wp.func
def hg_place(g: wp.float32, y: wp.float32) -> wp.float32:
    """The cosine mu that belongs to y in [-1, 1]."""
    return wp.clamp(y + 0.5 * g * (1.0 - y * y), -1.0, 1.0)


@wp.func
def hg_lobe_share(g: wp.float32, y: wp.float32) -> wp.float32:
    """K(y): the mass of the backward lobe below y, which is that of the forward one above."""
    q = 1.0 - g * y
    return 0.25 * (1.0 - y) * (1.0 + y) * (3.0 - 2.0 * g * y - g * g) / (q * q * q)


@wp.func
def hg_turn(g: wp.float32) -> wp.float32:
    """Y where the derivative changes its sign: (1 - q) / g with q^2 = 3 (1 - g^2)^2 / (3 + g^2)."""
    g2 = g * g
    q = (1.0 - g2) * wp.sqrt(3.0 / (3.0 + g2))
    return g * (7.0 - 3.0 * g2) / ((3.0 + g2) * (1.0 + q))


@wp.func
def hg_lobe_mass(g: wp.float32) -> wp.float32:
    """The integral of either lobe over all directions."""
    return hg_lobe_share(g, hg_turn(g))


@wp.func
def hg_lobe_cosine(g: wp.float32, forward: wp.bool, u: wp.float32) -> wp.float32:
    """Cosine of a direction that is drawn from a lobe by u."""
    turn = hg_turn(g)
    part = u * hg_lobe_share(g, turn)
    low = wp.where(forward, turn, -1.0)
    high = wp.where(forward, 1.0, turn)
    end = wp.where(forward, high, low)
    y = end + (turn - end) * (1.0 - wp.sqrt(wp.max(1.0 - u, 0.0)))
    for _i in range(wp.static(LOBE_STEPS)):
        f = hg_lobe_share(g, y) - part
        # K falls towards both ends.
        beyond = (f > 0.0) == forward
        low = wp.where(beyond, y, low)
        high = wp.where(beyond, high, y)
        # dK/dy = -2 pi (derivative of f_p) dmu/dy.
        slope = wp.static(-2.0 * wp.pi) * hg_slope(g, hg_place(g, y)) * (1.0 - g * y)
        newton = y - f / wp.where(wp.abs(slope) < 1.0e-12, 1.0, slope)
        y = wp.where(newton >= low and newton <= high, newton, 0.5 * (low + high))
    return hg_place(g, y)

"""The phase function of Henyey and Greenstein 1941 (Mitsuba's ``hg``), g the mean cosine; g > 0 scatters forward.

With mu the cosine between the direction of flight and the new one, f_p = (1 - g^2) / (4 pi (1 + g^2 - 2 g mu)^(3/2)).
"""

import warp as wp

from warp_psdr.kernels.constants import INV_FOUR_PI


@wp.func
def hg_eval(g: wp.float32, mu: wp.float32) -> wp.float32:
    """Value and density, 1/sr."""
    s = 1.0 + g * g - 2.0 * g * mu
    return INV_FOUR_PI * (1.0 - g * g) / (s * wp.sqrt(s))


@wp.func
def hg_slope(g: wp.float32, mu: wp.float32) -> wp.float32:
    """The derivative by g, 1/sr."""
    s = 1.0 + g * g - 2.0 * g * mu
    return hg_eval(g, mu) * (3.0 * (mu - g) / s - 2.0 * g / (1.0 - g * g))


@wp.func
def hg_by_cosine(g: wp.float32, mu: wp.float32) -> wp.float32:
    """The derivative by mu, 1/sr."""
    return 3.0 * g / (1.0 + g * g - 2.0 * g * mu) * hg_eval(g, mu)


@wp.func
def hg_cosine(g: wp.float32, u: wp.float32) -> wp.float32:
    """Cosine of a direction that is drawn by u.

    The inverse of the distribution, (1 + g^2 - ((1 - g^2) / (1 + g x))^2) / (2 g) with x = 2 u - 1, multiplied out:
    nothing cancels as g vanishes.
    """
    x = 2.0 * u - 1.0
    a = 1.0 / (1.0 + g * x)
    mu = a * a * (x + g * (0.5 * (x * x + 3.0) + g * (x + 0.5 * g * (x * x - 1.0))))
    return wp.clamp(mu, -1.0, 1.0)

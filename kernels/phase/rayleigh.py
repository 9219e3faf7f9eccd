"""Rayleigh scattering by particles much smaller than the wavelength (Mitsuba's ``rayleigh``).

With mu the cosine between the direction of flight and the new one, f_p = 3 (1 + mu^2) / (16 pi).
"""

import warp as wp

from warp_psdr.kernels.constants import INV_PI


@wp.func
def rayleigh_eval(mu: wp.float32) -> wp.float32:
    """Value and density, 1/sr."""
    return 0.1875 * INV_PI * (1.0 + mu * mu)


@wp.func
def rayleigh_by_cosine(mu: wp.float32) -> wp.float32:
    """The derivative by mu, 1/sr."""
    return 0.375 * INV_PI * mu


@wp.func
def rayleigh_cosine(u: wp.float32) -> wp.float32:
    """Cosine of a direction that is drawn by u: the root of mu^3 + 3 mu = 4 (2 u - 1), by Cardano's formula."""
    z = 4.0 * u - 2.0
    a = wp.pow(z + wp.sqrt(z * z + 1.0), 1.0 / 3.0)
    return wp.clamp(a - 1.0 / a, -1.0, 1.0)

"""Isotropic scattering, evenly into all directions (Mitsuba's ``isotropic``): f_p = 1 / (4 pi)."""

import warp as wp

from warp_psdr.kernels.constants import INV_FOUR_PI


@wp.func
def isotropic_eval() -> wp.float32:
    """Value and density, 1/sr."""
    return INV_FOUR_PI


@wp.func
def isotropic_cosine(u: wp.float32) -> wp.float32:
    """Cosine of a direction that is drawn by u."""
    return 2.0 * u - 1.0

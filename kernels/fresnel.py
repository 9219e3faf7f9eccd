"""Reflectance of an interface between two media for unpolarised light (Fresnel's equations).

Both are written so that neither value nor derivative cancels, divides by zero or takes the root of zero at normal
incidence, at grazing angles, at equal indices, and for a perfect mirror (eta = 0, k = 1).
"""

import warp as wp

from warp_psdr.kernels.math import at_least, at_most, safe_sqrt, where_number

#: Floor of the squared modulus of eta'^2 - sin^2 (conductor). The reflectance has a root singularity where that is 0
#: (the critical angle of a lossless medium): there the floor puts derivative 0 in place of infinity, and keeps a or b,
#: and with it both denominators, from 0.
MIN_SQUARED_MODULUS = 1.0e-24


@wp.func
def fresnel_conductor(c: wp.float32, eta: wp.float32, k: wp.float32) -> wp.float32:
    """Reflectance of a medium with complex index ``eta + i k`` (relative to the incident side) at cosine ``c`` > 0.

    With the complex root a + i b of (eta + i k)^2 - sin^2,

        R_s = ((c - a)^2 + b^2) / ((c + a)^2 + b^2),
        R_p / R_s = ((a c - sin^2)^2 + b^2 c^2) / ((a c + sin^2)^2 + b^2 c^2).

    The larger of a and b comes from a root, the other from a b = eta k: nothing cancels in a good metal, and eta = 0
    has a finite derivative. eta^2 - sin^2 is written so that it keeps its digits both for eta near 0 (at normal
    incidence) and near 1 (at grazing angles).
    """
    sin2 = (1.0 - c) * (1.0 + c)
    x = where_number(eta < 0.5, eta * eta - sin2, (eta - 1.0) * (eta + 1.0) + c * c) - k * k
    half_y = eta * k
    modulus = wp.sqrt(at_least(MIN_SQUARED_MODULUS, x * x + 4.0 * half_y * half_y))
    larger = wp.sqrt(0.5 * (modulus + wp.abs(x)))
    smaller = half_y / larger
    a = where_number(x < 0.0, smaller, larger)
    b = where_number(x < 0.0, larger, smaller)
    r_s = ((c - a) * (c - a) + b * b) / ((c + a) * (c + a) + b * b)
    p_minus = a * c - sin2
    p_plus = a * c + sin2
    b2c2 = b * b * c * c
    r_p = r_s * (p_minus * p_minus + b2c2) / (p_plus * p_plus + b2c2)
    return 0.5 * (r_s + r_p)


@wp.func
def fresnel_conductor_rgb(c: wp.float32, eta: wp.vec3, k: wp.vec3) -> wp.vec3:
    """``fresnel_conductor`` of each colour channel."""
    return wp.vec3(
        fresnel_conductor(c, eta[0], k[0]), fresnel_conductor(c, eta[1], k[1]), fresnel_conductor(c, eta[2], k[2])
    )


@wp.func
def index_behind(ior: wp.float32, z: wp.float32) -> wp.float32:
    """Index on the other side of an interface over the one on the side of a direction with the local cosine ``z``.

    ``ior`` is the index below (z < 0) over the one above.
    """
    return where_number(z < 0.0, 1.0 / ior, ior)


@wp.func
def refracted_cosine(c: wp.float32, eta: wp.float32) -> wp.float32:
    """``eta`` times the cosine of the refracted ray, sqrt(eta^2 - 1 + c^2); 0 under total internal reflection.

    ``c`` is the cosine on the incident side, ``eta`` the index behind the interface over the one on the incident side.
    """
    return safe_sqrt((eta - 1.0) * (eta + 1.0) + c * c)


@wp.func
def fresnel_dielectric(c: wp.float32, g: wp.float32, eta: wp.float32) -> wp.float32:
    """Reflectance of a lossless interface; ``c`` > 0, ``eta`` and ``g`` as in ``refracted_cosine``.

    r_s = (c - g) / (c + g) and r_p = (eta^2 c - g) / (eta^2 c + g), both expanded by their denominators: eta^2 - 1 then
    stands as a factor, and equal indices give exactly zero.
    """
    passes = g > 0.0
    behind = where_number(passes, g, 1.0)
    contrast = (eta - 1.0) * (eta + 1.0)
    eta2 = eta * eta
    s = c + behind
    p = eta2 * c + behind
    r_s = contrast / (s * s)
    r_p = contrast * (c * c * (eta2 + 1.0) - 1.0) / (p * p)
    # At grazing angles it exceeds 1 by rounding, and what is transmitted would be negative.
    return where_number(passes, at_most(1.0, 0.5 * (r_s * r_s + r_p * r_p)), 1.0)


@wp.func
def coat_reflectance(c: wp.float32, eta: wp.float32) -> wp.float32:
    """Reflectance of a smooth interface at the cosine ``c`` > 0; ``eta``: the index behind it over that in front."""
    return fresnel_dielectric(c, refracted_cosine(c, eta), eta)


@wp.func
def coat_reflectance_by_index(c: wp.float32, eta: wp.float32) -> wp.float32:
    """The derivative of ``coat_reflectance`` by ``eta``; 0 under total internal reflection.

    With T_s = 4 c g / (c + g)^2, T_p = 4 c g eta^2 / (eta^2 c + g)^2 and dg/deta = eta / g,

        dF/deta = 2 c eta / g ((g - c) / (c + g)^3 + (2 g^2 - eta^2) (eta^2 c - g) / (eta^2 c + g)^3).
    """
    g = refracted_cosine(c, eta)
    rate = wp.float32(0.0)
    if g > 0.0:
        eta2 = eta * eta
        s = c + g
        p = eta2 * c + g
        rate = 2.0 * c * eta / g * ((g - c) / (s * s * s) + (2.0 * g * g - eta2) * (eta2 * c - g) / (p * p * p))
    return rate


@wp.func
def coat_transmittance(c: wp.float32, eta: wp.float32) -> wp.float32:
    """Transmittance of a smooth interface at the cosine ``c``: 1 - F without the difference, which cancels."""
    g = refracted_cosine(c, eta)
    passes = g > 0.0
    behind = where_number(passes, g, 1.0)
    s = c + behind
    p = eta * eta * c + behind
    return where_number(passes, 2.0 * c * behind * (1.0 / (s * s) + eta * eta / (p * p)), 0.0)

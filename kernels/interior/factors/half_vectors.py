"""Directions whose half vectors are mirror images of each other about the normal.

Derivation: ``docs/theory/interior.md#antithetic-pairs``.
"""

import warp as wp

from warp_psdr.kernels.fresnel import refracted_cosine
from warp_psdr.kernels.math import refract_at, unit_vector

#: Squared length of wi + wo below which the two graze the surface from opposite sides.
MIN_SQUARED = 1.0e-10


@wp.struct
class Mirrored:
    """A direction with the mirrored half vector, and the factors J = dw / dh of both."""

    wo: wp.vec3
    own: wp.float32  # J of the direction that was given
    other: wp.float32  # of its partner; 0: there is none


@wp.func
def mirrored(wi: wp.vec3, wo: wp.vec3, m: wp.vec3, eta: wp.float32) -> Mirrored:
    """The partner of a direction, whose half vector h becomes 2 (h . m) m - h.

    J = 4 wi . h of what is reflected, |wi + eta wo|^2 / (eta^2 |wo . h|) of what is refracted, with ``eta`` the index
    behind the surface over that in front; 1: what passes is its own partner. There is none where wi does not see the
    mirrored microfacet, where it would be reflected into the surface or refracted out of it, and under total internal
    reflection.
    """
    r = Mirrored()
    r.own = 1.0
    side = wp.dot(wi, m)
    if side * wp.dot(wo, m) > 0.0:
        h = wi + wo
        if wp.dot(h, h) > MIN_SQUARED:
            h = unit_vector(h)
            r.own = 4.0 * wp.dot(wi, h)
            h = 2.0 * wp.dot(h, m) * m - h
            c = wp.dot(wi, h)
            r.wo = unit_vector(2.0 * c * h - wi)
            if c > 0.0 and side * wp.dot(r.wo, m) > 0.0:
                r.other = 4.0 * c
        return r
    h = wi + eta * wo
    square = wp.dot(h, h)
    if eta != 1.0 and square > MIN_SQUARED:
        h = unit_vector(h)
        h = wp.where(wp.dot(wi, h) < 0.0, -h, h)
        c_o = wp.dot(wo, h)
        if c_o < 0.0:
            r.own = -square / (eta * eta * c_o)
            h = 2.0 * wp.dot(h, m) * m - h
            c = wp.dot(wi, h)
            g = refracted_cosine(c, eta)
            if c > 0.0 and g > 0.0:
                r.wo = unit_vector(refract_at(wi, h, c, g, eta))
                if side * wp.dot(r.wo, m) < 0.0:
                    # wi + eta wo' = (wi . h' - g) h', and eta wo' . h' = -g.
                    r.other = (c - g) * (c - g) / (eta * g)
    return r

"""Directions whose half vectors are mirror images of each other about the normal.

Derivation: ``docs/theory/interior.md#antithetic-pairs``.
"""

import warp as wp

from warp_psdr.kernels.math import unit_vector

#: Squared length of wi + wo below which the two graze the surface from opposite sides.
MIN_SQUARED = 1.0e-10


@wp.struct
class Mirrored:
    """A direction with the mirrored half vector, and the factors J = dw / dh of both."""

    wo: wp.vec3
    own: wp.float32  # J of the direction that was given
    other: wp.float32  # of its partner; 0: there is none


@wp.func
def mirrored(wi: wp.vec3, wo: wp.vec3, m: wp.vec3) -> Mirrored:
    """The partner of a reflected direction, whose half vector h becomes 2 (h . m) m - h.

    J = 4 wi . h. What is refracted is its own partner. There is none where wi does not see the mirrored microfacet, or
    where it would reflect into the surface.
    """
    r = Mirrored()
    r.own = 1.0
    side = wp.dot(wi, m)
    h = wi + wo
    if side * wp.dot(wo, m) > 0.0 and wp.dot(h, h) > MIN_SQUARED:
        h = unit_vector(h)
        r.own = 4.0 * wp.dot(wi, h)
        h = 2.0 * wp.dot(h, m) * m - h
        c = wp.dot(wi, h)
        r.wo = unit_vector(2.0 * c * h - wi)
        if c > 0.0 and side * wp.dot(r.wo, m) > 0.0:
            r.other = 4.0 * c
    return r

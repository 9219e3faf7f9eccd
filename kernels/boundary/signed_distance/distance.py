"""Signed distances in world coordinates: value, gradient and Hessian along a ray, and their derivatives.

A kind of shape is a ``Field``. phi is positive outside, in world units. If phi is not a distance, only its zero set
counts: velocities are divided by its slope, and steps may differ from it. Next to silhouettes phi is far smaller than
the float32 rounding of a position, so it is computed in double precision. Poses are similarities.

Derivation: ``docs/theory/signed_distances.md#the-motion-of-rays``.
"""

from collections.abc import Callable
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.primitive.affine import determinant
from warp_psdr.kernels.structs import Triangle


@wp.struct
class Distance:
    """Phi at a place, and its derivatives there."""

    phi: wp.float32
    step: wp.float32  # at most the distance from the surface, positive: where phi is one, |phi|
    step_gradient: wp.vec3
    gradient: wp.vec3
    hessian: wp.mat33
    inside: wp.float32  # share of the weight that the place has: 0 at the border of where phi is known, and beyond
    inside_gradient: wp.vec3


@wp.struct
class KnownRange:
    """The part of a ray on which phi is known; none if ``last`` is not behind ``first``."""

    first: wp.float32
    first_w: wp.vec3  # its gradient by the direction
    last: wp.float32


class Field(NamedTuple):
    """The functions of a kind of shape; ``tri`` is its record, ``o`` and ``w`` are a ray, w a unit vector.

    Attributes:
        size: ``(tri) -> float32``: unit of length of the weights, world units.
        known: ``(scene, tri, o, w) -> KnownRange``.
        at: ``(scene, tri, o, w, t: float64) -> Distance``: at o + t w.
        make_pull: role -> ``pull(scene, target, tri, x, a_phi, a_g) -> float32``: a sink of ``a_phi . phi_pi + a_g .
            grad phi_pi`` at a place x that rests.
        convex: it hides nothing from its own points.
    """

    size: wp.Function
    known: wp.Function
    at: wp.Function
    make_pull: Callable[[str], wp.Function]
    convex: bool


@wp.func
def similar_scale(tri: Triangle) -> wp.float32:
    """Scale of a pose that is a similarity."""
    return wp.pow(wp.abs(determinant(tri)), wp.static(1.0 / 3.0))

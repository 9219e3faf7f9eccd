"""Silhouettes of the unit sphere: the functions of a kind for ``dispatch.py``, in the coordinates of the shape.

From a point e outside, |e| > 1, the silhouette is the circle q . e = 1 with the centre e / |e|^2 and the radius sqrt(1
- 1 / |e|^2). From infinity it is a great circle. An affine map turns silhouettes into silhouettes, and the sphere into
any ellipsoid.

Derivation: ``docs/theory/implicit.md#silhouettes``.
"""

import warp as wp

from warp_psdr.kernels.constants import FOUR_PI, TWO_PI
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.sampling import square_to_sphere

#: Area of the surface on which ``sphere_place`` is uniform.
SPHERE_AREA = FOUR_PI


@wp.func
def circle_radius(eye: wp.vec3, distant: wp.bool) -> wp.float32:
    """Radius of the silhouette; 0: there is none, the eye is inside."""
    squared = wp.dot(eye, eye)
    some = distant or squared > 1.0
    return wp.where(some, wp.sqrt(1.0 - wp.where(distant or squared <= 1.0, 0.0, 1.0 / squared)), 0.0)


@wp.func
def sphere_silhouette(eye: wp.vec3, distant: wp.bool, u: wp.float32) -> tuple[wp.vec3, wp.bool]:
    """Point of the silhouette a fraction u of the way around it, and whether there is one.

    ``distant``: the eye is the direction of a point at infinity.
    """
    axis = wp.normalize(eye)
    radius = circle_radius(eye, distant)
    a = any_tangent(axis)
    b = wp.cross(axis, a)
    phi = TWO_PI * u
    around = wp.cos(phi) * a + wp.sin(phi) * b
    height = wp.where(distant, 0.0, 1.0 / wp.max(wp.length(eye), 1.0))
    return wp.normalize(height * axis + radius * around), radius > 0.0


@wp.func
def sphere_silhouette_rate(eye: wp.vec3, distant: wp.bool, q: wp.vec3) -> wp.vec3:
    """Dq / du of that point."""
    return TWO_PI * circle_radius(eye, distant) * wp.normalize(wp.cross(eye, q))


@wp.func
def sphere_place(u: wp.vec2) -> wp.vec3:
    """Point of the sphere, uniform in area."""
    return square_to_sphere(u)


@wp.func
def sphere_gradient(q: wp.vec3) -> wp.vec3:
    """Gradient of phi = (|q|^2 - 1) / 2, which is positive outside."""
    return q


@wp.func
def sphere_bend(q: wp.vec3, w: wp.vec3) -> wp.float32:
    """w^T H w, H the Hessian of phi."""
    return wp.dot(w, w)

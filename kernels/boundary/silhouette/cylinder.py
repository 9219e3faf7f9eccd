"""Outlines of the open unit cylinder, and rims of cylinder and disk, for ``dispatch.py`` and ``rim.py``.

From a point e farther from the axis than 1, the silhouette is two lines along the axis, through the points of the unit
circle where q . e = 1 across the axis. From a direction it is the two lines where q . e = 0. Each line has one half of
the parameter u, from z = 0 to z = 1.

Derivation: ``docs/theory/implicit.md#silhouettes``.
"""

import warp as wp

from warp_psdr.kernels.constants import TWO_PI

#: Area of the surface on which ``cylinder_place`` is uniform.
CYLINDER_AREA = TWO_PI


@wp.func
def cylinder_silhouette(eye: wp.vec3, distant: wp.bool, u: wp.float32) -> tuple[wp.vec3, wp.bool]:
    """Point of the silhouette, and whether there is one; ``distant``: the eye is the direction of one at infinity."""
    squared = eye[0] * eye[0] + eye[1] * eye[1]
    some = squared > wp.where(distant, 0.0, 1.0)
    length = wp.sqrt(wp.where(some, squared, 1.0))
    c = wp.where(distant, 0.0, 1.0 / length)
    s = wp.sqrt(wp.max(1.0 - c * c, 0.0))
    first = u < 0.5
    side = wp.where(first, s, -s)
    ex = eye[0] / length
    ey = eye[1] / length
    return wp.vec3(c * ex - side * ey, c * ey + side * ex, 2.0 * u - wp.where(first, 0.0, 1.0)), some


@wp.func
def cylinder_silhouette_rate(eye: wp.vec3, distant: wp.bool, q: wp.vec3) -> wp.vec3:
    """Dq / du of that point."""
    return wp.vec3(0.0, 0.0, 2.0)


@wp.func
def cylinder_place(u: wp.vec2) -> wp.vec3:
    """Point of the cylinder, uniform in area."""
    phi = TWO_PI * u[0]
    return wp.vec3(wp.cos(phi), wp.sin(phi), u[1])


@wp.func
def cylinder_gradient(q: wp.vec3) -> wp.vec3:
    """Gradient of phi = (x^2 + y^2 - 1) / 2, which is positive outside."""
    return wp.vec3(q[0], q[1], 0.0)


@wp.func
def cylinder_bend(q: wp.vec3, w: wp.vec3) -> wp.float32:
    """w^T H w, H the Hessian of phi: diag(1, 1, 0)."""
    return w[0] * w[0] + w[1] * w[1]

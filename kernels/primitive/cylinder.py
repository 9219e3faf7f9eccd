"""The open cylinder x^2 + y^2 = 1, 0 <= z <= 1, seen from both sides: the functions of a kind for ``affine.py``.

A point q is held as its azimuth and its height, in which area is uniform. Texture coordinates are Mitsuba's: (azimuth /
2 pi, height).

Derivation: ``docs/theory/implicit.md#kinds``.
"""

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import INV_TWO_PI, TWO_PI


@wp.func
def cylinder_point(u: wp.float32, v: wp.float32) -> wp.vec3:
    return wp.vec3(wp.cos(u), wp.sin(u), v)


@wp.func
def cylinder_coordinates(q: wp.vec3) -> wp.vec2:
    """Azimuth, in [-pi, pi], and height of a point."""
    return wp.vec2(wp.atan2(q[1], q[0]), q[2])


@wp.func
def cylinder_hit(o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
    """The first point of the line o + t d, 0 < t < t_max, on the cylinder; ``face`` is -1 if there is none.

    Across the axis it is the equation of ``sphere_hit``, solved as there; a root counts if its height is in [0, 1].
    """
    hit = RayHit()
    hit.t = t_max
    hit.face = -1
    squared = d[0] * d[0] + d[1] * d[1]
    if squared > 0.0:
        s = -(o[0] * d[0] + o[1] * d[1]) / squared
        x = o[0] + s * d[0]
        y = o[1] + s * d[1]
        inside = 1.0 - x * x - y * y
        if inside >= 0.0:
            half = wp.sqrt(inside / squared)
            far = s + wp.where(s < 0.0, -half, half)
            length = wp.sqrt(o[0] * o[0] + o[1] * o[1])
            near = (length - 1.0) * (length + 1.0) / (squared * wp.where(far == 0.0, 1.0, far))
            t = wp.min(near, far)
            z = o[2] + t * d[2]
            if t <= 0.0 or z < 0.0 or z > 1.0:
                t = wp.max(near, far)
                z = o[2] + t * d[2]
            if t > 0.0 and t < t_max and z >= 0.0 and z <= 1.0:
                hit.t = t
                hit.u = wp.atan2(o[1] + t * d[1], o[0] + t * d[0])
                hit.v = z
                hit.face = 0
    return hit


@wp.func
def cylinder_normal(q: wp.vec3) -> wp.vec3:
    """Normal whose length is the area element of the kind."""
    return wp.vec3(q[0], q[1], 0.0)


@wp.func
def cylinder_tangents(q: wp.vec3) -> tuple[wp.vec3, wp.vec3]:
    """dp/du and dp/dv."""
    return TWO_PI * wp.vec3(-q[1], q[0], 0.0), wp.vec3(0.0, 0.0, 1.0)


@wp.func
def cylinder_uv(q: wp.vec3) -> wp.vec2:
    azimuth = INV_TWO_PI * wp.atan2(q[1], q[0])
    return wp.vec2(wp.where(azimuth < 0.0, azimuth + 1.0, azimuth), q[2])


@wp.func
def cylinder_rates(q: wp.vec3, q_dot: wp.vec3) -> tuple[wp.vec3, wp.vec3, wp.vec2]:
    """Velocities of normal, dp/du and texture coordinates for a velocity of q in the surface."""
    uv = wp.vec2(INV_TWO_PI * (q[0] * q_dot[1] - q[1] * q_dot[0]), q_dot[2])
    return wp.vec3(q_dot[0], q_dot[1], 0.0), TWO_PI * wp.vec3(-q_dot[1], q_dot[0], 0.0), uv


@wp.func
def cylinder_pull(q: wp.vec3, a_n: wp.vec3, a_tangent: wp.vec3, a_uv: wp.vec2) -> wp.vec3:
    """The transpose: adjoint of q from those of normal, dp/du and texture coordinates."""
    turn = INV_TWO_PI * a_uv[0]
    return wp.vec3(
        a_n[0] + TWO_PI * a_tangent[1] - q[1] * turn,
        a_n[1] - TWO_PI * a_tangent[0] + q[0] * turn,
        a_uv[1],
    )

"""The unit disk in the plane z = 0, seen from both sides: the functions of a kind for ``affine.py``.

A point q is held as its x and y. Texture coordinates are Mitsuba's: (distance from the centre, azimuth / 2 pi).

Derivation: ``docs/theory/implicit.md#kinds``.
"""

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import INV_TWO_PI, TWO_PI

#: Squared distance from the centre within which azimuths have the derivative of a point at this distance.
CENTER = 1.0e-12


@wp.func
def disk_point(u: wp.float32, v: wp.float32) -> wp.vec3:
    return wp.vec3(u, v, 0.0)


@wp.func
def disk_coordinates(q: wp.vec3) -> wp.vec2:
    return wp.vec2(q[0], q[1])


@wp.func
def disk_hit(o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
    """The point of the line o + t d, 0 < t < t_max, on the unit disk; ``face`` is -1 if there is none."""
    hit = RayHit()
    hit.t = t_max
    hit.face = -1
    if d[2] != 0.0:
        t = -o[2] / d[2]
        x = o[0] + t * d[0]
        y = o[1] + t * d[1]
        if t > 0.0 and t < t_max and x * x + y * y <= 1.0:
            hit.t = t
            hit.u = x
            hit.v = y
            hit.face = 0
    return hit


@wp.func
def disk_normal(q: wp.vec3) -> wp.vec3:
    """Normal whose length is the area element of the kind."""
    return wp.vec3(0.0, 0.0, 1.0)


@wp.func
def disk_tangents(q: wp.vec3) -> tuple[wp.vec3, wp.vec3]:
    """dp/du and dp/dv."""
    r = wp.sqrt(q[0] * q[0] + q[1] * q[1])
    c = wp.where(r > 0.0, q[0] / wp.where(r > 0.0, r, 1.0), 1.0)
    s = wp.where(r > 0.0, q[1] / wp.where(r > 0.0, r, 1.0), 0.0)
    return wp.vec3(c, s, 0.0), TWO_PI * wp.vec3(-q[1], q[0], 0.0)


@wp.func
def disk_uv(q: wp.vec3) -> wp.vec2:
    azimuth = INV_TWO_PI * wp.atan2(q[1], q[0])
    return wp.vec2(wp.sqrt(q[0] * q[0] + q[1] * q[1]), wp.where(azimuth < 0.0, azimuth + 1.0, azimuth))


@wp.func
def disk_rates(q: wp.vec3, q_dot: wp.vec3) -> tuple[wp.vec3, wp.vec3, wp.vec2]:
    """Velocities of normal, dp/du and texture coordinates for a velocity of q in the disk."""
    squared = wp.max(q[0] * q[0] + q[1] * q[1], CENTER)
    r = wp.sqrt(squared)
    turn = (q[0] * q_dot[1] - q[1] * q_dot[0]) / squared
    uv = wp.vec2((q[0] * q_dot[0] + q[1] * q_dot[1]) / r, INV_TWO_PI * turn)
    return wp.vec3(0.0, 0.0, 0.0), (turn / r) * wp.vec3(-q[1], q[0], 0.0), uv


@wp.func
def disk_pull(q: wp.vec3, a_n: wp.vec3, a_tangent: wp.vec3, a_uv: wp.vec2) -> wp.vec3:
    """The transpose: adjoint of q from those of normal, dp/du and texture coordinates."""
    squared = wp.max(q[0] * q[0] + q[1] * q[1], CENTER)
    r = wp.sqrt(squared)
    turn = ((q[0] * a_tangent[1] - q[1] * a_tangent[0]) / r + INV_TWO_PI * a_uv[1]) / squared
    return wp.vec3(a_uv[0] * q[0] / r - q[1] * turn, a_uv[0] * q[1] / r + q[0] * turn, 0.0)

"""The unit disk in the plane z = 0, seen from both sides, in its own coordinates.

A point q is held as its x and y. Texture coordinates are Mitsuba's: (distance from the centre, azimuth / 2 pi). It has
no smooth silhouette; its rim is an open edge, a silhouette from everywhere.

Derivation: ``docs/theory/implicit.md#kinds``, ``#rims``.
"""

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import INV_TWO_PI, PI, TWO_PI
from warp_psdr.kernels.math import share_of_turn
from warp_psdr.kernels.primitive.affine_kind import affine_kind
from warp_psdr.kernels.primitive.kind import TINY, Affine, Graze, Light, Rim
from warp_psdr.kernels.sampling import disk_to_square, square_to_disk

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


# ---- Its rim ----


@wp.func
def disk_rim(u: wp.float32) -> wp.vec3:
    phi = TWO_PI * u
    return wp.vec3(wp.cos(phi), wp.sin(phi), 0.0)


@wp.func
def disk_rim_rate(q: wp.vec3) -> wp.vec3:
    """Dq / du."""
    return TWO_PI * wp.vec3(-q[1], q[0], 0.0)


@wp.func
def disk_into(q: wp.vec3) -> wp.vec3:
    """Way from the rim along the surface."""
    return wp.vec3(-q[0], -q[1], 0.0)


@wp.func
def disk_rim_near(q: wp.vec3) -> wp.float32:
    """U of the point of a rim that is nearest to a point of the surface."""
    return share_of_turn(q[1], q[0])


@wp.func
def disk_level(q: wp.vec3) -> wp.vec4:
    return wp.vec4(0.0, 0.0, 1.0, q[2])


@wp.func
def disk_graze(hit: wp.vec3, o: wp.vec3, d: wp.vec3) -> Graze:
    r = Graze()
    length = wp.sqrt(hit[0] * hit[0] + hit[1] * hit[1])
    r.q = wp.vec3(hit[0], hit[1], 0.0) / wp.max(length, TINY)
    r.off = wp.abs(1.0 - length)
    r.rim = 1
    return r


# ---- Points of lights ----


@wp.func
def disk_draw(u: wp.vec2) -> wp.vec2:
    return square_to_disk(u)


@wp.func
def disk_drawn(u: wp.float32, v: wp.float32) -> wp.vec2:
    return disk_to_square(wp.vec2(u, v))


DISK = affine_kind(
    2,
    Affine(
        point=disk_point,
        coordinates=disk_coordinates,
        hit=disk_hit,
        normal=disk_normal,
        tangents=disk_tangents,
        uv=disk_uv,
        rates=disk_rates,
        pull=disk_pull,
        level=disk_level,
        graze=disk_graze,
        rim=Rim(disk_rim, disk_rim_rate, disk_into, disk_rim_near),
        light=Light(disk_draw, disk_drawn, PI),
    ),
)

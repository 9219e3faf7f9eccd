"""The open cylinder x^2 + y^2 = 1, 0 <= z <= 1, seen from both sides, in its own coordinates.

A point q is held as its azimuth and its height, in which area is uniform. Texture coordinates are Mitsuba's: (azimuth /
2 pi, height).

From a point e farther from the axis than 1, the silhouette is two lines along the axis, through the points of the unit
circle where q . e = 1 across the axis. From a direction it is the two lines where q . e = 0. Each line has one half of
the parameter u, from z = 0 to z = 1. The points of a light are drawn from the arc that faces e.

Derivation: ``docs/theory/implicit.md#kinds``, ``#silhouettes``, ``#rims``, ``#emission``; ``docs/theory/guiding.md``.
"""

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import INV_TWO_PI, PI, TWO_PI
from warp_psdr.kernels.math import share_of_turn
from warp_psdr.kernels.primitive.affine import determinant, from_axes
from warp_psdr.kernels.primitive.affine_kind import affine_kind
from warp_psdr.kernels.primitive.kind import TINY, Affine, Facing, Graze, Light, Outline, Rim
from warp_psdr.kernels.structs import Triangle


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


# ---- Its silhouette and its rims ----


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
def cylinder_outline_near(eye: wp.vec3, q: wp.vec3) -> wp.float32:
    """The same of ``cylinder_silhouette``."""
    z = wp.clamp(q[2], 0.0, 0.999999)
    left = eye[0] * q[1] - eye[1] * q[0] >= 0.0
    return 0.5 * (z + wp.where(left, 0.0, 1.0))


@wp.func
def cylinder_outline_seen(eye: wp.vec3) -> wp.bool:
    return eye[0] * eye[0] + eye[1] * eye[1] > 1.0


@wp.func
def cylinder_place(u: wp.vec2) -> wp.vec3:
    """Point of the cylinder, uniform in area."""
    phi = TWO_PI * u[0]
    return wp.vec3(wp.cos(phi), wp.sin(phi), u[1])


@wp.func
def cylinder_square(q: wp.vec3) -> wp.vec2:
    """The inverse of ``cylinder_place``."""
    return wp.vec2(share_of_turn(q[1], q[0]), wp.clamp(q[2], 0.0, 0.9999999))


@wp.func
def cylinder_gradient(q: wp.vec3) -> wp.vec3:
    """Gradient of phi = (x^2 + y^2 - 1) / 2, which is positive outside."""
    return wp.vec3(q[0], q[1], 0.0)


@wp.func
def cylinder_bend(q: wp.vec3, w: wp.vec3) -> wp.float32:
    """w^T H w, H the Hessian of phi: diag(1, 1, 0)."""
    return w[0] * w[0] + w[1] * w[1]


@wp.func
def cylinder_rim(u: wp.float32) -> wp.vec3:
    """The circle z = 0 has half of u, that at z = 1 the other."""
    phi = 2.0 * TWO_PI * u
    return wp.vec3(wp.cos(phi), wp.sin(phi), wp.where(u < 0.5, 0.0, 1.0))


@wp.func
def cylinder_rim_rate(q: wp.vec3) -> wp.vec3:
    return 2.0 * TWO_PI * wp.vec3(-q[1], q[0], 0.0)


@wp.func
def cylinder_into(q: wp.vec3) -> wp.vec3:
    return wp.vec3(0.0, 0.0, wp.where(q[2] < 0.5, 1.0, -1.0))


@wp.func
def cylinder_rim_near(q: wp.vec3) -> wp.float32:
    return 0.5 * (share_of_turn(q[1], q[0]) + wp.where(q[2] < 0.5, 0.0, 1.0))


@wp.func
def cylinder_level(q: wp.vec3) -> wp.vec4:
    return wp.vec4(q[0], q[1], 0.0, 0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0))


@wp.func
def cylinder_graze(hit: wp.vec3, o: wp.vec3, d: wp.vec3) -> Graze:
    r = Graze()
    across = d[0] * d[0] + d[1] * d[1]
    m = o - ((o[0] * d[0] + o[1] * d[1]) / wp.max(across, TINY)) * d
    length = wp.sqrt(m[0] * m[0] + m[1] * m[1])
    beside = wp.abs(1.0 - length)
    end = wp.min(wp.abs(hit[2]), wp.abs(1.0 - hit[2]))
    if end < beside:
        around = wp.sqrt(hit[0] * hit[0] + hit[1] * hit[1])
        r.q = wp.vec3(hit[0] / wp.max(around, TINY), hit[1] / wp.max(around, TINY), wp.where(hit[2] < 0.5, 0.0, 1.0))
        r.off = end
        r.rim = 1
    else:
        r.q = wp.vec3(m[0] / wp.max(length, TINY), m[1] / wp.max(length, TINY), wp.clamp(m[2], 0.0, 1.0))
        r.normal = wp.vec3(r.q[0], r.q[1], 0.0)
        r.off = beside
    return r


# ---- Points of lights ----


@wp.func
def cylinder_draw(u: wp.vec2) -> wp.vec2:
    return wp.vec2(TWO_PI * u[0] - PI, u[1])


@wp.func
def cylinder_drawn(u: wp.float32, v: wp.float32) -> wp.vec2:
    return wp.vec2((u + PI) * INV_TWO_PI, v)


@wp.func
def cylinder_excess(e: wp.vec3) -> wp.float32:
    """Squared distance from the axis, - 1."""
    distance = wp.sqrt(e[0] * e[0] + e[1] * e[1])
    return (distance - 1.0) * (distance + 1.0)


@wp.func
def cylinder_visible_draw(e: wp.vec3, u: wp.vec2) -> wp.vec2:
    """Azimuth, uniform among those that face e, and height."""
    half = wp.atan(wp.sqrt(cylinder_excess(e)))
    azimuth = wp.atan2(e[1], e[0]) + half * (2.0 * u[0] - 1.0)
    return wp.vec2(azimuth - TWO_PI * wp.floor((azimuth + PI) * INV_TWO_PI), u[1])


@wp.func
def cylinder_visible_square(e: wp.vec3, u: wp.float32, v: wp.float32) -> wp.vec2:
    """The inverse of ``cylinder_visible_draw``."""
    half = wp.atan(wp.sqrt(cylinder_excess(e)))
    turn = u - wp.atan2(e[1], e[0])
    turn -= TWO_PI * wp.floor((turn + PI) * INV_TWO_PI)
    return wp.vec2(wp.clamp(0.5 * (turn / half + 1.0), 0.0, 1.0), v)


@wp.func
def cylinder_visible_pdf(tri: Triangle, u: wp.float32, v: wp.float32, d: wp.vec3, t: wp.float32) -> wp.float32:
    """Density in solid angle of ``cylinder_visible_draw`` at the point t before (u, v); -1: that is inside."""
    a = from_axes(tri, d)
    q = cylinder_point(u, v)
    towards = -(q[0] * a[0] + q[1] * a[1])
    excess = t * (t * (a[0] * a[0] + a[1] * a[1]) + 2.0 * towards)
    if excess <= 0.0:
        return -1.0
    # |c . d| = |det A| |q . a|: c is cof(A) q across the axis.
    cosine = wp.abs(determinant(tri)) * wp.max(wp.abs(towards), 1.0e-30)
    return t * t / (2.0 * wp.atan(wp.sqrt(excess)) * cosine)


CYLINDER = affine_kind(
    3,
    Affine(
        point=cylinder_point,
        coordinates=cylinder_coordinates,
        hit=cylinder_hit,
        normal=cylinder_normal,
        tangents=cylinder_tangents,
        uv=cylinder_uv,
        rates=cylinder_rates,
        pull=cylinder_pull,
        level=cylinder_level,
        graze=cylinder_graze,
        outline=Outline(
            silhouette=cylinder_silhouette,
            rate=cylinder_silhouette_rate,
            nearest=cylinder_outline_near,
            seen=cylinder_outline_seen,
            place=cylinder_place,
            square=cylinder_square,
            gradient=cylinder_gradient,
            bend=cylinder_bend,
            area=TWO_PI,
        ),
        rim=Rim(cylinder_rim, cylinder_rim_rate, cylinder_into, cylinder_rim_near),
        light=Light(
            draw=cylinder_draw,
            square=cylinder_drawn,
            area=TWO_PI,
            facing=Facing(cylinder_excess, cylinder_visible_draw, cylinder_visible_square, cylinder_visible_pdf),
        ),
    ),
)

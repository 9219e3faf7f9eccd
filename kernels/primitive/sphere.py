"""The unit sphere: the functions of a kind for ``affine.py``, in the coordinates of the shape.

A point q is held as two numbers in [-1, 1], its octahedral projection: the sphere is projected along rays onto |x| +
|y| + |z| = 1, and the lower half is folded over the upper one. The projection has no pole, and float32 resolves it
evenly. Texture coordinates are Mitsuba's: (azimuth / 2 pi, inclination from +z / pi).

Derivation: ``docs/theory/implicit.md#kinds``.
"""

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import INV_PI, INV_TWO_PI, PI, TWO_PI

#: Squared distance from the axis within which azimuths have the derivative of a point at this distance.
AXIS = 1.0e-12


@wp.func
def fold(a: wp.float32, b: wp.float32) -> wp.float32:
    """(1 - |b|), with the sign of a; 0 counts as positive."""
    return wp.where(a < 0.0, wp.abs(b) - 1.0, 1.0 - wp.abs(b))


@wp.func
def sphere_point(u: wp.float32, v: wp.float32) -> wp.vec3:
    """Point of the unit sphere with the octahedral coordinates (u, v)."""
    z = 1.0 - wp.abs(u) - wp.abs(v)
    return wp.normalize(wp.vec3(wp.where(z < 0.0, fold(u, v), u), wp.where(z < 0.0, fold(v, u), v), z))


@wp.func
def sphere_coordinates(q: wp.vec3) -> wp.vec2:
    """Octahedral coordinates of a direction of any length but 0."""
    scale = 1.0 / (wp.abs(q[0]) + wp.abs(q[1]) + wp.abs(q[2]))
    u = scale * q[0]
    v = scale * q[1]
    return wp.vec2(wp.where(q[2] < 0.0, fold(u, v), u), wp.where(q[2] < 0.0, fold(v, u), v))


@wp.func
def sphere_hit(o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
    """The first point of the line o + t d, 0 < t < t_max, on the unit sphere; ``face`` is -1 if there is none.

    With m = o + s d the point next to the centre, the half chord is sqrt(1 - |m|^2) / |d|: unlike the discriminant of
    the quadratic equation in o, it keeps its digits where o is far away [HG19]. Of the two roots, the one next to o is
    the product of both over the other.
    """
    hit = RayHit()
    hit.t = t_max
    hit.face = -1
    squared = wp.dot(d, d)
    s = -wp.dot(o, d) / squared
    m = o + s * d
    inside = 1.0 - wp.dot(m, m)
    if inside >= 0.0:
        half = wp.sqrt(inside / squared)
        far = s + wp.where(s < 0.0, -half, half)
        length = wp.length(o)
        near = (length - 1.0) * (length + 1.0) / (squared * wp.where(far == 0.0, 1.0, far))
        first = wp.min(near, far)
        t = wp.where(first > 0.0, first, wp.max(near, far))
        if t > 0.0 and t < t_max:
            at = sphere_coordinates(o + t * d)
            hit.t = t
            hit.u = at[0]
            hit.v = at[1]
            hit.face = 0
    return hit


@wp.func
def sphere_normal(q: wp.vec3) -> wp.vec3:
    """Normal whose length is the area element of the kind: that of a sphere is 1."""
    return q


@wp.func
def sphere_tangents(q: wp.vec3) -> tuple[wp.vec3, wp.vec3]:
    """dp/du and dp/dv."""
    r = wp.sqrt(wp.max(q[0] * q[0] + q[1] * q[1], AXIS))
    return TWO_PI * wp.vec3(-q[1], q[0], 0.0), PI * wp.vec3(q[2] * q[0] / r, q[2] * q[1] / r, -r)


@wp.func
def sphere_uv(q: wp.vec3) -> wp.vec2:
    azimuth = INV_TWO_PI * wp.atan2(q[1], q[0])
    return wp.vec2(
        wp.where(azimuth < 0.0, azimuth + 1.0, azimuth),
        INV_PI * wp.atan2(wp.sqrt(q[0] * q[0] + q[1] * q[1]), q[2]),
    )


@wp.func
def sphere_rates(q: wp.vec3, q_dot: wp.vec3) -> tuple[wp.vec3, wp.vec3, wp.vec2]:
    """Velocities of normal, dp/du and texture coordinates for a velocity of q in the sphere."""
    squared = wp.max(q[0] * q[0] + q[1] * q[1], AXIS)
    uv = wp.vec2(
        INV_TWO_PI * (q[0] * q_dot[1] - q[1] * q_dot[0]) / squared,
        -INV_PI * q_dot[2] / wp.sqrt(squared),
    )
    return q_dot, TWO_PI * wp.vec3(-q_dot[1], q_dot[0], 0.0), uv


@wp.func
def sphere_pull(q: wp.vec3, a_n: wp.vec3, a_tangent: wp.vec3, a_uv: wp.vec2) -> wp.vec3:
    """The transpose: adjoint of q from those of normal, dp/du and texture coordinates."""
    squared = wp.max(q[0] * q[0] + q[1] * q[1], AXIS)
    turn = INV_TWO_PI * a_uv[0] / squared
    return a_n + wp.vec3(
        TWO_PI * a_tangent[1] - q[1] * turn,
        -TWO_PI * a_tangent[0] + q[0] * turn,
        -INV_PI * a_uv[1] / wp.sqrt(squared),
    )

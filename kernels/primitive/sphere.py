"""The unit sphere, in its own coordinates; affine maps turn it into any ellipsoid, and silhouettes into silhouettes.

A point q is held as two numbers in [-1, 1], its octahedral projection: the sphere is projected along rays onto |x| +
|y| + |z| = 1, and the lower half is folded over the upper one. The projection has no pole, and float32 resolves it
evenly. Texture coordinates are Mitsuba's: (azimuth / 2 pi, inclination from +z / pi).

From a point e outside, |e| > 1, the silhouette is the circle q . e = 1 with the centre e / |e|^2 and the radius sqrt(1
- 1 / |e|^2). From infinity it is a great circle.

A light's points are drawn from those that face e, q . e > 1. Their density is a mixture of two in solid angle at e.
Both depend on s, the share of the cone of directions that is closer to its axis: the uniform one, and 1 / (2 sqrt(1 -
s)). The second bounds derivatives of the geometric factor over the density: the factor vanishes at the rim as sqrt(1 -
s), and its derivative does not vanish.

Derivation: ``docs/theory/implicit.md#kinds``, ``#silhouettes``, ``#emission``; ``docs/theory/guiding.md``.
"""

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import FOUR_PI, INV_PI, INV_TWO_PI, PI, TWO_PI
from warp_psdr.kernels.math import any_tangent, share_of_turn
from warp_psdr.kernels.primitive.affine import determinant, from_axes
from warp_psdr.kernels.primitive.affine_kind import affine_kind
from warp_psdr.kernels.primitive.kind import TINY, Affine, Facing, Graze, Light, Outline
from warp_psdr.kernels.sampling import sphere_to_square, square_to_sphere, unit_circle
from warp_psdr.kernels.structs import Triangle

#: Squared distance from the axis within which azimuths have the derivative of a point at this distance.
AXIS = 1.0e-12
#: Share of the density of a light's points that is uniform in the cone.
EVEN = 0.5
#: Least sqrt(1 - s) by which is divided.
RIM = 1.0e-6


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


# ---- Its silhouette ----


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
def sphere_outline_near(eye: wp.vec3, q: wp.vec3) -> wp.float32:
    """U of the point of ``sphere_silhouette`` that is nearest to a point of the sphere."""
    axis = wp.normalize(eye)
    a = any_tangent(axis)
    return share_of_turn(wp.dot(q, wp.cross(axis, a)), wp.dot(q, a))


@wp.func
def sphere_outline_seen(eye: wp.vec3) -> wp.bool:
    return circle_radius(eye, False) > 0.0


@wp.func
def sphere_place(u: wp.vec2) -> wp.vec3:
    """Point of the sphere, uniform in area."""
    return square_to_sphere(u)


@wp.func
def sphere_square(q: wp.vec3) -> wp.vec2:
    """The inverse of ``sphere_place``."""
    return sphere_to_square(wp.normalize(q))


@wp.func
def sphere_gradient(q: wp.vec3) -> wp.vec3:
    """Gradient of phi = (|q|^2 - 1) / 2, which is positive outside."""
    return q


@wp.func
def sphere_bend(q: wp.vec3, w: wp.vec3) -> wp.float32:
    """w^T H w, H the Hessian of phi."""
    return wp.dot(w, w)


@wp.func
def sphere_level(q: wp.vec3) -> wp.vec4:
    """(gradient, phi) in the shape's coordinates; phi is positive outside."""
    return wp.vec4(q[0], q[1], q[2], 0.5 * (wp.dot(q, q) - 1.0))


@wp.func
def sphere_graze(hit: wp.vec3, o: wp.vec3, d: wp.vec3) -> Graze:
    r = Graze()
    m = o - (wp.dot(o, d) / wp.dot(d, d)) * d
    length = wp.length(m)
    r.q = m / wp.max(length, TINY)
    r.normal = r.q
    r.off = wp.abs(1.0 - length)
    return r


# ---- Points of lights ----


@wp.func
def sphere_draw(u: wp.vec2) -> wp.vec2:
    """Coordinates of a point, uniform in area, as of the other kinds."""
    return sphere_coordinates(square_to_sphere(u))


@wp.func
def sphere_drawn(u: wp.float32, v: wp.float32) -> wp.vec2:
    """The inverse of ``sphere_draw``, as of the other kinds."""
    return sphere_to_square(sphere_point(u, v))


@wp.func
def sphere_excess(e: wp.vec3) -> wp.float32:
    """|e|^2 - 1."""
    distance = wp.length(e)
    return (distance - 1.0) * (distance + 1.0)


@wp.func
def rim_distance(cosine: wp.float32, squared: wp.float32, widest: wp.float32) -> wp.float32:
    """Return sqrt(1 - s) of the point at which a ray meets the sphere with this cosine.

    ``squared``: |e|^2; ``widest``: cosine of the cone's angle.
    """
    c2 = cosine * cosine
    denominator = widest + wp.sqrt(widest * widest + c2 / squared)
    return wp.min(wp.sqrt(c2 * (1.0 + widest) / wp.max(denominator, 1.0e-30)), 1.0)


@wp.func
def sphere_visible_draw(e: wp.vec3, u: wp.vec2) -> wp.vec2:
    """Coordinates of a point of the cap that faces e."""
    excess = sphere_excess(e)
    distance = wp.length(e)
    widest = wp.sqrt(excess) / distance
    k = 1.0 / (distance * distance * (1.0 + widest))  # 1 - widest
    # The share s of the cone inverts u = EVEN s + (1 - EVEN) (1 - sqrt(1 - s)).
    rest = 1.0 - u[0]
    y = 2.0 * rest / ((1.0 - EVEN) + wp.sqrt((1.0 - EVEN) * (1.0 - EVEN) + 4.0 * EVEN * rest))
    s = 1.0 - y * y
    versine = s * k
    sine2 = versine * (2.0 - versine)
    # Cosine between ray and normal where the ray meets the sphere; without the difference 1 - |e|^2 sin^2.
    cosine = y * wp.sqrt((2.0 - k * (1.0 + s)) / (1.0 + widest))
    along = distance * sine2 + (1.0 - versine) * cosine
    across = wp.sqrt(sine2) * excess / (distance * (1.0 - versine) + cosine)
    axis = e / distance
    s_axis = any_tangent(axis)
    t_axis = wp.cross(axis, s_axis)
    turn = unit_circle(u[1])
    return sphere_coordinates(along * axis + across * (turn[0] * s_axis + turn[1] * t_axis))


@wp.func
def sphere_visible_square(e: wp.vec3, u: wp.float32, v: wp.float32) -> wp.vec2:
    """The inverse of ``sphere_visible_draw``."""
    q = sphere_point(u, v)
    squared = wp.dot(e, e)
    widest = wp.sqrt(sphere_excess(e) / squared)
    y = rim_distance(wp.max(wp.dot(q, wp.normalize(e - q)), 0.0), squared, widest)
    s_axis = any_tangent(wp.normalize(e))
    t_axis = wp.cross(wp.normalize(e), s_axis)
    turn = wp.atan2(wp.dot(q, t_axis), wp.dot(q, s_axis)) * INV_TWO_PI
    return wp.vec2(1.0 - y * (EVEN * y + (1.0 - EVEN)), wp.where(turn < 0.0, turn + 1.0, turn))


@wp.func
def sphere_visible_pdf(tri: Triangle, u: wp.float32, v: wp.float32, d: wp.vec3, t: wp.float32) -> wp.float32:
    """Density in solid angle of ``sphere_visible_draw`` at the point t before (u, v); -1: that is inside."""
    a = from_axes(tri, d)
    length = wp.length(a)
    towards = -wp.dot(sphere_point(u, v), a)
    # |q - t a|^2 - 1 of |q| = 1.
    excess = t * (t * length * length + 2.0 * towards)
    if excess <= 0.0:
        return -1.0
    squared = 1.0 + excess
    widest = wp.sqrt(excess / squared)
    y = rim_distance(wp.max(towards, 0.0) / length, squared, widest)
    density = EVEN + 0.5 * (1.0 - EVEN) / wp.max(y, RIM)
    # Over the cone's solid angle 2 pi (1 - widest); a cone of directions d is |a|^3 |det A| times as wide in the world.
    return density * squared * (1.0 + widest) * INV_TWO_PI / (length * length * length * wp.abs(determinant(tri)))


SPHERE = affine_kind(
    0,
    Affine(
        point=sphere_point,
        coordinates=sphere_coordinates,
        hit=sphere_hit,
        normal=sphere_normal,
        tangents=sphere_tangents,
        uv=sphere_uv,
        rates=sphere_rates,
        pull=sphere_pull,
        level=sphere_level,
        graze=sphere_graze,
        outline=Outline(
            silhouette=sphere_silhouette,
            rate=sphere_silhouette_rate,
            nearest=sphere_outline_near,
            seen=sphere_outline_seen,
            place=sphere_place,
            square=sphere_square,
            gradient=sphere_gradient,
            bend=sphere_bend,
            area=FOUR_PI,
        ),
        light=Light(
            draw=sphere_draw,
            square=sphere_drawn,
            area=FOUR_PI,
            facing=Facing(sphere_excess, sphere_visible_draw, sphere_visible_square, sphere_visible_pdf),
        ),
    ),
)

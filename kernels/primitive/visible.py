"""Points of exact shapes that emit light, drawn from what faces a point x outside: a sphere's cap, a cylinder's arc.

All coordinates are those of the kind, e = A^-1 (x - b). The points that face x are those with q . e > 1, as in the
world, because affine maps preserve tangent planes. On a sphere the density is a mixture of two in solid angle at e.
Both depend on s, the share of the cone of directions that is closer to its axis: the uniform one, and 1 / (2 sqrt(1 -
s)). The second bounds derivatives of the geometric factor over the density: the factor vanishes at the rim as sqrt(1 -
s), and its derivative does not vanish.

Derivation: ``docs/theory/implicit.md#emission``.
"""

from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.constants import INV_TWO_PI, PI, PRIMITIVE_CYLINDER, PRIMITIVE_SPHERE, TWO_PI
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.primitive.affine import determinant, from_axes
from warp_psdr.kernels.primitive.cylinder import cylinder_point
from warp_psdr.kernels.primitive.sphere import sphere_coordinates, sphere_point
from warp_psdr.kernels.sampling import unit_circle
from warp_psdr.kernels.structs import Triangle

#: Share of the density that is uniform in the cone.
EVEN = 0.5
#: Least sqrt(1 - s) by which is divided.
RIM = 1.0e-6


class VisiblePart(NamedTuple):
    """Functions of a kind whose points are drawn from those that face e = A^-1 (x - b).

    Attributes:
        excess: ``(e) -> float``, positive where some points do not face e: it is outside.
        draw: ``(e, u: vec2) -> vec2``, the numbers of a point.
        square: ``(e, u, v) -> vec2``, its inverse.
        pdf: ``(tri, u, v, d, t) -> float``, the density in solid angle at x, in the world, which is t before the point
            along d (unit); negative: x is not outside.
    """

    excess: wp.Function
    draw: wp.Function
    square: wp.Function
    pdf: wp.Function


@wp.func
def shines_outwards(tri: Triangle) -> wp.bool:
    """Whether a closed shape shines away from its inside."""
    return wp.float32(tri.i2) * determinant(tri) > 0.0


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


#: Kinds (PRIMITIVE_*) of which some points never face a point outside.
VISIBLE: dict[int, VisiblePart] = {
    PRIMITIVE_SPHERE: VisiblePart(sphere_excess, sphere_visible_draw, sphere_visible_square, sphere_visible_pdf),
    PRIMITIVE_CYLINDER: VisiblePart(
        cylinder_excess, cylinder_visible_draw, cylinder_visible_square, cylinder_visible_pdf
    ),
}

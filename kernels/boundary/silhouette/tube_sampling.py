"""Points of curves with a radius, and directions that touch them there, with their densities.

Two measures count: kappa_n dA dtheta of a point of the surface and a tangent direction, and |dx/du x w| du dsigma of a
curve x(u) and a direction w. Along the silhouettes that a light's point sees, they are the same.

Derivation: ``docs/theory/implicit.md#silhouettes-of-tubes``.
"""

import warp as wp

from warp_psdr.kernels.boundary.silhouette.tube_points import (
    PART_CREASE,
    PART_END,
    PART_SIDE,
    TubePoint,
    crease_of,
    end_sphere_point,
    lean,
    rim_seen,
    side_point,
    side_roots,
    sphere_shows,
    tube_axis,
    with_rate,
)
from warp_psdr.kernels.constants import INV_FOUR_PI, INV_TWO_PI, TWO_PI
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.primitive.curves import is_spline
from warp_psdr.kernels.primitive.curves_frame import along_gradient, frame_at
from warp_psdr.kernels.primitive.sphere import sphere_silhouette_rate
from warp_psdr.kernels.sampling import square_to_sphere
from warp_psdr.kernels.structs import Scene, Triangle


@wp.struct
class TubeTouch:
    """A point and a direction of its own."""

    point: TubePoint
    w: wp.vec3


@wp.func
def own_touch(
    scene: Scene, tri: Triangle, face: wp.int32, number: wp.int32, along: wp.float32, u: wp.vec3
) -> TubeTouch:
    """A point of an item, and a direction in which it may be touched.

    On sides the place and the angle are uniform, on spheres the area, in both the tangent direction; of rims and
    creases the angle around them, and the direction.
    """
    r = TubeTouch()
    segment = number >> 2
    part = number & 3
    v = along
    if part != PART_SIDE:
        v = wp.where(part == PART_END, 1.0, 0.0)
    if part == PART_CREASE:
        r.w = square_to_sphere(wp.vec2(u[0], u[1]))
        r.point = crease_of(scene, tri, face, segment, along)
        return r
    f = frame_at(scene, tri, segment, v)
    if part != PART_SIDE and is_spline(tri):
        r.w = square_to_sphere(wp.vec2(u[0], u[1]))
        r.point = rim_seen(f, face, segment, part, r.w, True, along)
        return r
    axis = tube_axis(f)
    s = any_tangent(axis)
    h = lean(f)
    angle = TWO_PI * u[2]
    if part != PART_SIDE:
        angle = TWO_PI * along
        low = wp.where(part == PART_END, h, -1.0)
        high = wp.where(part == PART_END, 1.0, h)
        h = wp.lerp(wp.clamp(low, -1.0, 1.0), wp.clamp(high, -1.0, 1.0), u[2])
    e = h * axis
    e += wp.sqrt(wp.max(1.0 - h * h, 0.0)) * (wp.cos(angle) * s + wp.sin(angle) * wp.cross(axis, s))
    if part == PART_SIDE:
        r.point = side_point(f, face, segment, v, e)
    else:
        r.point = end_sphere_point(f, face, segment, part, e)
        if not sphere_shows(scene, tri, segment, part, e):
            r.point.valid = 0
    a = any_tangent(r.point.out)
    theta = TWO_PI * u[1]
    r.w = wp.cos(theta) * a + wp.sin(theta) * wp.cross(r.point.out, a)
    return r


@wp.func
def own_touch_density(point: TubePoint, w: wp.vec3, curvature: wp.float32) -> wp.float32:
    """Density of ``own_touch`` in the measure of its point."""
    if point.rim == 1 or point.part == PART_CREASE:
        return INV_FOUR_PI / wp.length(wp.cross(point.along, w))
    f = point.f
    h = lean(f)
    area = wp.float32(0.0)
    if point.part == PART_SIDE:
        # Across the circle the surface is |grad v|-th of a place long, along the meridian.
        meridian = wp.normalize(wp.cross(point.gradient, wp.cross(f.c1, point.e)))
        round = f.r * wp.sqrt(wp.max(1.0 - h * h, 0.0))
        area = TWO_PI * round / wp.abs(wp.dot(along_gradient(f, point.e), meridian))
    else:
        h = wp.clamp(h, -1.0, 1.0)
        area = TWO_PI * f.r * f.r * wp.where(point.part == PART_END, 1.0 - h, 1.0 + h)
    return INV_TWO_PI / (area * curvature)


@wp.func
def drawn_touch_density(point: TubePoint, w: wp.vec3) -> wp.float32:
    """Density of a point that ``tube_seen`` returned, but for that of the direction w from where it is seen."""
    return 1.0 / (point.choices * wp.length(wp.cross(point.along, w)))


@wp.func
def seen_touch_density(touched: TubePoint, eye: wp.vec3, distant: wp.bool, w: wp.vec3) -> wp.float32:
    """Density of a point, but for that of the direction w, of ``tube_seen`` from a light's point, or its direction."""
    point = touched
    if point.rim == 0 and point.part == PART_SIDE:
        roots, _s, _t = side_roots(point.f, eye, distant)
        point.choices = wp.float32(wp.max(roots.count, 1))
        point = with_rate(point, eye, distant)
    elif point.rim == 0:
        here = eye
        if not distant:
            here = (eye - point.f.c) / point.f.r
        point.along = point.f.r * sphere_silhouette_rate(here, distant, point.e)
    return drawn_touch_density(point, w)

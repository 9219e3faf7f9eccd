"""The circle of a tube, or the sphere of a cone, whose normal passes through a point near a curve of intersection.

Derivation: ``docs/theory/implicit.md#curves-of-intersection``.
"""

import warp as wp

from warp_psdr.kernels.boundary.silhouette.tube_points import (
    PART_END,
    PART_START,
    TubePoint,
    side_point,
)
from warp_psdr.kernels.primitive.curves import curves_of, is_spline, place_on, slope_on, spline_at, xyz
from warp_psdr.kernels.primitive.curves_frame import frame_at
from warp_psdr.kernels.structs import Scene, Triangle

#: Newton's steps to the circle that a place lies in the plane of, and how far beyond a segment's ends it may be.
STEPS, BEYOND = 4, 0.5


@wp.func
def place_across(scene: Scene, tri: Triangle, segment: wp.int32, start: wp.float32, x: wp.vec3) -> wp.float32:
    """Where along a segment of a B-spline x lies across the axis: (x - c) . c' = 0, next to a place."""
    s = spline_at(scene, curves_of(scene, tri), segment, x)
    v = wp.float32(start)
    for _k in range(wp.static(STEPS)):
        c = xyz(place_on(s, v))
        slope = xyz(slope_on(s, v))
        bend = 2.0 * xyz(s.a2 + (3.0 * v) * s.a3)
        v -= wp.dot(c, slope) / wp.max(wp.dot(slope, slope) + wp.dot(c, bend), 1.0e-30)
        v = wp.clamp(v, -BEYOND, 1.0 + BEYOND)
    return v


@wp.func
def tube_across(
    scene: Scene, tri: Triangle, face: wp.int32, segment: wp.int32, start: wp.float32, x: wp.vec3
) -> TubePoint:
    """The point of a segment next to x, on the circle or sphere at the place that x belongs to."""
    if is_spline(tri):
        v = place_across(scene, tri, segment, start, x)
        f = frame_at(scene, tri, segment, v)
        return side_point(f, face, segment, v, wp.normalize(x - f.c))
    f = frame_at(scene, tri, segment, 0.0)
    q = x - f.c
    squared = wp.dot(f.c1, f.c1)
    along = wp.dot(q, f.c1) / squared
    beside = wp.length(q - along * f.c1)
    # (x - c) . c' = -r' |x - c|.
    v = wp.clamp(along + beside * f.r1 / wp.sqrt(wp.max(squared * (squared - f.r1 * f.r1), 1.0e-30)), 0.0, 1.0)
    f = frame_at(scene, tri, segment, v)
    r = side_point(f, face, segment, v, wp.normalize(x - f.c))
    if v == 0.0 or v == 1.0:
        r.part = wp.where(v == 0.0, PART_START, PART_END)
        r.free = 0.0
    return r

"""The circle of a tube, or sphere of a cone, at a position along a curve, and the Hessian of phi = |x - c(v)| - r(v).

Derivation: ``docs/theory/implicit.md#silhouettes-of-tubes``.
"""

import warp as wp

from warp_psdr.kernels.primitive.curves import (
    control_point,
    curves_of,
    first_point,
    is_spline,
    place_on,
    slope_on,
    spline_at,
    xyz,
)
from warp_psdr.kernels.structs import Scene, Triangle


@wp.struct
class TubeFrame:
    """The circle, or sphere, at a place v of a segment, and derivatives by v."""

    cubic: wp.int32
    c: wp.vec3
    r: wp.float32
    c1: wp.vec3
    r1: wp.float32
    c2: wp.vec3
    r2: wp.float32
    c3: wp.vec3


@wp.func
def frame_at(scene: Scene, tri: Triangle, segment: wp.int32, v: wp.float32) -> TubeFrame:
    f = TubeFrame()
    g = curves_of(scene, tri)
    zero = wp.vec3(0.0, 0.0, 0.0)
    if is_spline(tri):
        s = spline_at(scene, g, segment, zero)
        here = place_on(s, v)
        slope = slope_on(s, v)
        bend = 2.0 * (s.a2 + (3.0 * v) * s.a3)
        f.cubic = 1
        f.c = xyz(here)
        f.r = here[3]
        f.c1 = xyz(slope)
        f.r1 = slope[3]
        f.c2 = xyz(bend)
        f.r2 = bend[3]
        f.c3 = 6.0 * xyz(s.a3)
        return f
    i = first_point(scene, g, segment)
    p0 = control_point(scene, g, i, zero)
    p1 = control_point(scene, g, i + 1, zero)
    here = wp.lerp(p0, p1, v)
    f.c = xyz(here)
    f.r = here[3]
    f.c1 = xyz(p1 - p0)
    f.r1 = p1[3] - p0[3]
    return f


@wp.func
def tube_stretch(f: TubeFrame, e: wp.vec3) -> wp.float32:
    """What c' is divided by in grad v; of tubes it is negative where circles cross."""
    if f.cubic == 1:
        return wp.dot(f.c1, f.c1) - f.r * wp.dot(e, f.c2)
    return wp.dot(f.c1, f.c1) - f.r1 * f.r1


@wp.func
def along_gradient(f: TubeFrame, e: wp.vec3) -> wp.vec3:
    """Gradient of the place v."""
    if f.cubic == 1:
        return f.c1 / tube_stretch(f, e)
    return (f.c1 + f.r1 * e) / tube_stretch(f, e)


@wp.func
def tube_gradient(f: TubeFrame, e: wp.vec3) -> wp.vec3:
    """Gradient of phi = |x - c(v)| - r(v)."""
    if f.cubic == 1:
        return e - f.r1 * along_gradient(f, e)
    return e


@wp.func
def tube_bend(f: TubeFrame, e: wp.vec3, free: wp.float32, w: wp.vec3) -> wp.vec3:
    """H w, H the Hessian of phi."""
    gv = wp.vec3(0.0, 0.0, 0.0)
    if free > 0.0:
        gv = along_gradient(f, e)
    dv = wp.dot(gv, w)
    dq = w - dv * f.c1
    h = (1.0 / f.r) * (dq - wp.dot(e, dq) * e)
    if f.cubic == 1:
        d = tube_stretch(f, e)
        dd = dv * (2.0 * wp.dot(f.c1, f.c2) - f.r * wp.dot(e, f.c3)) - wp.dot(dq, f.c2)
        h -= (f.r2 * dv) * gv + (f.r1 / d) * (dv * f.c2 - dd * gv)
    return h

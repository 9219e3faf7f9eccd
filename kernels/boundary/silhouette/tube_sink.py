"""The sink for the adjoint of a point on a tube's silhouette: the control points around it, and the pose.

At a silhouette the velocity along the normal counts, n . x' = -phi' / |grad phi|. At a rim it is the velocity of the
circle, which stays across the axis. At a crease it is the velocity across the curve, which two values of phi determine.

Derivation: ``docs/theory/implicit.md#silhouettes-of-tubes``, ``#joints``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.silhouette.tube_points import PART_CREASE, TubePoint
from warp_psdr.kernels.primitive.curve_kinds import CONES, TUBES
from warp_psdr.kernels.primitive.curves import control_point, curves_of, first_point, is_spline
from warp_psdr.kernels.primitive.curves_adjoint import CurveSegment, Pull, make_points_sink, make_pull, shares
from warp_psdr.kernels.structs import Scene, Triangle


@wp.func
def slope_shares(v: wp.float32) -> wp.vec4:
    """What four control points have of the derivative of a uniform cubic B-spline at v."""
    w = 1.0 - v
    middle = 0.5 + v * w
    return wp.vec4(-0.5 * w * w, 0.5 * w * w - middle, middle - 0.5 * v * v, 0.5 * v * v)


@wp.func
def points_of(scene: Scene, tri: Triangle, segment: wp.int32, v: wp.float32, free: wp.float32) -> CurveSegment:
    """The control points of a segment."""
    s = CurveSegment()
    g = curves_of(scene, tri)
    zero = wp.vec3(0.0, 0.0, 0.0)
    s.first = first_point(scene, g, segment)
    s.p0 = control_point(scene, g, s.first, zero)
    s.p1 = control_point(scene, g, s.first + 1, zero)
    if is_spline(tri):
        s.p2 = control_point(scene, g, s.first + 2, zero)
        s.p3 = control_point(scene, g, s.first + 3, zero)
    s.v = v
    s.free = free
    return s


@wp.func
def pull_rim(point: TubePoint, g: wp.vec3) -> Pull:
    """Of x = c + r e, e across c_v: x' = c' + r' e - r (e . c_v') c_v / |c_v|^2, but for what turns in the circle."""
    r = Pull()
    f = point.f
    b = shares(point.v)
    d = slope_shares(point.v)
    a = wp.vec4(g[0], g[1], g[2], wp.dot(g, point.e))
    turn = (-f.r * wp.dot(g, f.c1) / wp.dot(f.c1, f.c1)) * point.e
    t = wp.vec4(turn[0], turn[1], turn[2], 0.0)
    r.p0 = b[0] * a + d[0] * t
    r.p1 = b[1] * a + d[1] * t
    r.p2 = b[2] * a + d[2] * t
    r.p3 = b[3] * a + d[3] * t
    return r


@functools.cache
def make_tube_sink(role: str, primitives: tuple[int, ...]):
    """Return ``accumulate(scene, target, point, g) -> float``: the adjoint g of a point, across its curve."""
    has_cubic = TUBES.number in primitives
    has_linear = CONES.number in primitives
    pull_cubic, pull_linear = make_pull(True), make_pull(False)
    accumulate_cubic, accumulate_linear = make_points_sink(role, True), make_points_sink(role, False)

    @wp.func
    def accumulate_tube(scene: Scene, target: wp.array(dtype=wp.float32), point: TubePoint, g: wp.vec3) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        zero = wp.vec3(0.0, 0.0, 0.0)
        nothing = wp.vec2(0.0, 0.0)
        tri = scene.triangles[point.face]
        s = points_of(scene, tri, point.segment, point.v, point.free)
        a_phi = -wp.dot(g, point.gradient) / wp.max(wp.length_sq(point.gradient), 1.0e-30)
        total = wp.float32(0.0)
        if wp.static(has_cubic):
            if is_spline(tri):
                r = Pull()
                if point.rim == 1:
                    r = pull_rim(point, g)
                else:
                    r = pull_cubic(s, point.x, a_phi, zero, nothing, zero)
                return accumulate_cubic(scene, target, tri, s, r)
        if wp.static(has_linear):
            if point.part == PART_CREASE:
                # g = a n_1 + b n_2, and n . x' = -phi'.
                between = wp.dot(point.e, point.e2)
                along = wp.dot(g, point.e)
                across = wp.dot(g, point.e2)
                squared = wp.length_sq(wp.cross(point.e, point.e2))
                a_phi = -(along - between * across) / squared
                other = points_of(scene, tri, point.segment + 1, point.v2, 1.0)
                b_phi = -(across - between * along) / squared
                r2 = pull_linear(other, point.x, b_phi, zero, nothing, zero)
                total += accumulate_linear(scene, target, tri, other, r2)
            r1 = pull_linear(s, point.x, a_phi, zero, nothing, zero)
            total += accumulate_linear(scene, target, tri, s, r1)
        return total

    return accumulate_tube

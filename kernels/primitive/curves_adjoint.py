"""The sinks for the adjoint of a point on curves: the control points around it, and the pose.

Vertices slide along the rays that found them, as on grids (``sdfgrid_adjoint.py``). The start of a ray that leaves a
curve moves with the axis and across the surface (form S, ``docs/theory/implicit.md#form-s``). With phi(x) = |x - c(v)|
- r(v), the position v along the segment follows from x: x lies on the circle, or the sphere, of v, still(x, v) = 0. So
v changes with everything on which still depends,

    v' = -(still_x x' + still_p p') / still_v,

and texture coordinates, normals and radii change with v. Tapered tubes need this: phi' has a part -r' v'.

Derivation: ``docs/theory/implicit.md#curves``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor, differentiable
from warp_psdr.kernels.constants import TWO_PI
from warp_psdr.kernels.primitive.curves import (
    HEADER,
    Curves,
    across_axis,
    control_point,
    curves_of,
    first_point,
)
from warp_psdr.kernels.primitive.curves_surface import held_on, make_curve_surface, on_cone
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import RayAdjoint, VertexAdjoint

#: Numbers of a pose.
POSE = 16


@differentiable
@wp.func
def shares(v: wp.float32) -> wp.vec4:
    """What four control points have of a uniform cubic B-spline at v."""
    w = 1.0 - v
    middle = wp.vec2(3.0 * v * v * (v - 2.0) + 4.0, 3.0 * w * w * (w - 2.0) + 4.0)
    return wp.static(1.0 / 6.0) * wp.vec4(w * w * w, middle[0], middle[1], v * v * v)


@differentiable
@wp.func
def weigh(v: wp.float32, p0: wp.vec4, p1: wp.vec4, p2: wp.vec4, p3: wp.vec4) -> wp.vec4:
    """The place c(v) of a uniform cubic B-spline, and its radius."""
    b = shares(v)
    return b[0] * p0 + b[1] * p1 + b[2] * p2 + b[3] * p3


@differentiable
@wp.func
def weigh_slope(v: wp.float32, p0: wp.vec4, p1: wp.vec4, p2: wp.vec4, p3: wp.vec4) -> wp.vec4:
    """c'(v)."""
    w = 1.0 - v
    return 0.5 * ((w * w) * (p1 - p0) + (v * v) * (p3 - p2)) + (0.5 + v * w) * (p2 - p1)


@differentiable
@wp.func
def weigh_bend(v: wp.float32, p0: wp.vec4, p1: wp.vec4, p2: wp.vec4, p3: wp.vec4) -> wp.vec4:
    """c''(v)."""
    return (1.0 - v) * ((p0 - p1) + (p2 - p1)) + v * ((p1 - p2) + (p3 - p2))


@differentiable
@wp.func
def around_dot(q: wp.vec3, axis: wp.vec3, a_turns: wp.float32, a_tangent: wp.vec3) -> wp.float32:
    """The adjoints of the angle around an axis, and of the direction around it, folded in."""
    up = across_axis(axis)
    right = wp.cross(up, axis)
    turns = wp.atan2(wp.dot(q, up), wp.dot(q, right)) * wp.static(1.0 / TWO_PI)
    return a_turns * turns + wp.dot(a_tangent, wp.cross(axis, wp.normalize(q - wp.dot(q, axis) * axis)))


@differentiable
@wp.func
def tube_dot(
    x: wp.vec3,
    v: wp.float32,
    p0: wp.vec4,
    p1: wp.vec4,
    p2: wp.vec4,
    p3: wp.vec4,
    a_phi: wp.float32,
    a_n: wp.vec3,
    a_uv: wp.vec2,
    a_tangent: wp.vec3,
) -> wp.float32:
    """Of a tube about a B-spline: phi, the normal, (turns, v) and the tangent, with their adjoints folded in."""
    here = weigh(v, p0, p1, p2, p3)
    slope = weigh_slope(v, p0, p1, p2, p3)
    bend = weigh_bend(v, p0, p1, p2, p3)
    c = wp.vec3(slope[0], slope[1], slope[2])
    q = x - wp.vec3(here[0], here[1], here[2])
    e = wp.normalize(q)
    stretch = wp.dot(c, c) - wp.dot(q, wp.vec3(bend[0], bend[1], bend[2]))
    n = wp.normalize(stretch * e - slope[3] * c)
    told = around_dot(q, wp.normalize(c), a_uv[0], a_tangent)
    return told + a_phi * (wp.length(q) - here[3]) + wp.dot(a_n, n) + a_uv[1] * v


@differentiable
@wp.func
def tube_still(x: wp.vec3, v: wp.float32, p0: wp.vec4, p1: wp.vec4, p2: wp.vec4, p3: wp.vec4) -> wp.float32:
    """0 on the circle at v."""
    here = weigh(v, p0, p1, p2, p3)
    slope = weigh_slope(v, p0, p1, p2, p3)
    q = x - wp.vec3(here[0], here[1], here[2])
    return wp.dot(q, wp.vec3(slope[0], slope[1], slope[2]))


@differentiable
@wp.func
def cone_dot(
    x: wp.vec3,
    v: wp.float32,
    p0: wp.vec4,
    p1: wp.vec4,
    a_phi: wp.float32,
    a_n: wp.vec3,
    a_uv: wp.vec2,
    a_tangent: wp.vec3,
) -> wp.float32:
    """The same of the spheres between two control points."""
    here = (1.0 - v) * p0 + v * p1
    q = x - wp.vec3(here[0], here[1], here[2])
    b = p1 - p0
    told = around_dot(q, wp.normalize(wp.vec3(b[0], b[1], b[2])), a_uv[0], a_tangent)
    return told + a_phi * (wp.length(q) - here[3]) + wp.dot(a_n, wp.normalize(q)) + a_uv[1] * v


@differentiable
@wp.func
def cone_still(x: wp.vec3, v: wp.float32, p0: wp.vec4, p1: wp.vec4) -> wp.float32:
    """0 on the sphere at v whose circle holds x."""
    here = (1.0 - v) * p0 + v * p1
    b = p1 - p0
    q = x - wp.vec3(here[0], here[1], here[2])
    return wp.dot(q, wp.vec3(b[0], b[1], b[2])) + wp.length(q) * b[3]


@wp.struct
class Pull:
    """Adjoints of a point of curves, and of the control points that it follows from, up to four."""

    x: wp.vec3
    p0: wp.vec4
    p1: wp.vec4
    p2: wp.vec4
    p3: wp.vec4


@wp.struct
class CurveSegment:
    """The control points of a segment in the world, and a place along it."""

    p0: wp.vec4
    p1: wp.vec4
    p2: wp.vec4
    p3: wp.vec4
    first: wp.int32
    v: wp.float32
    free: wp.float32  # 0: on the sphere at an end, where v stays


@functools.cache
def make_pull(cubic: bool):
    """Return ``pull(s, x, a_phi, a_n, a_uv, a_tangent) -> Pull``, what v turns with included."""

    @wp.func
    def pull(s: CurveSegment, x: wp.vec3, a_phi: wp.float32, a_n: wp.vec3, a_uv: wp.vec2, a_tangent: wp.vec3) -> Pull:
        r = Pull()
        if wp.static(cubic):
            gx, gv, g0, g1, g2, g3, _a, _b, _c, _d = wp.grad(tube_dot)(
                x, s.v, s.p0, s.p1, s.p2, s.p3, a_phi, a_n, a_uv, a_tangent
            )
            hx, hv, h0, h1, h2, h3 = wp.grad(tube_still)(x, s.v, s.p0, s.p1, s.p2, s.p3)
            turn = -s.free * gv / wp.where(hv == 0.0, 1.0, hv)
            r.x = gx + turn * hx
            r.p0 = g0 + turn * h0
            r.p1 = g1 + turn * h1
            r.p2 = g2 + turn * h2
            r.p3 = g3 + turn * h3
        else:
            gx, gv, g0, g1, _a, _b, _c, _d = wp.grad(cone_dot)(x, s.v, s.p0, s.p1, a_phi, a_n, a_uv, a_tangent)
            hx, hv, h0, h1 = wp.grad(cone_still)(x, s.v, s.p0, s.p1)
            turn = -s.free * gv / wp.where(hv == 0.0, 1.0, hv)
            r.x = gx + turn * hx
            r.p0 = g0 + turn * h0
            r.p1 = g1 + turn * h1
        return r

    return pull


@functools.cache
def make_held_segment(cubic: bool):
    """Return ``segment_at(scene, g, u, v) -> CurveSegment``: what the two numbers of a vertex hold."""

    @wp.func
    def segment_at(scene: Scene, g: Curves, u: wp.float32, v: wp.float32) -> CurveSegment:
        s = CurveSegment()
        zero = wp.vec3(0.0, 0.0, 0.0)
        number, along = held_on(u, v)
        s.first = first_point(scene, g, number)
        s.p0 = control_point(scene, g, s.first, zero)
        s.p1 = control_point(scene, g, s.first + 1, zero)
        s.v = along
        s.free = 1.0
        if wp.static(cubic):
            s.p2 = control_point(scene, g, s.first + 2, zero)
            s.p3 = control_point(scene, g, s.first + 3, zero)
        else:
            place, free = on_cone(along)
            s.v = place
            s.free = free
        return s

    return segment_at


@functools.cache
def make_points_sink(role: str, cubic: bool):
    """Return ``accumulate(scene, target, tri, s, r) -> float``: adjoints of control points in the world, ``r``'s.

    They go on to those of the shape and to the pose.
    """
    sink = make_sink(role)

    @wp.func
    def accumulate_point(
        scene: Scene, target: wp.array(dtype=wp.float32), tri: Triangle, index: wp.int32, a: wp.vec4
    ) -> wp.float32:
        total = wp.float32(0.0)
        pose = tri.i0 - wp.static(POSE)
        at = tri.i0 + wp.static(HEADER) + 4 * index
        for row in range(3):
            place = pose + 4 * row
            for k in range(3):
                total += sink(target, place + k, a[row] * load_float(scene.values, at + k))
                total += sink(target, at + k, a[row] * load_float(scene.values, place + k))
            total += sink(target, place + 3, a[row])
        return total + sink(target, at + 3, a[3])

    @wp.func
    def accumulate_points(
        scene: Scene, target: wp.array(dtype=wp.float32), tri: Triangle, s: CurveSegment, r: Pull
    ) -> wp.float32:
        total = wp.float32(0.0)
        k = wp.int32(0)
        while k < wp.static(4 if cubic else 2):
            a = r.p0
            if k == 1:
                a = r.p1
            if k == 2:
                a = r.p2
            if k == 3:
                a = r.p3
            total += accumulate_point(scene, target, tri, s.first + k, a)
            k += 1
        return total

    return accumulate_points


@functools.cache
def make_curve_sink(role: str, cubic: bool, uv: bool, tangent: bool):
    """Return ``accumulate(scene, target, tri, u, v, adjoint, by_ray, o, d) -> RayAdjoint``, as ``make_vertex_sink``'s.

    ``by_ray``: of the vertex that the ray (o, d) finds; otherwise the adjoint is that of what a ray is tied to, and has
    a place alone.
    """
    accumulate_points = make_points_sink(role, cubic)
    segment_at = make_held_segment(cubic)
    surface_of = make_curve_surface(cubic, False)
    pull = make_pull(cubic)

    @wp.func
    def curve_sink(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        tri: Triangle,
        u: wp.float32,
        v: wp.float32,
        adjoint: VertexAdjoint,
        by_ray: wp.bool,
        o: wp.vec3,
        d: wp.vec3,
    ) -> RayAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        result = RayAdjoint()
        zero = wp.vec3(0.0, 0.0, 0.0)
        nothing = wp.vec2(0.0, 0.0)
        g = curves_of(scene, tri)
        s = segment_at(scene, g, u, v)
        x = surface_of(scene, tri, u, v).x
        of_phi = pull(s, x, 1.0, zero, nothing, zero)
        across = of_phi.x  # grad phi
        share = wp.float32(0.0)
        r = Pull()
        if by_ray:
            a_uv = nothing
            a_tangent = zero
            if wp.static(uv):
                a_uv = wp.vec2(adjoint.uv[0], adjoint.uv[1] / wp.float32(g.segments))
            if wp.static(tangent):
                a_tangent = adjoint.tangent
            r = pull(s, x, 0.0, adjoint.n, a_uv, a_tangent)
            a_x = adjoint.x + r.x
            facing = wp.dot(across, d)
            share = wp.dot(a_x, d) / wp.where(facing == 0.0, 1.0, facing)
            k = a_x - share * across
            result.o = k
            result.d = (wp.dot(x - o, d) / wp.dot(d, d)) * k
        else:
            share = wp.dot(adjoint.x, across) / wp.max(wp.dot(across, across), 1.0e-30)
            along = adjoint.x - share * across
            a = wp.vec4(along[0], along[1], along[2], 0.0)
            if wp.static(cubic):
                b = shares(s.v)
                r.p0 = b[0] * a
                r.p1 = b[1] * a
                r.p2 = b[2] * a
                r.p3 = b[3] * a
            else:
                r.p0 = (1.0 - s.v) * a
                r.p1 = s.v * a
        r.p0 -= share * of_phi.p0
        r.p1 -= share * of_phi.p1
        r.p2 -= share * of_phi.p2
        r.p3 -= share * of_phi.p3
        result.dot = accumulate_points(scene, target, tri, s, r)
        return result

    return curve_sink

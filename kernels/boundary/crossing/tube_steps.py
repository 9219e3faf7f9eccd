"""Points on the lines along which textures jump on tubes: S = a whole number, S a coordinate of the texture's place.

Such a line is where the level sets phi = 0 and S = k of space meet, so that it moves as a curve of intersection does:
grad phi . x' = -phi', grad S . x' = -S', at a point that rests. S is also the angle itself, along the seam where it
starts anew, and the place along a straight segment, where the next segment counts angles from elsewhere.

Derivation: ``docs/theory/boundary.md#steps-on-tubes``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.local_form import split_between
from warp_psdr.kernels.boundary.silhouette.tube_sink import points_of
from warp_psdr.kernels.constants import PI, TWO_PI
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.curve_kinds import CONES, TUBES
from warp_psdr.kernels.primitive.curves import across_axis, curves_of, first_point, is_spline
from warp_psdr.kernels.primitive.curves_adjoint import Pull, make_points_sink, make_pull
from warp_psdr.kernels.primitive.curves_frame import along_gradient, frame_at, tube_gradient
from warp_psdr.kernels.primitive.curves_surface import on_cone
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.texture.steps import cells_of, place_of

#: What S is, besides the two coordinates of a place: the angle, in turns, and the place along a segment.
SEAM, JOINT = wp.constant(2), wp.constant(3)
#: How far beside a line rays pass it, in the steps by which they leave surfaces, and in roundings of S.
OFF, ROUNDING = 3.0, 1.0e-6
#: Least sine of the angle between grad phi and grad S.
LEAST_SINE = 1.0e-4


@wp.struct
class TubeSteps:
    """Lines on tubes, straight in (turns, place along the segment as vertices hold it)."""

    cdf: wp.array(dtype=wp.float64)  # cumulative selection probabilities, n + 1
    ends: wp.array(dtype=wp.vec4)  # both ends
    marks: wp.array(dtype=wp.vec4i)  # record, segment, texture, what S is


@wp.struct
class TubeStep:
    """A point of a line."""

    valid: wp.int32
    face: wp.int32
    segment: wp.int32
    texture: wp.int32
    axis: wp.int32
    turns: wp.float32
    v: wp.float32
    free: wp.float32  # 0: on a sphere, where v stays
    rates: wp.vec2  # of S, by turns and v
    x: wp.vec3
    n: wp.vec3  # unit, to the outside
    slope_phi: wp.vec3  # grad phi
    slope: wp.vec3  # grad S
    across: wp.vec3  # unit, along the surface, to where S grows
    along: wp.vec3  # dx/du along the line, u in [0, 1)
    density: wp.float32  # of u
    step: wp.float32  # by which rays leave the surface
    beside: wp.float32  # how far beside the line they meet it


@wp.func
def beside_joint(scene: Scene, tri: Triangle, face: wp.int32, segment: wp.int32, x: wp.vec3) -> wp.int32:
    """The face, or -1 if a point beside the start of a straight segment is on the one before."""
    if segment == 0:
        return face
    g = curves_of(scene, tri)
    if first_point(scene, g, segment - 1) + 1 != first_point(scene, g, segment):
        return face
    before = frame_at(scene, tri, segment - 1, 1.0)
    q = x - before.c
    return wp.where(wp.dot(q, before.c1) < -before.r1 * wp.length(q), -1, face)


@functools.cache
def make_tube_step(primitives: tuple[int, ...]):
    """Return ``tube_step(scene, steps, u) -> TubeStep``, u in [0, 1) the place on all lines."""
    has_cubic, has_linear = TUBES.number in primitives, CONES.number in primitives
    pull_cubic, pull_linear = make_pull(True), make_pull(False)

    @wp.func
    def tube_step(scene: Scene, steps: TubeSteps, u: wp.float64) -> TubeStep:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = TubeStep()
        k = wp.clamp(wp.lower_bound(steps.cdf, u) - 1, 0, steps.ends.shape[0] - 1)
        size = steps.cdf[k + 1] - steps.cdf[k]
        share = wp.clamp(wp.float32((u - steps.cdf[k]) / size), 0.0, 1.0)
        r.density = wp.float32(size)
        mark = steps.marks[k]
        r.face = mark[0]
        r.segment = mark[1]
        r.texture = mark[2]
        r.axis = mark[3]
        ends = steps.ends[k]
        d_turns = ends[2] - ends[0]
        d_held = ends[3] - ends[1]
        r.turns = ends[0] + share * d_turns
        held = ends[1] + share * d_held
        tri = scene.triangles[r.face]
        r.step = step_off_primitive(scene, tri)
        r.v = held
        r.free = 1.0
        dv = d_held
        cubic = is_spline(tri)
        if not cubic:
            place, free = on_cone(held)
            r.v = place
            r.free = free
            dv = 2.0 * d_held
        f = frame_at(scene, tri, r.segment, r.v)
        axis = wp.normalize(f.c1)
        up = across_axis(axis)
        angle = TWO_PI * r.turns
        around = wp.cos(angle) * wp.cross(up, axis) + wp.sin(angle) * up
        e = around
        turned = wp.vec3(0.0, 0.0, 0.0)
        if not cubic:
            touch = wp.acos(wp.clamp(-f.r1 / wp.length(f.c1), -1.0, 1.0))
            lean = wp.float32(touch)
            rate = wp.float32(0.0)
            if held < 0.25:
                rate = -4.0 * (wp.static(PI) - touch)
                lean = wp.static(PI) + held * rate
            if held > 0.75:
                rate = -4.0 * touch
                lean = (held - 1.0) * rate
            e = wp.sin(lean) * around + wp.cos(lean) * axis
            turned = (f.r * rate * d_held) * (wp.cos(lean) * around - wp.sin(lean) * axis)
        r.x = f.c + f.r * e
        # ---- Gradients ----
        r.slope_phi = tube_gradient(f, e)
        by_v = wp.vec3(0.0, 0.0, 0.0)
        if r.free > 0.0:
            by_v = along_gradient(f, e)
        else:
            r.slope_phi = e
        zero = wp.vec3(0.0, 0.0, 0.0)
        s = points_of(scene, tri, r.segment, r.v, r.free)
        pulled = Pull()
        if wp.static(has_cubic):
            if cubic:
                pulled = pull_cubic(s, r.x, 0.0, zero, wp.vec2(1.0, 0.0), zero)
        if wp.static(has_linear):
            if not cubic:
                pulled = pull_linear(s, r.x, 0.0, zero, wp.vec2(1.0, 0.0), zero)
        by_turns = pulled.x
        value = r.turns
        r.rates = wp.vec2(1.0, 0.0)
        if r.axis == JOINT:
            r.rates = wp.vec2(0.0, 1.0)
        if r.axis < SEAM:
            count = wp.float32(curves_of(scene, tri).segments)
            texture = scene.textures[r.texture]
            row = texture.to_uv + 3 * r.axis
            cells = cells_of(texture)[r.axis]
            r.rates = cells * wp.vec2(scene.values[row], scene.values[row + 1] / count)
            value = place_of(scene, texture, wp.vec2(r.turns, (wp.float32(r.segment) + r.v) / count))[r.axis]
        r.slope = r.rates[0] * by_turns + r.rates[1] * by_v
        r.n = wp.normalize(r.slope_phi)
        across = r.slope - wp.dot(r.slope, r.n) * r.n
        steepness = wp.length(across)
        if not (steepness > LEAST_SINE * wp.length(r.slope)) or not f.r > 0.0:
            return r
        r.across = across / steepness
        if r.axis < SEAM and not cubic and held == 0.25 and d_held == 0.0:
            # Where the sphere of a joint has no width, the circle before it counts the jump (``JOINT``).
            r.face = beside_joint(
                scene, tri, r.face, r.segment, r.x - wp.sign(r.rates[1]) * (2.0 * OFF * r.step) * r.across
            )
            if r.face < 0:
                return r
        off = ROUNDING * (1.0 + wp.abs(value) + wp.abs(r.rates[0]) + wp.abs(r.rates[1]))
        r.beside = wp.max(OFF * r.step, off / steepness)
        # ---- Along the line ----
        r.along = turned
        if r.free > 0.0:
            t = wp.cross(r.n, r.across)
            squared = d_turns * d_turns + dv * dv
            speed = (d_turns * wp.dot(by_turns, t) + dv * wp.dot(by_v, t)) / squared
            if speed == 0.0:
                return r
            r.along = t / speed
        r.valid = 1
        return r

    return tube_step


@functools.cache
def make_tube_step_sink(role: str, primitives: tuple[int, ...]):
    """Return ``accumulate(scene, target, point, g) -> float``: the adjoint g, across the line, of a point of it."""
    has_cubic, has_linear = TUBES.number in primitives, CONES.number in primitives
    pull_cubic, pull_linear = make_pull(True), make_pull(False)
    accumulate_cubic, accumulate_linear = make_points_sink(role, True), make_points_sink(role, False)
    sink = make_sink(role)

    @wp.func
    def accumulate_tube_step(
        scene: Scene, target: wp.array(dtype=wp.float32), point: TubeStep, g: wp.vec3
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        tri = scene.triangles[point.face]
        steep = wp.length(point.slope)
        n_s = point.slope / steep
        g_phi, g_s = split_between(g, point.n, n_s, wp.length_sq(wp.cross(point.n, n_s)))
        a_phi = -wp.dot(g_phi, point.n) / wp.length(point.slope_phi)
        a_s = -wp.dot(g_s, n_s) / steep
        zero = wp.vec3(0.0, 0.0, 0.0)
        total = wp.float32(0.0)
        s = points_of(scene, tri, point.segment, point.v, point.free)
        if wp.static(has_cubic):
            if is_spline(tri):
                r = pull_cubic(s, point.x, a_phi, zero, a_s * point.rates, zero)
                total += accumulate_cubic(scene, target, tri, s, r)
        if wp.static(has_linear):
            if not is_spline(tri):
                r1 = pull_linear(s, point.x, a_phi, zero, a_s * point.rates, zero)
                total += accumulate_linear(scene, target, tri, s, r1)
        if point.axis < SEAM:
            texture = scene.textures[point.texture]
            row = texture.to_uv + 3 * point.axis
            scaled = a_s * cells_of(texture)[point.axis]
            along = (wp.float32(point.segment) + point.v) / wp.float32(curves_of(scene, tri).segments)
            total += sink(target, row, scaled * point.turns)
            total += sink(target, row + 1, scaled * along)
            total += sink(target, row + 2, scaled)
        return total

    return accumulate_tube_step

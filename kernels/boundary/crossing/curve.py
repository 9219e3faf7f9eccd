"""Points on the curve of intersection of two surfaces A and B, one of which is a shape without triangles.

The host gives chords of the curve. Newton's steps move a point of a chord, in the plane with the chord's direction e
for its normal, to phi_A = phi_B = 0. Then dx/ds = t |e|^2 / (t . e), where t is the tangent of the curve. Only the
normal velocities n_A . x' and n_B . x' of the two surfaces are known, so an adjoint in the plane of both normals is
split between them.

Derivation: ``docs/theory/implicit.md#curves-of-intersection``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.crossing.levels import make_level_at, make_level_sink
from warp_psdr.kernels.boundary.local_form import split_between
from warp_psdr.kernels.distribution import find_interval_64
from warp_psdr.kernels.primitive.dispatch import has_outside_alone, is_outside_alone, make_leaving
from warp_psdr.kernels.structs import Scene

#: Newton's steps, and the distance, over the chord's length, within which they have to end, and on whose part of it.
NEWTON, NEAR, AHEAD_OF_CHORD = 8, 1.0e-3, 0.5
#: Roundings of a place, over its largest coordinate: on chords so short that these are more than ``NEAR``.
ROUNDINGS = 5.0e-7
#: Least sine of the angle between two surfaces that run through each other.
LEAST_SINE = 1.0e-3
#: Distance from the curve at which surfaces are met, in steps: what leaves one of them has to start in front of the
#: other. At small angles it is longer, up to the second number.
OFF, MOST = 3.0, 1000.0


@wp.struct
class CrossingCurves:
    """Chords of curves, drawn by their lengths."""

    cdf: wp.array(dtype=wp.float32)  # cumulative selection probabilities, n + 1
    points: wp.array2d(dtype=wp.vec3)  # (n, 2) both ends
    faces: wp.array(dtype=wp.vec2i)  # numbers of the two faces
    segments: wp.array(dtype=wp.vec2i)  # of faces that are tubes: their segments
    places: wp.array(dtype=wp.vec2)  # and about the places along them
    low: wp.array(dtype=wp.float32)  # part of the chord that is on both surfaces, in [0, 1]
    high: wp.array(dtype=wp.float32)


@wp.struct
class CrossingPoint:
    """A point of a curve."""

    valid: wp.int32
    face_a: wp.int32
    face_b: wp.int32
    segment_a: wp.int32  # of a tube
    segment_b: wp.int32
    place_a: wp.float32  # about where along it
    place_b: wp.float32
    x: wp.vec3
    n_a: wp.vec3  # unit normals, of any side
    n_b: wp.vec3
    sine: wp.float32  # of the angle between them
    along: wp.vec3  # dx/ds
    density: wp.float32  # of s
    step: wp.float32  # by which rays leave the surfaces


@functools.cache
def make_crossing_point(primitives: tuple[int, ...]):
    """Return ``crossing_point(scene, curves, u) -> CrossingPoint``, u in [0, 1) the place on all of them."""
    level_at = make_level_at(primitives)
    step_off = make_leaving(primitives)

    @wp.func
    def crossing_point(scene: Scene, curves: CrossingCurves, u: wp.float64) -> CrossingPoint:
        r = CrossingPoint()
        n = find_interval_64(curves.cdf, 0, curves.cdf.shape[0] - 1, u)
        probability = curves.cdf[n + 1] - curves.cdf[n]
        share = wp.clamp(wp.float32((u - wp.float64(curves.cdf[n])) / wp.float64(probability)), 0.0, 1.0)
        stretch = curves.high[n] - curves.low[n]
        r.density = probability / stretch
        e = curves.points[n, 1] - curves.points[n, 0]
        chord = curves.points[n, 0] + (curves.low[n] + share * stretch) * e
        faces = curves.faces[n]
        r.face_a = faces[0]
        r.face_b = faces[1]
        segments = curves.segments[n]
        r.segment_a = segments[0]
        r.segment_b = segments[1]
        places = curves.places[n]
        r.place_a = places[0]
        r.place_b = places[1]
        a = scene.triangles[r.face_a]
        b = scene.triangles[r.face_b]
        r.step = wp.max(step_off(scene, a), step_off(scene, b))
        length = wp.length(e)
        x = chord
        off = wp.float32(0.0)
        k = wp.int32(0)
        while k < NEWTON:
            f = level_at(scene, r.face_a, r.segment_a, r.place_a, x)
            g = level_at(scene, r.face_b, r.segment_b, r.place_b, x)
            slope_a = wp.vec3(f[0], f[1], f[2])
            slope_b = wp.vec3(g[0], g[1], g[2])
            t = wp.cross(slope_a, slope_b)
            fall = wp.dot(t, e)
            moved = (f[3] * wp.cross(slope_b, e) + g[3] * wp.cross(e, slope_a)) + wp.dot(x - chord, e) * t
            x -= moved / wp.where(fall == 0.0, 1.0, fall)
            off = wp.length(moved / wp.where(fall == 0.0, 1.0, fall))
            r.n_a = wp.normalize(slope_a)
            r.n_b = wp.normalize(slope_b)
            k += 1
        r.x = x
        t = wp.cross(r.n_a, r.n_b)
        r.sine = wp.length(t)
        fall = wp.dot(t, e)
        # False for NaN, too.
        near = wp.max(NEAR * length, ROUNDINGS * wp.max(wp.abs(x)))
        if r.sine > LEAST_SINE and off < near and wp.abs(fall) > AHEAD_OF_CHORD * r.sine * length:
            r.along = (length * length / fall) * t
            r.valid = 1
        return r

    return crossing_point


@wp.func
def sheet_in_front(n: wp.vec3, other: wp.vec3, along: wp.vec3, w: wp.vec3) -> wp.vec3:
    """From the curve into the part of the surface with the normal n that is seen along w: in front of the other."""
    a = wp.normalize(wp.cross(n, along))
    return wp.where(wp.dot(a, other) * wp.dot(w, other) > 0.0, -a, a)


@wp.func
def place_beside(point: CrossingPoint, sheet: wp.vec3) -> wp.vec3:
    """Where a surface is met beside the curve, in front of the other one."""
    return point.x + (point.step * wp.min(OFF / point.sine, MOST)) * sheet


@functools.cache
def make_shows(primitives: tuple[int, ...]):
    """Return ``shows(scene, point, w) -> bool``: whether rays along w may see a curve. Tubes have an outside alone."""
    outside_alone = has_outside_alone(primitives)

    @wp.func
    def shows(scene: Scene, point: CrossingPoint, w: wp.vec3) -> wp.bool:
        if wp.static(outside_alone):
            if is_outside_alone(scene.triangles[point.face_a]) and wp.dot(point.n_a, w) >= 0.0:
                return False
            if is_outside_alone(scene.triangles[point.face_b]):
                return wp.dot(point.n_b, w) < 0.0
        return True

    return shows


@functools.cache
def make_crossing_sink(role: str, primitives: tuple[int, ...]):
    """Return ``accumulate(scene, target, point, g) -> float``: the adjoint g, across the curve, of a point of it."""
    accumulate_level = make_level_sink(role, primitives)

    @wp.func
    def accumulate_crossing(
        scene: Scene, target: wp.array(dtype=wp.float32), point: CrossingPoint, g: wp.vec3
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        g_a, g_b = split_between(g, point.n_a, point.n_b, point.sine * point.sine)
        total = accumulate_level(scene, target, point.face_a, point.segment_a, point.place_a, point.x, g_a)
        return total + accumulate_level(scene, target, point.face_b, point.segment_b, point.place_b, point.x, g_b)

    return accumulate_crossing

"""Points at which segments can touch curves with a radius: sides of tubes and cones, ends, and joints.

A *part* of a segment is its side, its beginning, its end, or the crease at its joint with the next segment. B-splines
begin and end with an open circle, a rim that is seen from outside alone. Straight segments begin and end with spheres,
which two of them share; on the inner side of a joint their cones meet in a crease. An item is a record and the number 4
n + part, with n the number of the segment.

Derivation: ``docs/theory/implicit.md#silhouettes-of-tubes``, ``#joints``.
"""

import warp as wp

from warp_psdr.kernels.boundary.guiding.slots import Slots
from warp_psdr.kernels.boundary.silhouette.touch import Passing
from warp_psdr.kernels.boundary.silhouette.tube_roots import TURN, CircleRoots, circle_roots
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import TWO_PI
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.primitive.curves import angle_around, curves_of, first_point, hold, hold_segment, is_spline
from warp_psdr.kernels.primitive.curves_frame import (
    TubeFrame,
    along_gradient,
    frame_at,
    tube_bend,
    tube_gradient,
    tube_stretch,
)
from warp_psdr.kernels.primitive.sphere import sphere_silhouette, sphere_silhouette_rate
from warp_psdr.kernels.structs import Scene, Triangle

#: Parts of a segment.
PART_SIDE, PART_START, PART_END, PART_CREASE = wp.constant(0), wp.constant(1), wp.constant(2), wp.constant(3)
#: Sine of the angle between two sheets below which a crease has none.
SMOOTH = 1.0e-3
#: Distance from an open end at which it is looked for, over the length of the last segment: hits count some 10^-5 of it
#: behind the end (``OVERLAP`` of curves).
BEYOND = 2.0e-4
#: Depths at which the surface beside a silhouette is looked for, each ``WIDER`` than the one before, and the first of
#: them, over the radius: rays that graze a bent tube may pass it.
LOOKS, GRAZING = 7, 2.0e-5


@wp.struct
class TubeItems:
    """Items of curves, and where in [0, 1] each begins: by length, of which all ends have a share.

    ``slots`` are read by guided kernels.
    """

    items: wp.array(dtype=wp.vec2i)
    cdf: wp.array(dtype=wp.float64)
    share: wp.float32  # of segments whose directions are not towards lights
    slots: Slots


@wp.struct
class TubePoint:
    """A point of a tube where visibility, or what is seen, may change."""

    valid: wp.int32
    face: wp.int32  # number of the record
    segment: wp.int32
    part: wp.int32
    rim: wp.int32  # 1: of an open end
    v: wp.float32  # place along the segment; of a crease with ``v2`` along the next one
    v2: wp.float32
    free: wp.float32  # 0: of a sphere, where v stays
    f: TubeFrame
    e: wp.vec3  # unit, from the axis to the point; of cones and spheres the normal
    e2: wp.vec3  # of a crease: the normal of the next segment
    gradient: wp.vec3  # of phi
    x: wp.vec3
    out: wp.vec3  # unit normal to the outside
    along: wp.vec3  # dx/du of the curve that was asked for
    choices: wp.float32  # roots of which this is one


@wp.func
def choose_tube(found: TubeItems, u: wp.float64) -> tuple[wp.int32, wp.float32, wp.float32]:
    """An item by its length, u within it, and its probability."""
    n = wp.clamp(wp.lower_bound(found.cdf, u) - 1, 0, found.items.shape[0] - 1)
    size = found.cdf[n + 1] - found.cdf[n]
    return n, wp.clamp(wp.float32((u - found.cdf[n]) / size), 0.0, 0.9999999), wp.float32(size)


@wp.func
def tube_curvature(point: TubePoint, w: wp.vec3) -> wp.float32:
    """Normal curvature kappa_n along a tangent w, positive where the surface curves away."""
    return wp.dot(w, tube_bend(point.f, point.e, point.free, w)) / wp.length(point.gradient)


@wp.func
def lean(f: TubeFrame) -> wp.float32:
    """Cosine between the axis and what leads to the surface: 0 of tubes."""
    if f.cubic == 1:
        return 0.0
    return -f.r1 / wp.length(f.c1)


@wp.func
def side_point(f: TubeFrame, face: wp.int32, segment: wp.int32, v: wp.float32, e: wp.vec3) -> TubePoint:
    """The point c + r e of a side."""
    r = TubePoint()
    r.face = face
    r.segment = segment
    r.part = PART_SIDE
    r.v = v
    r.free = 1.0
    r.f = f
    r.e = e
    r.x = f.c + f.r * e
    r.gradient = tube_gradient(f, e)
    r.out = wp.normalize(r.gradient)
    r.valid = wp.where(f.r > 0.0 and tube_stretch(f, e) > 0.0, 1, 0)
    r.choices = 1.0
    return r


@wp.func
def side_roots(f: TubeFrame, eye: wp.vec3, distant: wp.bool) -> tuple[CircleRoots, wp.vec3, wp.vec3]:
    """Angles of the silhouette on the circle at a place, and the axes of their cosines and sines."""
    found = CircleRoots()
    way = -eye
    rho = wp.float32(0.0)
    if not distant:
        way = f.c - eye
        rho = f.r
    length = wp.length(f.c1)
    axis = f.c1 / length
    across = way - wp.dot(way, axis) * axis
    alpha = wp.length(across)
    if not alpha > 0.0:
        return found, across, across
    s = across / alpha
    t = wp.cross(axis, s)
    if f.cubic == 1:
        first = TURN[0] * s + TURN[1] * t
        t = wp.cross(axis, first)
        s = first
        found = circle_roots(
            length * length,
            alpha * TURN[0],
            -alpha * TURN[1],
            f.r * wp.dot(f.c2, s),
            f.r * wp.dot(f.c2, t),
            rho,
            f.r1 * wp.dot(f.c1, way),
        )
    else:
        h = lean(f)
        k = wp.sqrt(wp.max(1.0 - h * h, 0.0))
        cosine = -(h * wp.dot(axis, way) + rho) / wp.max(k * alpha, 1.0e-30)
        if wp.abs(cosine) < 1.0 and tube_stretch(f, s) > 0.0:
            sine = wp.sqrt(1.0 - cosine * cosine)
            found.count = 2
            found.cosine = wp.vec4(cosine, cosine, 0.0, 0.0)
            found.sine = wp.vec4(sine, -sine, 0.0, 0.0)
    return found, s, t


@wp.func
def side_seen(
    f: TubeFrame, face: wp.int32, segment: wp.int32, v: wp.float32, eye: wp.vec3, distant: wp.bool, u: wp.float32
) -> TubePoint:
    """Point of the silhouette on a side, one of all roots around the circle at v, each as likely; ``along``: dx/dv."""
    r = TubePoint()
    roots, s, t = side_roots(f, eye, distant)
    if roots.count == 0:
        return r
    k = wp.min(wp.int32(u * wp.float32(roots.count)), roots.count - 1)
    h = lean(f)
    e = wp.sqrt(wp.max(1.0 - h * h, 0.0)) * (roots.cosine[k] * s + roots.sine[k] * t)
    if f.cubic == 0:
        e += (h / wp.length(f.c1)) * f.c1
    r = side_point(f, face, segment, v, e)
    r.choices = wp.float32(roots.count)
    return with_rate(r, eye, distant)


@wp.func
def with_rate(point: TubePoint, eye: wp.vec3, distant: wp.bool) -> TubePoint:
    """The silhouette from an eye runs along grad phi x H (x - eye); dx/dv moves v by one."""
    r = point
    way = -eye
    if not distant:
        way = r.x - eye
    along = wp.normalize(wp.cross(r.gradient, tube_bend(r.f, r.e, r.free, way)))
    rise = wp.dot(along, along_gradient(r.f, r.e))
    r.along = along / wp.where(rise == 0.0, 1.0, rise)
    r.valid = wp.where(rise == 0.0, 0, r.valid)
    return r


@wp.func
def tube_outline(scene: Scene, point: TubePoint, w: wp.vec3) -> wp.vec3:
    """Tangent of a rim or a crease, or of the silhouette that rays along w see."""
    if point.rim == 1 or point.part == PART_CREASE:
        return point.along
    return wp.cross(point.gradient, tube_bend(point.f, point.e, point.free, w))


@wp.func
def tube_axis(f: TubeFrame) -> wp.vec3:
    return wp.normalize(f.c1)


@wp.func
def sphere_shows(scene: Scene, tri: Triangle, segment: wp.int32, part: wp.int32, e: wp.vec3) -> wp.bool:
    """Whether a direction from the centre of a sphere at an end leads out of the segments that share it."""
    f = frame_at(scene, tri, segment, 0.0)
    if part == PART_END:
        return wp.dot(e, f.c1) >= -f.r1
    if wp.dot(e, f.c1) > -f.r1:
        return False
    if segment > 0:
        g = curves_of(scene, tri)
        if first_point(scene, g, segment - 1) + 1 == first_point(scene, g, segment):
            before = frame_at(scene, tri, segment - 1, 1.0)
            return wp.dot(e, before.c1) >= -before.r1
    return True


@wp.func
def end_sphere_point(f: TubeFrame, face: wp.int32, segment: wp.int32, part: wp.int32, e: wp.vec3) -> TubePoint:
    r = side_point(f, face, segment, wp.where(part == PART_END, 1.0, 0.0), e)
    r.part = part
    r.free = 0.0
    r.valid = wp.where(f.r > 0.0, 1, 0)
    return r


@wp.func
def sphere_seen(
    scene: Scene,
    tri: Triangle,
    face: wp.int32,
    segment: wp.int32,
    part: wp.int32,
    eye: wp.vec3,
    distant: wp.bool,
    u: wp.float32,
) -> TubePoint:
    """Point of the silhouette of the sphere at an end; u goes once around it."""
    f = frame_at(scene, tri, segment, wp.where(part == PART_END, 1.0, 0.0))
    here = eye
    if not distant:
        here = (eye - f.c) / f.r
    e, some = sphere_silhouette(here, distant, u)
    r = end_sphere_point(f, face, segment, part, e)
    if not some or not sphere_shows(scene, tri, segment, part, e):
        r.valid = 0
    r.along = f.r * sphere_silhouette_rate(here, distant, e)
    return r


@wp.func
def rim_seen(
    f: TubeFrame, face: wp.int32, segment: wp.int32, part: wp.int32, eye: wp.vec3, distant: wp.bool, u: wp.float32
) -> TubePoint:
    """Point of the circle at an open end; its normal is across the way to the eye, away from the surface."""
    axis = tube_axis(f)
    s = any_tangent(axis)
    angle = TWO_PI * u
    e = wp.cos(angle) * s + wp.sin(angle) * wp.cross(axis, s)
    r = side_point(f, face, segment, wp.where(part == PART_END, 1.0, 0.0), e)
    r.part = part
    r.rim = 1
    around = wp.cross(axis, e)
    r.along = (TWO_PI * f.r) * around
    d = eye
    if not distant:
        d = eye - r.x
    m = wp.cross(around, wp.normalize(d))
    into = wp.where(part == PART_END, -1.0, 1.0) * (axis + (f.r1 * wp.length(f.c1) / tube_stretch(f, e)) * e)
    if wp.dot(m, into) > 0.0:
        m = -m
    length = wp.length(m)
    r.out = m / wp.where(length > 0.0, length, 1.0)
    r.valid = wp.where(length > 0.0, r.valid, 0)
    return r


@wp.func
def crease_of(scene: Scene, tri: Triangle, face: wp.int32, segment: wp.int32, u: wp.float32) -> TubePoint:
    """Point of the curve in which two cones meet at a joint, on the line of the first one at an angle.

    Both touch the sphere at the joint, so that their curve lies in a plane, and its points are equally far from both
    circles of touch.
    """
    r = TubePoint()
    f = frame_at(scene, tri, segment, 1.0)
    g = frame_at(scene, tri, segment + 1, 0.0)
    first = wp.sqrt(wp.max(tube_stretch(f, f.c1), 0.0))
    second = wp.sqrt(wp.max(tube_stretch(g, g.c1), 0.0))
    if not first * second * f.r > 0.0:
        return r
    axis = tube_axis(f)
    s = any_tangent(axis)
    t = wp.cross(axis, s)
    h = lean(f)
    k = wp.sqrt(wp.max(1.0 - h * h, 0.0))
    angle = TWO_PI * u
    e = h * axis + k * (wp.cos(angle) * s + wp.sin(angle) * t)
    turned = TWO_PI * k * (wp.cos(angle) * t - wp.sin(angle) * s)
    above = wp.dot(e, g.c1) + g.r1
    below = second + (wp.dot(f.c1, g.c1) + f.r1 * wp.dot(e, g.c1)) / first
    away = f.r * above / wp.where(below == 0.0, 1.0, below)
    if not (away > 0.0 and away < first and away < second):
        return r
    along = (1.0 / first) * (f.c1 + f.r1 * e)
    q = f.r * e - away * along
    d_away = f.r * wp.dot(turned, g.c1) * (below - above * f.r1 / first) / (below * below)
    r.along = f.r * turned - d_away * along - (away * f.r1 / first) * turned
    r.face = face
    r.segment = segment
    r.part = PART_CREASE
    r.v = 1.0 - away / first
    r.v2 = away / second
    r.free = 1.0
    r.f = frame_at(scene, tri, segment, r.v)
    r.e = e
    r.e2 = wp.normalize(q - r.v2 * g.c1)
    r.gradient = e
    r.x = f.c + q
    r.out = e
    r.choices = 1.0
    r.valid = wp.where(wp.length(wp.cross(r.e, r.e2)) > SMOOTH, 1, 0)
    return r


@wp.func
def tube_seen(
    scene: Scene,
    tri: Triangle,
    face: wp.int32,
    number: wp.int32,
    eye: wp.vec3,
    distant: wp.bool,
    along: wp.float32,
    u: wp.float32,
) -> TubePoint:
    """Point of an item's curve as seen from an eye (``distant``: from its direction)."""
    segment = number >> 2
    part = number & 3
    if part == PART_CREASE:
        return crease_of(scene, tri, face, segment, along)
    if part == PART_SIDE:
        return side_seen(frame_at(scene, tri, segment, along), face, segment, along, eye, distant, u)
    if is_spline(tri):
        f = frame_at(scene, tri, segment, wp.where(part == PART_END, 1.0, 0.0))
        return rim_seen(f, face, segment, part, eye, distant, along)
    return sphere_seen(scene, tri, face, segment, part, eye, distant, along)


@wp.func
def tube_coordinates(scene: Scene, point: TubePoint) -> wp.vec2:
    """The two numbers that a vertex there would hold."""
    hit = RayHit()
    f = point.f
    axis = tube_axis(f)
    if f.cubic == 1:
        hit = hold(hit, point.segment, point.v, angle_around(axis, point.e))
    else:
        p0 = wp.vec4(f.c[0], f.c[1], f.c[2], f.r)
        step = wp.vec4(f.c1[0], f.c1[1], f.c1[2], f.r1)
        p0 -= point.v * step
        v = point.v
        if point.free == 0.0:
            v = wp.where(point.part == PART_END, 2.0, -1.0)
        hit = hold_segment(hit, point.segment, p0, p0 + step, point.x, v)
    return wp.vec2(hit.u, hit.v)


@wp.func
def beside_tube(point: TubePoint, least: wp.float32) -> wp.float32:
    """How far beside a point rays tell what is there."""
    if point.rim == 1:
        return wp.max(least, BEYOND * wp.length(point.f.c1))
    return wp.max(least, GRAZING * point.f.r)


@wp.func
def in_front(point: TubePoint, w: wp.vec3, curvature: wp.float32) -> wp.bool:
    """Whether a ray along w that comes to a point can find a jump there, for all that its own segments hide."""
    if point.part == PART_CREASE:
        return wp.dot(point.e, w) < 0.0 and wp.dot(point.e2, w) < 0.0
    if point.rim == 1:
        return wp.dot(point.gradient, w) < 0.0
    return curvature > 0.0


@wp.func
def ahead_of_tube(point: TubePoint, passing: Passing, w: wp.vec3, apart: wp.float32) -> wp.float32:
    """How far in front of a point rays along w meet the surface that pass it at a distance."""
    if point.part == PART_CREASE:
        first = wp.abs(wp.dot(point.e, passing.out)) / wp.max(-wp.dot(point.e, w), 1.0e-20)
        second = wp.abs(wp.dot(point.e2, passing.out)) / wp.max(-wp.dot(point.e2, w), 1.0e-20)
        return apart * wp.max(first, second)
    if point.rim == 1:
        n = wp.normalize(point.gradient)
        return apart * wp.abs(wp.dot(n, passing.out)) / wp.max(-wp.dot(n, w), 1.0e-20)
    return wp.sqrt(2.0 * apart / wp.max(passing.curvature, 1.0e-20))

"""Curves with a radius: tubes about cubic B-splines, and cones between spheres.

The flat values of the shape hold the pose, the ``HEADER``, the control points of the shape, (x, y, z, radius) each, the
same in the world, with the same radii, and for each segment the number of its first control point. The header holds a
box around the curves, their number, the number of a tree (``wp.Bvh``) over boxes of pieces of segments, and the offset
of the CPU's tree (``curves_walk.py``). Surfaces are seen from outside alone, and rays that start inside leave unseen:
only the point where a ray enters counts. A vertex holds the segment, the position along it, and the angle around it, as
fixed-point numbers in the bits of two floats (``sdfgrid.pack``).

Derivation: ``docs/theory/implicit.md#curves``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import PI, TWO_PI
from warp_psdr.kernels.primitive.curves_along import can_follow, follow_tube, must_follow
from warp_psdr.kernels.primitive.curves_search import (
    FOUND,
    GRAZES,
    SEARCHES,
    Spline,
    enter_cone,
    place_on,
    search_on,
    search_tube,
    slope_on,
    status_unfollowed,
    xyz,
)
from warp_psdr.kernels.primitive.curves_walk import BATCH, PIECES_AHEAD, PieceTree, walks_packets
from warp_psdr.kernels.primitive.sdfgrid import pack
from warp_psdr.kernels.reading import load_float, load_vec3
from warp_psdr.kernels.structs import Scene, Triangle

#: Values between the first one of the box and the control points: 16 of the box, the numbers of control points, of
#: segments and of pieces of each, the two words of the tree's number, and the eight of a ``PieceTree``.
HEADER = 29
#: Segments of one shape: as many as 20 bits tell apart.
MOST_SEGMENTS = 1048576
#: By how much boxes grow, over the distance of the ray's origin from the coordinates' own: rounding.
GROWTH = 4.0e-7
#: Rate at which the distance from a cone falls along a ray, at least, where a Newton's step mends rounding.
STEEP = 1.0e-3
#: Numbers of the two kinds (``curve_kinds.py``): cones between spheres, and tubes about B-splines.
LINEAR_CURVE, BSPLINE_CURVE = 4, 5


@wp.struct
class Curves:
    """Where the values of a shape are."""

    tree: wp.uint64
    points: wp.int32  # flat offset of the control points in the world
    firsts: wp.int32  # flat offset of the segments' first control points
    segments: wp.int32
    pieces: wp.int32  # of each segment


@wp.func
def address(scene: Scene, at: wp.int32) -> wp.uint64:
    """A number of 64 bits in two words."""
    low = wp.uint64(wp.cast(load_float(scene.values, at), wp.uint32))
    high = wp.uint64(wp.cast(load_float(scene.values, at + 1), wp.uint32))
    return low | (high << wp.uint64(32))


@wp.func
def is_spline(tri: Triangle) -> wp.bool:
    """Whether curves are tubes about B-splines; else they are cones between spheres."""
    return tri.i1 == wp.static(-1 - BSPLINE_CURVE)


@wp.func
def curves_of(scene: Scene, tri: Triangle) -> Curves:
    g = Curves()
    count = wp.int32(load_float(scene.values, tri.i0 + 16))
    g.segments = wp.int32(load_float(scene.values, tri.i0 + 17))
    g.pieces = wp.int32(load_float(scene.values, tri.i0 + 18))
    g.tree = address(scene, tri.i0 + 19)
    g.points = tri.i0 + wp.static(HEADER) + 4 * count
    g.firsts = g.points + 4 * count
    return g


@wp.func
def piece_tree(scene: Scene, tri: Triangle) -> PieceTree:
    at = tri.i0 + 21
    tree = PieceTree()
    tree.nodes = address(scene, at)
    tree.packets = address(scene, at + 2)
    tree.center = load_vec3(scene.values, at + 4)
    tree.extent = load_float(scene.values, at + 7)
    return tree


@wp.func
def point_in_world(scene: Scene, g: Curves, i: wp.int32) -> wp.vec4:
    """The i-th control point."""
    at = g.points + 4 * i
    return wp.vec4(
        load_float(scene.values, at),
        load_float(scene.values, at + 1),
        load_float(scene.values, at + 2),
        load_float(scene.values, at + 3),
    )


@wp.func
def from_place(p: wp.vec4, origin: wp.vec3) -> wp.vec4:
    """A control point relative to a place."""
    return wp.vec4(p[0] - origin[0], p[1] - origin[1], p[2] - origin[2], p[3])


@wp.func
def control_point(scene: Scene, g: Curves, i: wp.int32, origin: wp.vec3) -> wp.vec4:
    """The i-th control point, relative to a place."""
    return from_place(point_in_world(scene, g, i), origin)


@wp.func
def first_point(scene: Scene, g: Curves, segment: wp.int32) -> wp.int32:
    return wp.int32(load_float(scene.values, g.firsts + segment))


@wp.func
def bspline(p0: wp.vec4, p1: wp.vec4, p2: wp.vec4, p3: wp.vec4) -> Spline:
    """The uniform cubic B-spline of four control points."""
    s = Spline()
    s.a0 = wp.static(1.0 / 6.0) * (p0 + 4.0 * p1 + p2)
    s.a1 = 0.5 * (p2 - p0)
    s.a2 = 0.5 * ((p0 - p1) + (p2 - p1))
    s.a3 = wp.static(1.0 / 6.0) * ((p3 - p0) + 3.0 * (p1 - p2))
    return s


@wp.func
def spline_at(scene: Scene, g: Curves, segment: wp.int32, origin: wp.vec3) -> Spline:
    i = first_point(scene, g, segment)
    return bspline(
        control_point(scene, g, i, origin),
        control_point(scene, g, i + 1, origin),
        control_point(scene, g, i + 2, origin),
        control_point(scene, g, i + 3, origin),
    )


@wp.func
def near_middle(p1: wp.vec4, p2: wp.vec4, d: wp.vec3) -> wp.float32:
    """Distance along a ray from the origin to next to a segment, by its middle control points."""
    return wp.dot(0.5 * xyz(p1 + p2), d)


@wp.func
def near_segment(scene: Scene, g: Curves, segment: wp.int32, o: wp.vec3, d: wp.vec3) -> wp.float32:
    """The same of a ray from o: from there on, what is far away keeps its digits."""
    i = first_point(scene, g, segment)
    return near_middle(control_point(scene, g, i + 1, o), control_point(scene, g, i + 2, o), d)


@wp.func
def passes(s: Spline, d: wp.vec3, low: wp.float32, size: wp.float32) -> wp.bool:
    """Whether the line t d, |d| = 1, is farther from the chord of a piece than the tube reaches.

    A cubic leaves its chord by an eighth of the square of its size times its largest second derivative, its radius too.
    """
    a = place_on(s, low)
    b = place_on(s, low + size)
    bend_a = s.a2 + (3.0 * low) * s.a3
    bend_b = s.a2 + (3.0 * (low + size)) * s.a3
    leave = 0.25 * size * size * wp.sqrt(wp.max(wp.dot(bend_a, bend_a), wp.dot(bend_b, bend_b)))
    reach = 1.0001 * (wp.max(a[3], b[3]) + leave)
    p = xyz(a)
    p -= wp.dot(p, d) * d
    q = xyz(b - a)
    q -= wp.dot(q, d) * d
    near = wp.clamp(-wp.dot(p, q) / wp.max(wp.dot(q, q), 1.0e-30), 0.0, 1.0)
    p += near * q
    return wp.dot(p, p) > reach * reach


@wp.func
def angle_around(axis: wp.vec3, p: wp.vec3) -> wp.float32:
    """Angle of a direction around an axis, in turns, counted as Mitsuba's texture coordinate."""
    up = across_axis(axis)
    return wp.atan2(wp.dot(p, up), wp.dot(p, wp.cross(up, axis))) * wp.static(1.0 / TWO_PI)


@wp.func
def across_axis(axis: wp.vec3) -> wp.vec3:
    """The unit direction across a unit axis that leans towards +z; along it: y."""
    up = wp.vec3(0.0, 0.0, 1.0) - axis[2] * axis
    squared = wp.dot(up, up)
    if squared > 1.0e-12:
        return (1.0 / wp.sqrt(squared)) * up
    return wp.vec3(0.0, 1.0, 0.0)


@wp.func
def hold(hit: RayHit, segment: wp.int32, along: wp.float32, turns: wp.float32) -> RayHit:
    """A hit whose numbers hold a segment, a place along it, [0, 1], and an angle, turns."""
    around = turns - wp.floor(turns)
    number = (wp.float32(segment) + 0.5) * wp.static(1.0 / MOST_SEGMENTS)
    bits = pack(wp.vec3(along, around, number))
    held = hit
    held.u = bits[0]
    held.v = bits[1]
    return held


@wp.func
def hold_tube(hit: RayHit, segment: wp.int32, s: Spline, d: wp.vec3, t: wp.float32, v: wp.float32) -> RayHit:
    """A hit on a tube, at t d."""
    axis = wp.normalize(xyz(slope_on(s, v)))
    return hold(hit, segment, v, angle_around(axis, t * d - xyz(place_on(s, v))))


@wp.func
def enter_sphere(p: wp.vec4, d: wp.vec3) -> wp.float32:
    """Distance at which the ray t d, |d| = 1, enters a sphere; infinite if it passes."""
    q = xyz(p)
    along = wp.dot(q, d)
    beside = q - along * d
    half = p[3] * p[3] - wp.dot(beside, beside)
    if half < 0.0:
        return wp.inf
    return along - wp.sqrt(half)


@wp.func
def mended(p: wp.vec3, d: wp.vec3, b: wp.vec3, radius: wp.float32, slope: wp.float32) -> wp.float32:
    """Newton's step along d from p, next to a cone as ``enter_cone``'s, onto it.

    The point that a ray which runs along the axis is next to is far away, and what is counted from there is rounded.
    """
    inverse = 1.0 / wp.dot(b, b)
    s = inverse * wp.dot(p, b)
    s1 = inverse * wp.dot(d, b)
    beside = p - s * b
    away = wp.length(beside)
    fall = wp.dot(beside, d - s1 * b) / wp.max(away, 1.0e-30) - slope * s1
    return wp.where(fall < -wp.static(STEEP), (radius + slope * s - away) / fall, 0.0)


@wp.func
def enter_segment(p0: wp.vec4, p1: wp.vec4, d: wp.vec3) -> wp.vec2:
    """Where the ray t d, |d| = 1, enters the convex hull of two spheres: (t, place v from one to the other).

    v < 0: on the first sphere; v > 1: on the second; t infinite: it passes.
    """
    t0 = enter_sphere(p0, d)
    t1 = enter_sphere(p1, d)
    best = wp.where(t0 <= t1, wp.vec2(t0, -1.0), wp.vec2(t1, 2.0))
    b = xyz(p1 - p0)
    squared = wp.dot(b, b)
    fall = p0[3] - p1[3]
    inner = squared - fall * fall
    if inner > 0.0:
        # The spheres touch a cone along circles that do not lie above their centres.
        share = 1.0 / wp.sqrt(inner / squared)
        at = enter_cone(-xyz(p0), d, b, share * p0[3], -share * fall)
        t = at.t + mended(at.t * d - xyz(p0), d, b, share * p0[3], -share * fall)
        v = (wp.dot(t * d - xyz(p0), b) - p0[3] * fall) / inner
        if at.misses == 0 and v >= 0.0 and v <= 1.0 and t < best[0]:
            best = wp.vec2(t, v)
    return best


@wp.func
def widest_angle(b: wp.vec3, p0: wp.vec4, p1: wp.vec4) -> wp.float32:
    """Angle from the axis at which the cone between two spheres touches both."""
    length = wp.max(wp.length(b), 1.0e-30)
    return wp.acos(wp.clamp((p0[3] - p1[3]) / length, -1.0, 1.0))


@wp.func
def hold_segment(hit: RayHit, segment: wp.int32, p0: wp.vec4, p1: wp.vec4, x: wp.vec3, v: wp.float32) -> RayHit:
    """A hit on a cone with its spheres: a quarter of the place along it is each sphere's, by angle."""
    b = xyz(p1 - p0)
    axis = b / wp.max(wp.length(b), 1.0e-30)
    c = xyz(wp.lerp(p0, p1, wp.clamp(v, 0.0, 1.0)))
    p = x - c
    high = wp.dot(p, axis)
    angle = wp.atan2(wp.length(p - high * axis), high)
    touch = widest_angle(b, p0, p1)
    along = 0.25 + 0.5 * v
    if v < 0.0:
        along = 0.25 * (wp.static(PI) - angle) / wp.max(wp.static(PI) - touch, 1.0e-6)
        along = wp.min(along, 0.25)
    if v > 1.0:
        along = 1.0 - 0.25 * wp.min(angle / wp.max(touch, 1.0e-6), 1.0)
    return hold(hit, segment, along, angle_around(axis, p))


@functools.cache
def make_curve_hit(cubic: bool, shadow: bool):
    """Return ``hit(scene, tri, o, d, t_max) -> RayHit``: where a ray first enters a shape's curves, 0 < t < t_max.

    ``face`` is -1 if it does not.

    Args:
        cubic: tubes about B-splines; else cones between spheres.
        shadow: any place will do.
    """

    @wp.func
    def meet(
        scene: Scene, g: Curves, item: wp.int32, o: wp.vec3, w: wp.vec3, length: wp.float32, hit: RayHit
    ) -> RayHit:
        """What a ray meets first, of what it has met and a piece; w = d / |d|."""
        met = hit
        if wp.static(cubic):
            segment = item / g.pieces
            size = 1.0 / wp.float32(g.pieces)
            low = wp.float32(item - segment * g.pieces) * size
            near = near_segment(scene, g, segment, o, w)
            place = o + near * w
            s = spline_at(scene, g, segment, place)
            if passes(s, w, low, size):
                return met
            most = hit.t * length - near
            at = wp.vec2(wp.inf, 0.0)
            followed = must_follow(s, w, low, size)
            if not followed:
                search = search_tube(s, w, low, size, -near, most)
                while search.status == SEARCHES and not followed:
                    search = search_on(s, w, search)
                    if search.status == GRAZES:
                        followed = can_follow(s, w, low, size)
                        search.status = status_unfollowed(search)
                if search.status == FOUND:
                    at = wp.vec2(search.t, search.v)
            if followed:
                at = follow_tube(s, w, low, size, -near, most, wp.max(wp.abs(place)))
            if at[0] < wp.inf:
                met.t = (near + at[0]) / length
                met.face = 0
                if wp.static(not shadow):
                    met = hold_tube(met, segment, s, w, at[0], at[1])
        else:
            i = first_point(scene, g, item)
            near = wp.dot(xyz(control_point(scene, g, i, o)), w)
            place = o + near * w
            p0 = control_point(scene, g, i, place)
            p1 = control_point(scene, g, i + 1, place)
            found = enter_segment(p0, p1, w)
            if found[0] > -near and found[0] < hit.t * length - near:
                met.t = (near + found[0]) / length
                met.face = 0
                if wp.static(not shadow):
                    met = hold_segment(met, item, p0, p1, found[0] * w, found[1])
        return met

    @wp.func
    def curve_hit(scene: Scene, tri: Triangle, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
        hit = RayHit()
        hit.t = t_max
        hit.face = -1
        g = curves_of(scene, tri)
        length = wp.length(d)
        w = d / length
        item = wp.int32(0)
        if walks_packets():
            tree = piece_tree(scene, tri)
            after = wp.float32(-1.0)
            count = wp.int32(wp.static(BATCH))
            while count == wp.static(BATCH):
                pieces = PIECES_AHEAD(tree, o, d, hit.t, after, item)
                count = pieces.count
                for k in range(pieces.count):
                    after = pieces.enter[k]
                    if after > hit.t:
                        count = 0
                        break
                    item = pieces.items[k]
                    hit = meet(scene, g, item, o, w, length, hit)
                    if wp.static(shadow):
                        if hit.face >= 0:
                            return hit
        else:
            grown = wp.static(GROWTH) * (wp.max(wp.abs(o)) + wp.max(wp.abs(tri.normal)))
            query = wp.bvh_query_capsule(g.tree, o, d, grown)
            while wp.bvh_query_next(query, item, hit.t):
                hit = meet(scene, g, item, o, w, length, hit)
                if wp.static(shadow):
                    if hit.face >= 0:
                        return hit
        return hit

    return curve_hit

"""Pairs of curves that run through each other, triangles that run through curves, and what meshes bury.

Every segment, or triangle, is compared with the pieces whose boxes meet its own. A piece is approximated by ``FINER``
cones between spheres along its axis; those at the ends of curves count as well. Most pairs of pieces are separated by
their chords, from which a tube departs by no more than ``Chord.reach``. Parts of one curve that are next to each other
along it do not count.
"""

import warp as wp

from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.primitive.curves import (
    Curves,
    Spline,
    control_point,
    curves_of,
    first_point,
    is_spline,
    place_on,
    spline_at,
    xyz,
)
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene

#: Cones that stand for a piece of a cubic segment.
FINER = 2
#: Depth, over the smaller radius, up to which what runs into a tube only touches it.
TOUCHING = 1.0e-2
#: Halvings of a chord that find where its cone leaves another: to a hundredth of its length.
HALVINGS = 7
#: Distance along a curve, over the radius, up to which its own parts are next to each other.
APART = 4.0


@wp.struct
class Chord:
    """A part of a curve: its ends, with radii, and how far from the line between them its tube reaches."""

    start: wp.vec4
    end: wp.vec4
    reach: wp.float32


@wp.func
def curve_axis(scene: Scene, g: Curves, cubic: wp.bool, segment: wp.int32, origin: wp.vec3) -> Spline:
    """The axis of a segment, straight ones too."""
    if cubic:
        return spline_at(scene, g, segment, origin)
    i = first_point(scene, g, segment)
    s = Spline()
    s.a0 = control_point(scene, g, i, origin)
    s.a1 = control_point(scene, g, i + 1, origin) - s.a0
    return s


@wp.func
def chord_of(s: Spline, low: wp.float32, high: wp.float32) -> Chord:
    """A cubic leaves its chord by an eighth of the square of its size times its largest second derivative."""
    c = Chord()
    c.start = place_on(s, low)
    c.end = place_on(s, high)
    bend_a = s.a2 + (3.0 * low) * s.a3
    bend_b = s.a2 + (3.0 * high) * s.a3
    size = high - low
    leave = 0.25 * size * size * wp.sqrt(wp.max(wp.dot(bend_a, bend_a), wp.dot(bend_b, bend_b)))
    c.reach = 1.0001 * (wp.max(c.start[3], c.end[3]) + leave)
    return c


@wp.func
def chord_length(c: Chord) -> wp.float32:
    return wp.length(xyz(c.end - c.start))


@wp.func
def nearest_places(a: Chord, b: Chord) -> wp.vec2:
    """The places, 0 to 1, at which two line segments are next to each other."""
    d = xyz(a.end - a.start)
    e = xyz(b.end - b.start)
    r = xyz(a.start - b.start)
    dd = wp.dot(d, d)
    de = wp.dot(d, e)
    ee = wp.dot(e, e)
    dr = wp.dot(d, r)
    er = wp.dot(e, r)
    s = wp.clamp((de * er - ee * dr) / wp.max(dd * ee - de * de, 1.0e-12 * dd * ee + 1.0e-30), 0.0, 1.0)
    t = wp.clamp((de * s + er) / wp.max(ee, 1.0e-30), 0.0, 1.0)
    return wp.vec2(wp.clamp((de * t - dr) / wp.max(dd, 1.0e-30), 0.0, 1.0), t)


@wp.func
def chords_apart(a: Chord, b: Chord) -> wp.vec3:
    """Distance between two line segments, and the radii there."""
    v = nearest_places(a, b)
    p = wp.lerp(a.start, a.end, v[0])
    q = wp.lerp(b.start, b.end, v[1])
    return wp.vec3(wp.length(xyz(p - q)), p[3], q[3])


@wp.func
def way_along(
    scene: Scene, g: Curves, cubic: wp.bool, first: wp.int32, last: wp.int32, origin: wp.vec3, most: wp.float32
) -> wp.float32:
    """Length of the pieces of a curve between two of its pieces; where it exceeds ``most``, any such number."""
    total = wp.float32(0.0)
    k = first + 1
    while k < last and total < most:
        s = curve_axis(scene, g, cubic, k / g.pieces, origin)
        low = wp.float32(k % g.pieces) / wp.float32(g.pieces)
        total += chord_length(chord_of(s, low, low + 1.0 / wp.float32(g.pieces)))
        k += 1
    return total


@wp.func
def gap_beside(a: Chord, b: Chord, v: wp.float32) -> wp.float32:
    """Distance of the sphere at a place of a chord from the cone of another."""
    p = wp.lerp(a.start, a.end, v)
    c = Chord()
    c.start = p
    c.end = p
    near = chords_apart(c, b)
    return near[0] - near[1] - near[2]


@wp.func
def common_part(a: Chord, b: Chord) -> wp.vec2:
    """The places of a chord between which its cone runs into that of another; (0, -1): nowhere."""
    at = nearest_places(a, b)[0]
    near = chords_apart(a, b)
    if near[1] + near[2] - near[0] <= wp.static(TOUCHING) * wp.min(near[1], near[2]):
        return wp.vec2(0.0, -1.0)
    # The gap is convex along the chord.
    first = wp.float32(0.0)
    last = wp.float32(1.0)
    if gap_beside(a, b, 0.0) > 0.0:
        outside = wp.float32(0.0)
        first = at
        for _k in range(wp.static(HALVINGS)):
            middle = 0.5 * (outside + first)
            if gap_beside(a, b, middle) > 0.0:
                outside = middle
            else:
                first = middle
        first = outside
    if gap_beside(a, b, 1.0) > 0.0:
        outside = wp.float32(1.0)
        last = at
        for _k in range(wp.static(HALVINGS)):
            middle = 0.5 * (outside + last)
            if gap_beside(a, b, middle) > 0.0:
                outside = middle
            else:
                last = middle
        last = outside
    return wp.vec2(first, last)


@wp.func
def depth_at(c: Chord, v: wp.float32, apart: wp.float32) -> wp.float32:
    """How deep something at a distance from a place of a chord runs into its cone, over the radius there."""
    return 1.0 - apart / wp.max(wp.lerp(c.start[3], c.end[3], v), 1.0e-30)


@wp.func
def side_depth(c: Chord, p: wp.vec3, q: wp.vec3) -> wp.float32:
    """The same of a line segment."""
    side = Chord()
    side.start = wp.vec4(p[0], p[1], p[2], 0.0)
    side.end = wp.vec4(q[0], q[1], q[2], 0.0)
    v = nearest_places(c, side)
    place = xyz(wp.lerp(c.start, c.end, v[0]))
    return depth_at(c, v[0], wp.length(place - wp.lerp(p, q, v[1])))


@wp.func
def face_depth(c: Chord, p: wp.vec3, q: wp.vec3, r: wp.vec3) -> wp.float32:
    """The same of the inside of a triangle, at the ends of a chord and where it passes the triangle's plane."""
    n = wp.cross(q - p, r - p)
    squared = wp.max(wp.dot(n, n), 1.0e-30)
    start = xyz(c.start)
    along = xyz(c.end) - start
    fall = wp.dot(n, along)
    passes_at = wp.clamp(wp.dot(p - start, n) / wp.where(fall == 0.0, 1.0, fall), 0.0, 1.0)
    deepest = wp.float32(-1.0e30)
    for k in range(3):
        v = wp.where(k == 0, 0.0, wp.where(k == 1, 1.0, passes_at))
        place = start + v * along
        foot = place - (wp.dot(place - p, n) / squared) * n
        low = wp.min(wp.dot(wp.cross(q - p, foot - p), n), wp.dot(wp.cross(r - q, foot - q), n))
        if wp.min(low, wp.dot(wp.cross(p - r, foot - r), n)) >= 0.0:
            deepest = wp.max(deepest, depth_at(c, v, wp.length(place - foot)))
    return deepest


@wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
def find_overlaps(
    # Scene:
    scene: Scene,
    # In:
    record: wp.int32,
    other: wp.int32,
    # Out:
    count_out: wp.array(dtype=wp.int32),
    pairs_out: wp.array(dtype=wp.vec2i),
    places_out: wp.array(dtype=wp.vec4),
    lengths_out: wp.array(dtype=wp.vec2),
):
    """One thread a segment of the shape of a record: where it runs through another's curves.

    Args:
        scene: the scene.
        record: number of the record of a shape of curves.
        other: that of another, or the same.
        count_out: (1,) raised by the number of pairs of cones that do.
        pairs_out: their segments, as many as there is room for.
        places_out: a sphere around what they have in common.
        lengths_out: the length of the first one's axis in there, and the smaller radius.
    """
    own = wp.tid()
    tri = triangle_at(scene, record)
    tri_b = triangle_at(scene, other)
    g = curves_of(scene, tri)
    h = curves_of(scene, tri_b)
    cubic = is_spline(tri)
    cubic_b = is_spline(tri_b)
    i = first_point(scene, g, own)
    # Relative to its own first point, so that thin tubes keep their digits.
    origin = xyz(control_point(scene, g, i, wp.vec3(0.0, 0.0, 0.0)))
    s = curve_axis(scene, g, cubic, own, origin)
    whole = chord_of(s, 0.0, 1.0)
    size = 1.0 / wp.float32(g.pieces)
    size_b = 1.0 / wp.float32(h.pieces)
    grow = wp.vec3(whole.reach, whole.reach, whole.reach)
    query = wp.bvh_query_aabb(
        h.tree,
        origin + wp.min(xyz(whole.start), xyz(whole.end)) - grow,
        origin + wp.max(xyz(whole.start), xyz(whole.end)) + grow,
    )
    item = wp.int32(0)
    while wp.bvh_query_next(query, item):
        segment = item / h.pieces
        if record == other and segment < own:
            continue
        connected = record == other and first_point(scene, h, segment) - i == segment - own
        t = curve_axis(scene, h, cubic_b, segment, origin)
        low_b = wp.float32(item - segment * h.pieces) * size_b
        b = chord_of(t, low_b, low_b + size_b)
        if chords_apart(whole, b)[0] > whole.reach + b.reach:
            continue
        for k in range(g.pieces):
            if connected and own * g.pieces + k >= item:
                break
            low = wp.float32(k) * size
            a = chord_of(s, low, low + size)
            if chords_apart(a, b)[0] > a.reach + b.reach:
                continue
            apart = wp.float32(0.0)
            if connected:
                most = wp.static(APART) * wp.max(a.reach, b.reach)
                apart = way_along(scene, g, cubic, own * g.pieces + k, item, origin, most)
            length_a = chord_length(a) / wp.static(float(FINER))
            length_b = chord_length(b) / wp.static(float(FINER))
            for n in range(wp.static(FINER * FINER)):
                of_a = n / wp.static(FINER)
                of_b = n % wp.static(FINER)
                start = low + size * (wp.float32(of_a) / wp.static(float(FINER)))
                start_b = low_b + size_b * (wp.float32(of_b) / wp.static(float(FINER)))
                c = chord_of(s, start, start + size / wp.static(float(FINER)))
                d = chord_of(t, start_b, start_b + size_b / wp.static(float(FINER)))
                way = apart + wp.float32(wp.static(FINER) - 1 - of_a) * length_a + wp.float32(of_b) * length_b
                radius = wp.max(wp.max(c.start[3], c.end[3]), wp.max(d.start[3], d.end[3]))
                if connected and way < wp.static(APART) * radius:
                    continue
                part = common_part(c, d)
                if part[1] <= part[0]:
                    continue
                at = wp.atomic_add(count_out, 0, 1)
                if at < pairs_out.shape[0]:
                    axis = xyz(c.end - c.start)
                    inside = (part[1] - part[0]) * wp.length(axis)
                    middle = origin + xyz(c.start) + 0.5 * (part[0] + part[1]) * axis
                    pairs_out[at] = wp.vec2i(own, segment)
                    places_out[at] = wp.vec4(middle[0], middle[1], middle[2], 0.5 * inside + c.reach)
                    least = wp.min(wp.max(c.start[3], c.end[3]), wp.max(d.start[3], d.end[3]))
                    lengths_out[at] = wp.vec2(inside, least)


@wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
def find_pierced(
    # Scene:
    scene: Scene,
    # In:
    record: wp.int32,
    corners: wp.array(dtype=wp.vec3, ndim=2),
    nearly: wp.int32,
    # Out:
    count_out: wp.array(dtype=wp.int32),
    pairs_out: wp.array(dtype=wp.vec2i),
):
    """One thread a triangle: which segments of the curves of a record's shape it runs through.

    Args:
        scene: the scene.
        record: number of the record of a shape of curves.
        corners: (M, 3).
        nearly: 1: all that it may run through, those that it touches included.
        count_out: (1,) raised by the number of pairs; one is counted for each piece.
        pairs_out: the numbers of triangles and segments, as many as there is room for.
    """
    i = wp.tid()
    tri = triangle_at(scene, record)
    g = curves_of(scene, tri)
    cubic = is_spline(tri)
    a = corners[i, 0]
    b = corners[i, 1]
    c = corners[i, 2]
    size = 1.0 / wp.float32(g.pieces * wp.static(FINER))
    query = wp.bvh_query_aabb(g.tree, wp.min(a, wp.min(b, c)), wp.max(a, wp.max(b, c)))
    item = wp.int32(0)
    while wp.bvh_query_next(query, item):
        segment = item / g.pieces
        # Relative to a point of the segment, so that thin tubes keep their digits.
        origin = xyz(control_point(scene, g, first_point(scene, g, segment), wp.vec3(0.0, 0.0, 0.0)))
        s = curve_axis(scene, g, cubic, segment, origin)
        p = a - origin
        q = b - origin
        r = c - origin
        for k in range(wp.static(FINER)):
            low = wp.float32((item - segment * g.pieces) * wp.static(FINER) + k) * size
            cone = chord_of(s, low, low + size)
            least = wp.float32(wp.static(TOUCHING))
            if nearly == 1:
                cone.start[3] = cone.reach
                cone.end[3] = cone.reach
                least = 0.0
            depth = wp.max(side_depth(cone, p, q), wp.max(side_depth(cone, q, r), side_depth(cone, r, p)))
            if wp.max(depth, face_depth(cone, p, q, r)) > least:
                at = wp.atomic_add(count_out, 0, 1)
                if at < pairs_out.shape[0]:
                    pairs_out[at] = wp.vec2i(i, segment)


@wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
def find_buried(
    # In:
    mesh: wp.uint64,
    places: wp.array(dtype=wp.vec4),
    # Out:
    buried_out: wp.array(dtype=wp.int32),
):
    """One thread a sphere (center, radius): whether all of it is inside of a closed mesh.

    Args:
        mesh: a ``wp.Mesh`` with winding numbers.
        places: (N,).
        buried_out: (N,) set to 1 where it is.
    """
    i = wp.tid()
    p = xyz(places[i])
    found = wp.mesh_query_point_sign_winding_number(mesh, p, 1.0e30)
    q = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
    if found.result and found.sign < 0.0 and wp.length(p - q) > places[i][3]:
        buried_out[i] = 1

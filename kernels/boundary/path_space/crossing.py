"""Pairs of triangles that may run through each other: candidates for curves of intersection.

A pair is a candidate in two cases. Either each triangle has corners on both sides of the other's plane, by more than a
tolerance, and the intervals that both cover of the planes' common line overlap. Or one has a corner below the other's
plane and an edge in it. Pairs that share an edge are left out. The host decides which candidates intersect, and where
(``warp_psdr/topology/intersection_curves.py``); it would leave out every pair that is left out here.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.near import make_near_pairs
from warp_psdr.kernels.bvh.wide import Accel
from warp_psdr.kernels.modules import pairs_module

#: Share of the tolerance by which intervals have to overlap here; the host asks for all of it.
OVERLAP = 0.5


@wp.struct
class Plane:
    """The plane n . (x - a) = 0 of a triangle; n has unit length, or is 0 for a triangle without area."""

    a: wp.vec3d
    n: wp.vec3d


@wp.func
def plane_of(points: wp.array(dtype=wp.vec3), p: wp.vec3i) -> Plane:
    r = Plane()
    r.a = wp.vec3d(points[p[0]])
    r.n = wp.cross(wp.vec3d(points[p[1]]) - r.a, wp.vec3d(points[p[2]]) - r.a)
    length = wp.length(r.n)
    if length > wp.float64(0.0):
        r.n = r.n / length
    return r


@wp.func
def height(plane: Plane, x: wp.vec3, tolerance: wp.float64) -> wp.float64:
    h = wp.dot(plane.n, wp.vec3d(x) - plane.a)
    return wp.where(wp.abs(h) <= tolerance, wp.float64(0.0), h)


@wp.func
def heights(points: wp.array(dtype=wp.vec3), plane: Plane, q: wp.vec3i, tolerance: wp.float64) -> wp.vec3d:
    """Heights of a triangle's corners above a plane; within the tolerance 0."""
    return wp.vec3d(
        height(plane, points[q[0]], tolerance),
        height(plane, points[q[1]], tolerance),
        height(plane, points[q[2]], tolerance),
    )


@wp.func
def straddles(h: wp.vec3d) -> wp.int32:
    """2: corners on both sides; 1: one below and two in the plane; 0: neither."""
    zero = wp.float64(0.0)
    low = wp.min(wp.min(h[0], h[1]), h[2])
    high = wp.max(wp.max(h[0], h[1]), h[2])
    if low < zero:
        if high > zero:
            return 2
        middle = h[0] + h[1] + h[2] - low - high
        if high == zero and middle == zero:
            return 1
    return 0


@wp.func
def crossed(a: wp.vec3, b: wp.vec3, h_a: wp.float64, h_b: wp.float64, origin: wp.vec3d, along: wp.vec3d) -> wp.float64:
    """Where on a line the side from a to b meets the plane."""
    at = h_a / (h_a - h_b)
    x = (wp.float64(1.0) - at) * wp.vec3d(a) + at * wp.vec3d(b)
    return wp.dot(x - origin, along)


@wp.func
def interval(points: wp.array(dtype=wp.vec3), q: wp.vec3i, h: wp.vec3d, origin: wp.vec3d, along: wp.vec3d) -> wp.vec2d:
    """What a triangle covers of a line in a plane above and below which it has corners, of the heights h."""
    zero = wp.float64(0.0)
    a = points[q[0]]
    b = points[q[1]]
    c = points[q[2]]
    # Turned until the corner that is alone on its side comes first.
    one = (h[0] < zero) != (h[1] < zero)
    two = (h[1] < zero) != (h[2] < zero)
    s = crossed(a, b, h[0], h[1], origin, along)
    t = crossed(a, c, h[0], h[2], origin, along)
    if one and two:
        s = crossed(b, c, h[1], h[2], origin, along)
        t = crossed(b, a, h[1], h[0], origin, along)
    elif two:
        s = crossed(c, a, h[2], h[0], origin, along)
        t = crossed(c, b, h[2], h[1], origin, along)
    return wp.vec2d(wp.min(s, t), wp.max(s, t))


@wp.func
def share_an_edge(g: wp.vec3i, h: wp.vec3i) -> bool:
    """Whether two triangles have two positions in common; g, h: numbers of the corners' positions."""
    shared = wp.int32(0)
    for k in range(3):
        if h[k] == g[0] or h[k] == g[1] or h[k] == g[2]:
            shared += 1
    return shared >= 2


@wp.func
def may_cross(points: wp.array(dtype=wp.vec3), p: wp.vec3i, plane_p: Plane, q: wp.vec3i, tolerance: wp.float64) -> bool:
    """Whether two triangles that share no edge are a candidate."""
    h_q = heights(points, plane_p, q, tolerance)
    across_p = straddles(h_q)
    if across_p == 0:
        return False
    plane_q = plane_of(points, q)
    h_p = heights(points, plane_q, p, tolerance)
    across_q = straddles(h_p)
    if across_p < 2 or across_q < 2:
        return across_q > 0
    along = wp.normalize(wp.cross(plane_p.n, plane_q.n))
    origin = wp.vec3d(points[p[0]])
    a = interval(points, p, h_p, origin, along)
    b = interval(points, q, h_q, origin, along)
    # Not the other way round: NaN of nearly parallel planes is the host's.
    return not (wp.min(a[1], b[1]) - wp.max(a[0], b[0]) <= wp.float64(OVERLAP) * tolerance)


@functools.cache
def make_crossing_packets(width: int) -> wp.Kernel:
    """Make the kernel that finds candidates in a wide BVH, one thread a packet; those of a lane run one by one.

    It writes pairs with face numbers i < j to the lane's row, and counts them. A count beyond the row's end tells how
    long a row suffices. ``groups``: numbers of the corners' positions, equal where corners are welded.
    """
    near_pairs = make_near_pairs(width)

    @wp.kernel(module=pairs_module(width), enable_backward=False)
    def crossing_pairs(
        # In:
        accel: Accel,
        points: wp.array(dtype=wp.vec3),
        triangles: wp.array(dtype=wp.vec3i),
        groups: wp.array(dtype=wp.vec3i),
        tolerance: wp.float64,
        first: wp.int32,
        lane: wp.int32,
        # Out:
        count_out: wp.array(dtype=wp.int32),
        pairs_out: wp.array2d(dtype=wp.vec2i),
    ):
        room = pairs_out.shape[1]
        kept = count_out[lane]
        end = kept + near_pairs(accel, first + wp.tid(), tolerance, pairs_out, lane, kept)
        for at in range(kept, wp.min(end, room)):
            pair = pairs_out[lane, at]
            if not share_an_edge(groups[pair[0]], groups[pair[1]]):
                p = triangles[pair[0]]
                if may_cross(points, p, plane_of(points, p), triangles[pair[1]], tolerance):
                    pairs_out[lane, kept] = pair
                    kept += 1
        count_out[lane] = wp.where(end > room, end, kept)

    return crossing_pairs


@functools.cache
def make_crossing_triangles() -> wp.Kernel:
    """Make the kernel that finds candidates in a ``wp.Mesh``, one thread a triangle, and writes them likewise."""

    @wp.kernel(module=pairs_module(1), enable_backward=False)
    def crossing_pairs(
        # In:
        accel: Accel,
        points: wp.array(dtype=wp.vec3),
        triangles: wp.array(dtype=wp.vec3i),
        groups: wp.array(dtype=wp.vec3i),
        tolerance: wp.float64,
        first: wp.int32,
        lane: wp.int32,
        # Out:
        count_out: wp.array(dtype=wp.int32),
        pairs_out: wp.array2d(dtype=wp.vec2i),
    ):
        i = first + wp.tid()
        p = triangles[i]
        low = wp.min(wp.min(points[p[0]], points[p[1]]), points[p[2]])
        high = wp.max(wp.max(points[p[0]], points[p[1]]), points[p[2]])
        plane_p = plane_of(points, p)
        query = wp.mesh_query_aabb(accel.mesh_id, low, high)
        j = wp.int32(0)
        while wp.mesh_query_aabb_next(query, j):
            if j > i and not share_an_edge(groups[i], groups[j]):
                if may_cross(points, p, plane_p, triangles[j], tolerance):
                    at = wp.atomic_add(count_out, lane, 1)
                    if at < pairs_out.shape[1]:
                        pairs_out[lane, at] = wp.vec2i(i, j)

    return crossing_pairs

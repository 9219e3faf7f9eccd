"""Pairs of triangles that may run through each other: candidates of the curves of intersection.

A pair counts if each triangle has corners on both sides of the plane of the other, by more than a tolerance, or a
corner below it and an edge in it; pairs that share an edge do not. Which of them do intersect, and where, the host
decides.
"""

import warp as wp


@wp.func
def height(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, x: wp.vec3) -> wp.float64:
    """Height of x above the plane of a triangle; 0 for one without area."""
    n = wp.cross(b - a, c - a)
    length = wp.length(n)
    if length <= wp.float64(0.0):
        return wp.float64(0.0)
    return wp.dot(n, wp.vec3d(x) - a) / length


@wp.func
def straddles(points: wp.array(dtype=wp.vec3), p: wp.vec3i, q: wp.vec3i, tolerance: wp.float64) -> wp.bool:
    """Whether triangle q has corners on both sides of the plane of p, or one below and two in it."""
    a = wp.vec3d(points[p[0]])
    b = wp.vec3d(points[p[1]])
    c = wp.vec3d(points[p[2]])
    below = wp.int32(0)
    above = wp.int32(0)
    for k in range(3):
        h = height(a, b, c, points[q[k]])
        if h < -tolerance:
            below += 1
        if h > tolerance:
            above += 1
    return below > 0 and (above > 0 or below == 1)


@wp.kernel(module="unique", enable_backward=False)
def crossing_pairs(
    # In:
    boxes: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    triangles: wp.array(dtype=wp.vec3i),
    groups: wp.array(dtype=wp.vec3i),
    tolerance: wp.float32,
    # Out:
    count_out: wp.array(dtype=wp.int32),
    pairs_out: wp.array(dtype=wp.vec2i),
):
    """Write the pairs with face numbers i < j; those past the end of ``pairs_out`` are counted only.

    ``groups``: numbers of the corners' positions, equal where corners are welded.
    """
    i = wp.tid()
    p = triangles[i]
    g = groups[i]
    low = wp.min(wp.min(points[p[0]], points[p[1]]), points[p[2]])
    high = wp.max(wp.max(points[p[0]], points[p[1]]), points[p[2]])
    query = wp.bvh_query_aabb(boxes, low, high)
    j = wp.int32(0)
    while wp.bvh_query_next(query, j):
        if j > i:
            h = groups[j]
            shared = wp.int32(0)
            for k in range(3):
                if h[k] == g[0] or h[k] == g[1] or h[k] == g[2]:
                    shared += 1
            q = triangles[j]
            if (
                shared < 2
                and straddles(points, p, q, wp.float64(tolerance))
                and straddles(points, q, p, wp.float64(tolerance))
            ):
                at = wp.atomic_add(count_out, 0, 1)
                if at < pairs_out.shape[0]:
                    pairs_out[at] = wp.vec2i(i, j)

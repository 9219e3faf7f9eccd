"""Edges that lie on triangles of other shapes: where surfaces touch along more than a point.

Two triangles that touch along a segment or an area, without running through each other, touch along an edge of one of
them. If they lie in one plane, they overlap in a polygon bounded by pieces of both's edges. Otherwise they touch on the
line that their planes share, which one of them reaches with an edge only. It therefore suffices to clip every edge to
every triangle near it.
"""

import functools

import warp as wp

from warp_psdr.kernels.modules import pairs_module


@wp.func
def clip(low: wp.float64, high: wp.float64, a: wp.float64, b: wp.float64) -> wp.vec2d:
    """Part of the interval (low, high) where the linear function with values a at 0 and b at 1 is not negative."""
    if a < wp.float64(0.0) and b < wp.float64(0.0):
        return wp.vec2d(wp.float64(1.0), wp.float64(0.0))
    r = wp.vec2d(low, high)
    if a < wp.float64(0.0):
        r[0] = wp.max(low, a / (a - b))
    if b < wp.float64(0.0):
        r[1] = wp.min(high, a / (a - b))
    return r


@functools.cache
def make_touching_pairs(width: int) -> wp.Kernel:
    """Make the kernel that finds edges on triangles; ``width`` says which module it is in."""

    @wp.kernel(module=pairs_module(width), enable_backward=False)
    def touching_pairs(
        # In:
        boxes: wp.uint64,
        corners: wp.array2d(dtype=wp.vec3),
        shapes: wp.array(dtype=wp.int32),
        tolerance: wp.float64,
        rounding: wp.float64,
        steepest: wp.float64,
        # Out:
        count_out: wp.array(dtype=wp.int32),
        pairs_out: wp.array(dtype=wp.vec3i),
        spans_out: wp.array(dtype=wp.vec2),
    ):
        """Write (triangle, first corner of its edge, triangle of another shape) and the part of the edge on the latter.

        Args:
            boxes: ``wp.Bvh`` of the triangles.
            corners: (n, 3) of the triangles.
            shapes: (n,) which shape they belong to.
            tolerance: distance, in world units, of what touches.
            rounding: the same for short pieces, which touch if they are closer than ``steepest`` times their length:
                the lowest edges of a fine ball that stands on a floor hang above it.
            steepest: largest sine of the angle between an edge and a triangle that it lies on.
            count_out: (1,) how many pairs there are; those past the end of ``pairs_out`` are counted only.
            pairs_out: (m,).
            spans_out: (m,) fractions of the way along the edge.
        """
        thread = wp.tid()
        i = thread // 3
        k = thread - 3 * i
        p = wp.vec3d(corners[i, k])
        q = wp.vec3d(corners[i, (k + 1) % 3])
        along = q - p
        length = wp.length(along)
        least = wp.float64(4.0) * tolerance
        if length <= least:
            return
        margin = wp.vec3(wp.float32(tolerance), wp.float32(tolerance), wp.float32(tolerance))
        low = wp.min(corners[i, k], corners[i, (k + 1) % 3]) - margin
        high = wp.max(corners[i, k], corners[i, (k + 1) % 3]) + margin
        query = wp.bvh_query_aabb(boxes, low, high)
        j = wp.int32(0)
        while wp.bvh_query_next(query, j):
            if shapes[j] != shapes[i]:
                a = wp.vec3d(corners[j, 0])
                n = wp.cross(wp.vec3d(corners[j, 1]) - a, wp.vec3d(corners[j, 2]) - a)
                if wp.length(n) > wp.float64(0.0):
                    n = wp.normalize(n)
                    if wp.abs(wp.dot(n, along)) <= steepest * length:
                        span = wp.vec2d(wp.float64(0.0), wp.float64(1.0))
                        for m in range(3):
                            start = wp.vec3d(corners[j, m])
                            inward = wp.cross(n, wp.normalize(wp.vec3d(corners[j, (m + 1) % 3]) - start))
                            span = clip(
                                span[0],
                                span[1],
                                wp.dot(inward, p - start) + tolerance,
                                wp.dot(inward, q - start) + tolerance,
                            )
                        h0 = wp.dot(n, p + span[0] * along - a)
                        h1 = wp.dot(n, p + span[1] * along - a)
                        piece = (span[1] - span[0]) * length
                        reach = wp.max(rounding, wp.min(tolerance, steepest * piece))
                        if piece > least and wp.max(wp.abs(h0), wp.abs(h1)) <= reach:
                            at = wp.atomic_add(count_out, 0, 1)
                            if at < pairs_out.shape[0]:
                                pairs_out[at] = wp.vec3i(i, k, j)
                                spans_out[at] = wp.vec2(wp.float32(span[0]), wp.float32(span[1]))

    return touching_pairs

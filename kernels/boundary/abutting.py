"""Shadows of shapes that abut without sharing vertices: one silhouette, on which an edge of each shape lies.

Where a wall stands on a part of a floor's border, light from behind passes both along one line. Whichever of the two
edges a segment touches, it is free on the other side, and counts all of the jump: the edges share it, and each moves
its own shape. An edge that the other shape reaches beyond is no silhouette: what hides its segments does so by itself.

With offset the distance of the other edge from the segment's plane, away from the occluder, the edge in front,
offset = 0, hides segments at the other from offset < -step on, step the distance at which these pass; up to there both
count. What is seen on the film is told apart by its own means (``primary.py``), which know what covers what.
"""

import warp as wp

from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, edge_step, facing_side
from warp_psdr.kernels.structs import Scene


@wp.func
def edge_share(
    scene: Scene, edges: Edges, point: EdgePoint, along: wp.vec3, w: wp.vec3, side: wp.float32
) -> wp.float32:
    """Return the part of the jump at a point of a silhouette that is its own edge's.

    Args:
        scene: the scene.
        edges: with ``beside``.
        point: on one of them.
        along: its unit tangent.
        w: direction of the segment, a unit vector.
        side: of ``facing_side`` there.
    """
    count = wp.int32(1)
    if edges.beside_first.shape[0] > 1:
        outward = -side * wp.normalize(wp.cross(along, w))
        for i in range(edges.beside_first[point.edge], edges.beside_first[point.edge + 1]):
            other = EdgePoint()
            other.edge = edges.beside[i]
            other.p0 = edges.points[other.edge, 0]
            other.p1 = edges.points[other.edge, 1]
            way = other.p1 - other.p0
            r = point.x - other.p0
            t = wp.dot(r, way)
            if t >= 0.0 and t < wp.dot(way, way) and facing_side(scene, edges, other, along, w) == side:
                if wp.dot(r, outward) < edge_step(scene, edges, other.edge):
                    count += 1
    return 1.0 / wp.float32(count)

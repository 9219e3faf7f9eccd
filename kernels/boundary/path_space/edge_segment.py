"""The beginning of a boundary segment at a point of an edge, which all estimators of the secondary boundary share.

Derivation: ``docs/theory/boundary.md#secondary-boundary``.
"""

import warp as wp

from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, edge_step, facing_side
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.structs import Scene


@wp.func
def moves(scene: Scene, moving: wp.array(dtype=wp.int32), face: wp.int32) -> wp.int32:
    return moving[scene.triangles[face].shape]


@wp.func
def edge_segment(
    scene: Scene, edges: Edges, moving: wp.array(dtype=wp.int32), point: EdgePoint, along: wp.vec3, w: wp.vec3
) -> tuple[Segment, wp.float32, wp.int32]:
    """Return a Segment without ends, on which side the edge is a silhouette for w, 0: on none, and whether it moves.

    ``along``: the edge's unit tangent.
    """
    r = Segment()
    r.face2 = -1
    r.light = -1
    r.w = w
    m = wp.cross(along, w)
    side = facing_side(scene, edges, point, along, w)
    sine = wp.length(m)
    moved = wp.int32(0)
    if side == 0.0 or sine <= 0.0:
        return r, wp.float32(0.0), moved
    r.boundary_normal = side * m
    r.step = edge_step(scene, edges, point.edge)
    r.x = point.x - (r.step / sine) * r.boundary_normal
    for i in range(edges.first[point.edge], edges.first[point.edge + 1]):
        moved += moves(scene, moving, edges.faces[i])
    return r, side, moved

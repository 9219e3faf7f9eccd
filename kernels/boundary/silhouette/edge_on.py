"""Sheets seen edge-on: for example the wall of a box under a sun straight above it.

A ray in the plane of such a sheet touches all of it, from one end to the other. Rounding would decide at each end by
itself whether it is a silhouette, so that both ends count, or neither. Here one end counts: the first to which a ray
along w comes. For the camera that is the end in front. For a segment towards a light it is the end that faces away from
the light, because the other end may stand on the surface at which the segment starts.

Derivation: ``docs/theory/implicit.md#sheets-seen-from-their-edges``.
"""

import warp as wp

#: Sine of the angle up to which a sheet counts as seen from its edge: above rounding, and so small that rays in the
#: plane, which start beside it, do not meet it.
EDGEWISE = wp.constant(1.0e-6)


@wp.func
def is_beside(sheet: wp.vec3, normal: wp.vec3, w: wp.vec3, edge_on: wp.float32) -> wp.bool:
    """Whether a sheet that goes away from an edge lies on the side of a normal of a plane that holds edge and w.

    ``edge_on``: sine up to which it is seen from its edge.
    """
    slack = edge_on * wp.length(sheet) * wp.length(normal)
    return wp.dot(sheet, normal) > wp.where(wp.dot(sheet, w) > 0.0, -slack, slack)

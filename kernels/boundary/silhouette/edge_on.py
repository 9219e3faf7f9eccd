"""Sheets that are seen from their edges: the wall of a box under a sun that stands over it.

Rays in the plane of such a sheet touch all of it, from one of its ends to the other. Rounding would say of each end by
itself whether it is a silhouette, so that both are, or neither. Here the first end that a ray along w comes to is: of a
camera's rays that in front, of segments towards a light that which faces away from the light, for the other may stand
on what the segment comes from.

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

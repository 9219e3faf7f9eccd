"""The record that the role "samples" keeps of a boundary sample: its point, and the derivative by that point.

The point lies on an edge or on the outline of a shape without triangles, where the tangent takes the edge's place.
"""

import warp as wp

from warp_psdr.kernels.invalid import finite

#: Numbers a sample: x_b, the edge from its first to its second end or a tangent of any length, the adjoint of x_b.
SAMPLE_RECORD = 9


@wp.func
def record_pull(
    target: wp.array(dtype=wp.float32), sample: wp.int32, x: wp.vec3, along: wp.vec3, g: wp.vec3
) -> wp.float32:
    """Write a sample's record, g added up over its pushes; 1 instead if g is not finite."""
    if not finite(g):
        return 1.0
    first = SAMPLE_RECORD * sample
    for i in range(3):
        target[first + i] = x[i]
        target[first + 3 + i] = along[i]
        target[first + 6 + i] += g[i]
    return 0.0

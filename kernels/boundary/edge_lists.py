"""Takes edges out of a list, on the host's processor."""

import warp as wp

from warp_psdr.kernels.modules import LISTS


@wp.kernel(module=LISTS, enable_backward=False)
def take_edges(
    # In:
    numbers: wp.array(dtype=wp.int32),
    start: wp.array(dtype=wp.int32),
    points: wp.array2d(dtype=wp.vec3d),
    ends: wp.array2d(dtype=wp.int32),
    twins: wp.array2d(dtype=wp.int32),
    faces: wp.array(dtype=wp.int32),
    first_face: wp.array(dtype=wp.int32),
    first: wp.int32,
    # Out:
    points_out: wp.array2d(dtype=wp.vec3),
    ends_out: wp.array2d(dtype=wp.int32),
    twins_out: wp.array2d(dtype=wp.int32),
    faces_out: wp.array(dtype=wp.int32),
):
    """Write the edges of some ``numbers``, the triangles of each from ``start`` on (``Edges``)."""
    i = first + wp.tid()
    edge = numbers[i]
    for k in range(2):
        points_out[i, k] = wp.vec3(points[edge, k])
        ends_out[i, k] = ends[edge, k]
        twins_out[i, k] = twins[edge, k]
    for k in range(start[i + 1] - start[i]):
        faces_out[start[i] + k] = faces[first_face[edge] + k]

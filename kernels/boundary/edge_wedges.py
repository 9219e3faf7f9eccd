"""Normals of triangles, and lengths and dihedral angles of their edges, in double precision on the host's processor."""

import warp as wp

from warp_psdr.kernels.modules import LISTS

#: Least length by which is divided: a vector of length 0 stays 0.
LEAST = 1.0e-300


@wp.func
def positive(x: wp.float64) -> wp.float64:
    return wp.max(x, wp.float64(LEAST))


@wp.kernel(module=LISTS, enable_backward=False)
def face_normals(
    # In:
    points: wp.array(dtype=wp.vec3d),
    triangles: wp.array(dtype=wp.vec3i),
    first: wp.int32,
    # Out:
    normal_out: wp.array(dtype=wp.vec3d),
):
    """Write a triangle's normal, as long as twice its area."""
    i = first + wp.tid()
    a = points[triangles[i][0]]
    normal_out[i] = wp.cross(points[triangles[i][1]] - a, points[triangles[i][2]] - a)


@wp.kernel(module=LISTS, enable_backward=False)
def edge_wedges(
    # In:
    points: wp.array(dtype=wp.vec3d),
    triangles: wp.array(dtype=wp.vec3i),
    ends: wp.array(dtype=wp.vec2i),
    faces: wp.array(dtype=wp.int32),
    first_face: wp.array(dtype=wp.int32),
    far: wp.array(dtype=wp.float64),
    needle: wp.float64,
    tilt: wp.float64,
    first: wp.int32,
    # Out:
    length_out: wp.array(dtype=wp.float64),
    turn_out: wp.array(dtype=wp.vec2d),
    tilt_out: wp.array(dtype=wp.float64),
):
    """Write the length of an edge, and the sine and cosine, up to a factor, of the angle between its two triangles.

    ``tilt_out``: the angle by which rounding turns the less tall one, if its height over the edge is below ``needle``
    of the edge's length; ``tilt``: that angle times the height, in ``far``, the largest coordinate.
    """
    i = first + wp.tid()
    begin = points[ends[i][0]]
    along = points[ends[i][1]] - begin
    length = wp.length(along)
    along = along / positive(length)
    start = first_face[i]
    second = start
    if first_face[i + 1] - start == 2:
        second = start + 1
    p = triangles[faces[start]]
    q = triangles[faces[second]]
    a = points[p[0]]
    b = points[p[1]]
    c = points[p[2]]
    doubled = wp.length(wp.cross(b - a, c - a))
    # Directions from the edge into its faces, perpendicular to the edge.
    into_p = (a + b + c) / wp.float64(3.0) - begin
    into_p = into_p - wp.dot(into_p, along) * along
    a = points[q[0]]
    b = points[q[1]]
    c = points[q[2]]
    doubled = wp.min(doubled, wp.length(wp.cross(b - a, c - a)))
    into_q = (a + b + c) / wp.float64(3.0) - begin
    into_q = into_q - wp.dot(into_q, along) * along
    length_out[i] = length
    turn_out[i] = wp.vec2d(wp.length(wp.cross(into_p, into_q)), wp.dot(into_p, into_q))
    tall = doubled / positive(length)
    turned = wp.float64(0.0)
    if tall < needle * length:
        turned = tilt * far[ends[i][0]] / positive(tall)
    tilt_out[i] = turned

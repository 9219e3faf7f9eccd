"""How far interpolated normals turn away from triangles, in double precision on the host's processor."""

import warp as wp

from warp_psdr.kernels.boundary.edge_wedges import positive
from warp_psdr.kernels.boundary.film_clip import View, lens_spread, towards
from warp_psdr.kernels.modules import LISTS


@wp.kernel(module=LISTS, enable_backward=False)
def face_bends(
    # In:
    points: wp.array(dtype=wp.vec3),
    triangles: wp.array(dtype=wp.vec3i),
    normals: wp.array(dtype=wp.vec3),
    first: wp.int32,
    # Out:
    sine_out: wp.array(dtype=wp.float64),
):
    """Write the largest sine between a triangle's normal and the interpolated ones at its corners.

    ``normals``: at all vertices; 0 where none are interpolated.
    """
    i = first + wp.tid()
    face = triangles[i]
    a = wp.vec3d(points[face[0]])
    normal = wp.cross(wp.vec3d(points[face[1]]) - a, wp.vec3d(points[face[2]]) - a)
    normal = normal / positive(wp.length(normal))
    sine = wp.float64(0.0)
    for k in range(3):
        sine = wp.max(sine, wp.length(wp.cross(wp.vec3d(normals[face[k]]), normal)))
    sine_out[i] = sine


@wp.kernel(module=LISTS, enable_backward=False)
def terminator_weights(
    # In:
    view: View,
    points: wp.array(dtype=wp.vec3),
    triangles: wp.array(dtype=wp.vec3i),
    normals: wp.array(dtype=wp.vec3),
    floor: wp.float64,
    first: wp.int32,
    # Out:
    weight_out: wp.array(dtype=wp.float64),
):
    """Write the size of a triangle as the camera sees it, times ``floor`` where no terminator can cross it.

    ``normals``: as of ``face_bends``.
    """
    i = first + wp.tid()
    face = triangles[i]
    a = wp.vec3d(points[face[0]])
    b = wp.vec3d(points[face[1]])
    c = wp.vec3d(points[face[2]])
    low = wp.float64(wp.inf)
    high = -low
    for k in range(3):
        normal = wp.vec3d(normals[face[k]])
        facing = wp.dot(normal, towards(view, wp.vec3d(points[face[k]])))
        reach = lens_spread(view, normal)
        low = wp.min(low, facing - reach)
        high = wp.max(high, facing + reach)
    size = wp.max(wp.max(wp.length(a - b), wp.length(b - c)), wp.length(c - a))
    size = size / wp.length(towards(view, (a + b + c) / wp.float64(3.0)))
    if low <= wp.float64(0.0) and high >= wp.float64(0.0):
        weight_out[i] = size
    else:
        weight_out[i] = floor * size

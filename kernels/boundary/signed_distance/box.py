"""Shapes inside a box (grids and networks): the part of a ray in the box, and the fade of weights at its border.

Derivation: ``docs/theory/signed_distances.md#weights``.
"""

import warp as wp

from warp_psdr.kernels.boundary.signed_distance.distance import KnownRange, similar_scale
from warp_psdr.kernels.primitive.affine import cofactor, determinant, from_axes
from warp_psdr.kernels.structs import Scene, Triangle

#: Width of the border of the box in which weights fade [VSJ22], in units of the box.
FADE = 0.01


@wp.func
def known_in_box(scene: Scene, tri: Triangle, o: wp.vec3, w: wp.vec3) -> KnownRange:
    """The part of a ray in the box."""
    r = KnownRange()
    start = from_axes(tri, o - tri.normal)
    way = from_axes(tri, w)
    r.last = 1.0e30
    axis_of_entry = wp.int32(-1)
    for axis in range(3):
        if wp.abs(way[axis]) < 1.0e-12:
            if start[axis] < 0.0 or start[axis] > 1.0:
                r.last = -1.0
        else:
            low = -start[axis] / way[axis]
            high = (1.0 - start[axis]) / way[axis]
            near = wp.min(low, high)
            if near > r.first:
                r.first = near
                axis_of_entry = axis
            r.last = wp.min(r.last, wp.max(low, high))
    if axis_of_entry >= 0:
        # first = (face - start_a) / way_a.
        e = wp.vec3(0.0, 0.0, 0.0)
        e[axis_of_entry] = 1.0
        a = (1.0 / determinant(tri)) * cofactor(tri, e)
        r.first_w = (-r.first / way[axis_of_entry]) * (a - w * wp.dot(w, a))
    return r


@wp.func
def inside_box(tri: Triangle, at: wp.vec3) -> wp.vec4:
    """The share of its weight that a place of the box has, 1 but next to the border, and before it its gradient."""
    nearest = wp.float32(1.0e30)
    e = wp.vec3(0.0, 0.0, 0.0)
    for axis in range(3):
        depth = wp.min(at[axis], 1.0 - at[axis])
        if depth < nearest:
            nearest = depth
            e = wp.vec3(0.0, 0.0, 0.0)
            e[axis] = wp.where(at[axis] < 0.5, 1.0, -1.0)
    share = wp.clamp(nearest / FADE, 0.0, 1.0)
    gradient = wp.vec3(0.0, 0.0, 0.0)
    if nearest > 0.0 and nearest < FADE:
        scale = similar_scale(tri)
        gradient = (1.0 / (FADE * scale * scale)) * (e[0] * tri.p0 + e[1] * tri.p1 + e[2] * tri.p2)
    return wp.vec4(gradient[0], gradient[1], gradient[2], share)

"""A point of a shape without triangles where visibility changes."""

import warp as wp


@wp.struct
class SilhouettePoint:
    """A point of a shape without triangles."""

    valid: wp.int32
    face: wp.int32  # number of the record
    q: wp.vec3  # in the shape's coordinates
    x: wp.vec3
    out: wp.vec3  # unit normal to the outside

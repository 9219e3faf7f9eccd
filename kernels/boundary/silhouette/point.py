"""A point of a shape without triangles where visibility changes, and the outlines that have such points."""

import warp as wp


@wp.struct
class OutlineItem:
    """An outline: a smooth silhouette, or a rim."""

    number: wp.int32  # of the shape's record; of a rim -1 less that
    neighbours: wp.vec2i  # records, -1: none; of a disk's rim the cylinder that it closes, whose wall begins there;
    # of a cylinder's silhouette the disks that close it
    closed: wp.int32  # of a cylinder's rims: the end, 0 or 1, that is no open edge; -1: none


@wp.struct
class SilhouettePoint:
    """A point of a shape without triangles."""

    valid: wp.int32
    face: wp.int32  # number of the record
    q: wp.vec3  # in the shape's coordinates
    x: wp.vec3
    out: wp.vec3  # unit normal to the outside
    item: OutlineItem  # of touches (``exact_touch.py``): the outline
    along: wp.vec3  # of touches: dx/du of the outline that was asked for

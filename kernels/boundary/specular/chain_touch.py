"""What a kind of shapes without triangles tells of the outlines that a line crosses (``chain_outlines.py``)."""

from collections.abc import Callable
from typing import NamedTuple

import warp as wp

#: How far from being touched, over the size of the shape, what a ray meets may be. Neighbouring rays are some 1e-6
#: apart, and a thousand times that where what lies between is curved or the shape is small.
GRAZED = 0.05
#: Distance, in voxels or radii, up to which two neighbouring hits are on one sheet.
SHEET = 0.05
#: What two hits on one face are: the one stands in front of the other; they are neighbours on one sheet; and its normal
#: jumps between them.
APART, SAME, JUMPS = wp.constant(0), wp.constant(1), wp.constant(2)


@wp.struct
class TubeGraze:
    """Where a ray touches a tube: what ``tube_outlines.tube_point`` makes a point of."""

    valid: wp.int32
    segment: wp.int32
    part: wp.int32
    v: wp.float32  # place along the segment; of a crease the angle around it, in turns
    e: wp.vec3


@wp.struct
class ChainOutline:
    """A point at which a ray touches a shape without triangles."""

    valid: wp.int32
    rim: wp.int32  # 1: the surface ends there
    face: wp.int32  # number of the record
    q: wp.vec3  # in the shape's coordinates
    x: wp.vec3
    m: wp.vec3  # across the ray and the outline, of any length and either sign
    curvature: wp.float32  # of the surface along the ray; 0: of a rim
    gradient: wp.vec3  # of grids, see ``GridTouch``
    tube: TubeGraze  # of curves


class ChainTouch(NamedTuple):
    """The functions of a kind; ``low`` and ``high`` are two neighbouring hits.

    Attributes:
        touch: ``(scene, tri, face, low, high, own_low, hit, o, d, front) -> ChainOutline`` of a ray o + t d that meets
            the shape at ``hit``, which is that of ``low`` (``own_low``) or ``high``, and is next to touching it; or
            with ``front`` both are on one sheet, and its normal jumps between them.
        one_sheet: ``(scene, tri, low, high) -> int``: ``APART``, ``SAME`` or ``JUMPS``.
        make_sink: role -> ``(scene, target, outline, g) -> float``: the adjoint g of a point of an outline.
    """

    touch: wp.Function
    one_sheet: wp.Function
    make_sink: Callable[[str], wp.Function]

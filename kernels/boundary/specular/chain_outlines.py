"""Outlines of shapes without triangles that a line crosses: where a ray that just misses a shape touches it.

Two neighbouring rays lie on either side: one meets the shape, the other passes it, and a ray between touches it. It
touches at a rim next to the hit, or where the surface is seen edge-on, next to the ray's point that is nearest to the
shape.

Derivation: ``docs/theory/specular.md#outlines-of-shapes-without-triangles``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.crossing.curve import OFF
from warp_psdr.kernels.boundary.specular.chain_touch import SAME, ChainOutline, ChainTouch
from warp_psdr.kernels.boundary.specular.exact_outlines import make_exact_outlines
from warp_psdr.kernels.boundary.specular.grid_outlines import grid_outlines
from warp_psdr.kernels.boundary.specular.specular_chain import Link
from warp_psdr.kernels.boundary.specular.tube_outlines import make_tube_outlines
from warp_psdr.kernels.primitive.affine import is_primitive_at, step_off_primitive
from warp_psdr.kernels.primitive.curve_kinds import CURVES
from warp_psdr.kernels.primitive.table import affine_of, join
from warp_psdr.kernels.structs import Scene


def touches_of(primitives: tuple[int, ...]) -> dict[int, ChainTouch]:
    """Return the functions of the kinds of a scene: number -> its own."""
    known = dict.fromkeys(CURVES, make_tube_outlines(primitives)) | grid_outlines()
    known |= {number: make_exact_outlines(number, affine) for number, affine in affine_of(primitives).items()}
    return {number: touch for number, touch in known.items() if number in primitives}


@functools.cache
def make_chain_outline(primitives: tuple[int, ...]) -> wp.Function | None:
    """Return ``outline_at(scene, face, low, high, own_low, o, front) -> ChainOutline`` for a ray from o.

    It meets a shape, ``face`` the number of its record, at the hit ``low`` or (not ``own_low``) ``high``, and is next
    to touching it; or with ``front`` both are on one sheet, and its normal jumps between them. None: there is no such
    shape.
    """
    touch = join("chain_touch_of_kind", {number: made.touch for number, made in touches_of(primitives).items()})
    if touch is None:
        return None

    @wp.func
    def outline_at(
        scene: Scene, face: wp.int32, low: Link, high: Link, own_low: wp.bool, o: wp.vec3, front: wp.bool
    ) -> ChainOutline:
        hit = wp.where(own_low, low.x, high.x)
        d = wp.normalize(hit - o)
        return touch(scene, scene.triangles[face], face, low, high, own_low, hit, o, d, front)

    return outline_at


@functools.cache
def make_one_sheet(primitives: tuple[int, ...]) -> wp.Function | None:
    """Return ``one_sheet(scene, low, high) -> int`` of two hits on one face; None: there are no such shapes.

    What it is: ``APART``, ``SAME`` or ``JUMPS`` (``chain_touch.py``).
    """
    sheet = join("sheet_of_kind", {number: made.one_sheet for number, made in touches_of(primitives).items()})
    if sheet is None:
        return None

    @wp.func
    def one_sheet(scene: Scene, low: Link, high: Link) -> wp.int32:
        if not is_primitive_at(scene, low.face):
            return SAME
        return sheet(scene, scene.triangles[low.face], low, high)

    return one_sheet


@wp.func
def begins_beside(scene: Scene, outline: ChainOutline, face: wp.int32, t1: wp.float32) -> wp.bool:
    """Whether a ray that begins on a face touches a shape closer than where the terms of their common curve look.

    ``docs/theory/implicit.md#curves-of-intersection``; t1 is the way to the touched point.
    """
    tri = scene.triangles[outline.face]
    if outline.rim == 1 or scene.triangles[face].shape == tri.shape:
        return False
    return 0.5 * outline.curvature * t1 * t1 < OFF * step_off_primitive(scene, tri)


@wp.func
def no_outline(scene: Scene, target: wp.array(dtype=wp.float32), outline: ChainOutline, g: wp.vec3) -> wp.float32:
    """What a scene has that holds no shapes with outlines."""
    return 0.0


@functools.cache
def make_outline_sink(role: str, primitives: tuple[int, ...]):
    """Return ``accumulate(scene, target, outline, g) -> float``: the adjoint g of a point of an outline."""
    made = {number: touch.make_sink(role) for number, touch in touches_of(primitives).items()}
    of_kind = join("outline_sink_of_kind", made, anchored=True)
    return of_kind or no_outline

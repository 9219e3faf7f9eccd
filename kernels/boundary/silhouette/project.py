"""Projection of a point of an exact shape to the visible part of its outline, in closed form.

From an eye e outside of the unit sphere, the nearest point of the circle q . e = 1 keeps the direction across e. On a
cylinder it is the nearer of the two lines, at the same height. On rims the point keeps its angle; of a cylinder's two
rims the nearer one counts. All of it is in the shape's coordinates, so that on ellipsoids the point is near, but not
the nearest one.

Derivation: ``docs/theory/guiding.md#projection-to-exact-shapes``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.primitive.affine import from_axes
from warp_psdr.kernels.primitive.kind import Outline
from warp_psdr.kernels.primitive.table import affine_of, join
from warp_psdr.kernels.structs import Triangle


class Projections(NamedTuple):
    """Functions in the world; ``tri`` is the record of a shape.

    Attributes:
        outline: ``(tri, eye, q) -> u`` of the smooth outline as seen from an eye; negative: there is none.
        square: ``(tri, q) -> vec2``: the numbers of ``Silhouettes.place``; None where no kind has a smooth outline.
        rim: ``(tri, q) -> u``; None where no kind has a rim.
    """

    outline: wp.Function | None
    square: wp.Function | None
    rim: wp.Function | None


@functools.cache
def make_projections(primitives: tuple[int, ...]) -> Projections:
    """Return the functions for the kinds of a scene."""
    kinds = affine_of(primitives)
    smooth = {n: _make_near(affine.outline) for n, affine in kinds.items() if affine.outline is not None}
    rims = {n: _make_rim_near(affine.rim.nearest) for n, affine in kinds.items() if affine.rim is not None}
    return Projections(
        outline=join("outline_near_of_kind", {n: f[0] for n, f in smooth.items()}),
        square=join("square_of_kind", {n: f[1] for n, f in smooth.items()}),
        rim=join("rim_near_of_kind", rims),
    )


def _make_near(kind: Outline) -> tuple[wp.Function, wp.Function]:
    @wp.func
    def outline_near(tri: Triangle, eye: wp.vec3, q: wp.vec3) -> wp.float32:
        here = from_axes(tri, eye - tri.normal)
        if kind.seen(here):
            return kind.nearest(here, q)
        return -1.0

    @wp.func
    def square_of(tri: Triangle, q: wp.vec3) -> wp.vec2:
        return kind.square(q)

    return outline_near, square_of


def _make_rim_near(f: wp.Function) -> wp.Function:
    @wp.func
    def rim_near(tri: Triangle, q: wp.vec3) -> wp.float32:
        return f(q)

    return rim_near

"""Points of exact shapes that emit light: the functions of a kind for ``emitter/area.py``.

Points are in material form, y = A q(u, v) + b with the numbers (u, v) that a vertex holds. They are drawn from the part
that faces the lit point x (``Facing``). Where no such point is known, they are uniform in the area of the kind:
with that area S and c = cof(A) n(q), the density per area in the world is 1 / (S |c|).

Derivation: ``docs/theory/implicit.md#emission``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.primitive.affine import determinant, from_axes
from warp_psdr.kernels.primitive.kind import Kind
from warp_psdr.kernels.primitive.table import join, kinds_of
from warp_psdr.kernels.structs import Triangle


@wp.func
def shines_outwards(tri: Triangle) -> wp.bool:
    """Whether a closed shape shines away from its inside."""
    return wp.float32(tri.i2) * determinant(tri) > 0.0


class ShiningFunctions(NamedTuple):
    """Functions of the exact shapes of a scene that shine; ``tri`` is a record.

    Attributes:
        draw: ``(tri, x, u: vec2) -> vec2``, the numbers of a point as seen from x.
        square: ``(tri, x, u, v) -> vec2``, its inverse.
        pdf: ``(tri, u, v, d, t) -> float``, its density in solid angle at x, the point less t d; d is a unit vector.
        draw_uniform: ``(tri, u: vec2) -> vec2``, the numbers of a point, uniform in the area of the kind.
        square_uniform: ``(tri, u, v) -> vec2``, its inverse.
        pdf_uniform: as ``pdf``, of that.
        position: ``(tri, u, v) -> vec3``.
        cross: ``(tri, u, v) -> vec3``: c, on the side that shines.
        uv: ``(tri, u, v) -> vec2``: texture coordinates.
    """

    draw: wp.Function
    square: wp.Function
    pdf: wp.Function
    draw_uniform: wp.Function
    square_uniform: wp.Function
    pdf_uniform: wp.Function
    position: wp.Function
    cross: wp.Function
    uv: wp.Function


@functools.cache
def make_shining(shining: tuple[int, ...]) -> ShiningFunctions | None:
    """Return the functions for the kinds that shine; None: there are none."""
    if not shining:
        return None
    of_kind = {kind.number: _make_of_kind(kind) for kind in kinds_of(shining)}

    def joined(name: str) -> wp.Function:
        return join(f"shining_{name}", {number: getattr(functions, name) for number, functions in of_kind.items()})

    return ShiningFunctions(*(joined(name) for name in ShiningFunctions._fields))


@functools.cache
def _make_of_kind(kind: Kind) -> ShiningFunctions:
    """Return the functions of one kind."""
    affine = kind.affine
    uniform, inverse, area, seen = affine.light
    position, cross = kind.position, kind.cross

    @wp.func
    def draw_uniform(tri: Triangle, u: wp.vec2) -> wp.vec2:
        return uniform(u)

    @wp.func
    def square_uniform(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec2:
        return inverse(u, v)

    @wp.func
    def pdf_uniform(tri: Triangle, u: wp.float32, v: wp.float32, d: wp.vec3, t: wp.float32) -> wp.float32:
        # |c| cancels: 1 / (S |c|) t^2 / |cos|.
        return t * t / (wp.static(float(area)) * wp.max(wp.abs(wp.dot(cross(tri, u, v), d)), 1.0e-30))

    @wp.func
    def uv(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec2:
        return affine.uv(affine.point(u, v))

    if seen is None:

        @wp.func
        def draw(tri: Triangle, x: wp.vec3, u: wp.vec2) -> wp.vec2:
            return uniform(u)

        @wp.func
        def square(tri: Triangle, x: wp.vec3, u: wp.float32, v: wp.float32) -> wp.vec2:
            return inverse(u, v)

        return ShiningFunctions(
            draw, square, pdf_uniform, draw_uniform, square_uniform, pdf_uniform, position, cross, uv
        )

    @wp.func
    def draw_seen(tri: Triangle, x: wp.vec3, u: wp.vec2) -> wp.vec2:
        e = from_axes(tri, x - tri.normal)
        if shines_outwards(tri) and seen.excess(e) > 0.0:
            return seen.draw(e, u)
        return uniform(u)

    @wp.func
    def square_seen(tri: Triangle, x: wp.vec3, u: wp.float32, v: wp.float32) -> wp.vec2:
        e = from_axes(tri, x - tri.normal)
        if shines_outwards(tri) and seen.excess(e) > 0.0:
            return seen.square(e, u, v)
        return inverse(u, v)

    @wp.func
    def pdf_seen(tri: Triangle, u: wp.float32, v: wp.float32, d: wp.vec3, t: wp.float32) -> wp.float32:
        if shines_outwards(tri):
            pdf = seen.pdf(tri, u, v, d, t)
            if pdf >= 0.0:
                return pdf
        return pdf_uniform(tri, u, v, d, t)

    return ShiningFunctions(
        draw_seen, square_seen, pdf_seen, draw_uniform, square_uniform, pdf_uniform, position, cross, uv
    )

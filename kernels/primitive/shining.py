"""Points of exact shapes that emit light: the functions of a kind for ``emitter/area.py``.

Points are in material form, y = A q(u, v) + b with the numbers (u, v) that a vertex holds. They are drawn from the part
that faces the lit point x (``visible.py``). Where no such point is known, they are uniform in the area of the kind:
with that area S and c = cof(A) n(q), the density per area in the world is 1 / (S |c|).

Derivation: ``docs/theory/implicit.md#emission``.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.constants import (
    FOUR_PI,
    INV_TWO_PI,
    PI,
    PRIMITIVE_CYLINDER,
    PRIMITIVE_DISK,
    PRIMITIVE_SPHERE,
    TWO_PI,
)
from warp_psdr.kernels.primitive.affine import from_axes
from warp_psdr.kernels.primitive.kinds import KINDS, join, make_kinds_point
from warp_psdr.kernels.primitive.sphere import sphere_coordinates, sphere_point
from warp_psdr.kernels.primitive.visible import VISIBLE, shines_outwards
from warp_psdr.kernels.sampling import disk_to_square, sphere_to_square, square_to_disk, square_to_sphere
from warp_psdr.kernels.structs import Triangle


@wp.func
def sphere_draw(u: wp.vec2) -> wp.vec2:
    """Coordinates of a point, uniform in area, as of the other kinds."""
    return sphere_coordinates(square_to_sphere(u))


@wp.func
def sphere_drawn(u: wp.float32, v: wp.float32) -> wp.vec2:
    """The inverse of ``sphere_draw``, as of the other kinds."""
    return sphere_to_square(sphere_point(u, v))


@wp.func
def disk_draw(u: wp.vec2) -> wp.vec2:
    return square_to_disk(u)


@wp.func
def disk_drawn(u: wp.float32, v: wp.float32) -> wp.vec2:
    return disk_to_square(wp.vec2(u, v))


@wp.func
def cylinder_draw(u: wp.vec2) -> wp.vec2:
    return wp.vec2(TWO_PI * u[0] - PI, u[1])


@wp.func
def cylinder_drawn(u: wp.float32, v: wp.float32) -> wp.vec2:
    return wp.vec2((u + PI) * INV_TWO_PI, v)


#: Kind (PRIMITIVE_*) -> ``(u: vec2) -> vec2``, the numbers that a vertex holds, its inverse ``(u, v) -> vec2``, and the
#: area.
DRAWS: dict[int, tuple[wp.Function, wp.Function, float]] = {
    PRIMITIVE_SPHERE: (sphere_draw, sphere_drawn, FOUR_PI),
    PRIMITIVE_DISK: (disk_draw, disk_drawn, PI),
    PRIMITIVE_CYLINDER: (cylinder_draw, cylinder_drawn, TWO_PI),
}


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
    position, cross = make_kinds_point(shining)
    of_kind = {kind: _make_of_kind(kind) for kind in shining}

    def joined(either: Callable, name: str) -> wp.Function:
        return join(either, {kind: getattr(functions, name) for kind, functions in of_kind.items()})

    return ShiningFunctions(
        draw=joined(_either_draw, "draw"),
        square=joined(_either_square, "square"),
        pdf=joined(_either_pdf, "pdf"),
        draw_uniform=joined(_either_uniform, "draw_uniform"),
        square_uniform=joined(_either_uv, "square_uniform"),
        pdf_uniform=joined(_either_pdf, "pdf_uniform"),
        position=position,
        cross=cross,
        uv=joined(_either_uv, "uv"),
    )


@functools.cache
def _make_of_kind(number: int) -> ShiningFunctions:
    """Return the functions of one kind."""
    kind = KINDS[number]
    uniform, inverse, area = DRAWS[number]
    position, cross = make_kinds_point((number,))

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
        return kind.uv(kind.point(u, v))

    if number not in VISIBLE:

        @wp.func
        def draw(tri: Triangle, x: wp.vec3, u: wp.vec2) -> wp.vec2:
            return uniform(u)

        @wp.func
        def square(tri: Triangle, x: wp.vec3, u: wp.float32, v: wp.float32) -> wp.vec2:
            return inverse(u, v)

        return ShiningFunctions(
            draw, square, pdf_uniform, draw_uniform, square_uniform, pdf_uniform, position, cross, uv
        )
    seen = VISIBLE[number]

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


def _either_draw(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def draw_of_kind(tri: Triangle, x: wp.vec3, u: wp.vec2) -> wp.vec2:
        if tri.i1 == word:
            return f(tri, x, u)
        return rest(tri, x, u)

    return draw_of_kind


def _either_square(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def square_of_kind(tri: Triangle, x: wp.vec3, u: wp.float32, v: wp.float32) -> wp.vec2:
        if tri.i1 == word:
            return f(tri, x, u, v)
        return rest(tri, x, u, v)

    return square_of_kind


def _either_pdf(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def pdf_of_kind(tri: Triangle, u: wp.float32, v: wp.float32, d: wp.vec3, t: wp.float32) -> wp.float32:
        if tri.i1 == word:
            return f(tri, u, v, d, t)
        return rest(tri, u, v, d, t)

    return pdf_of_kind


def _either_uniform(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def uniform_of_kind(tri: Triangle, u: wp.vec2) -> wp.vec2:
        if tri.i1 == word:
            return f(tri, u)
        return rest(tri, u)

    return uniform_of_kind


def _either_uv(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def uv_of_kind(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec2:
        if tri.i1 == word:
            return f(tri, u, v)
        return rest(tri, u, v)

    return uv_of_kind

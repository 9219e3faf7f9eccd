"""Points of exact shapes that shine, uniform in the area of the kind: what ``emitter/area.py`` asks of a kind.

They are in material form, (u, v) the numbers that a vertex holds: x = A q(u, v) + b. With the area S of the kind and
c = cof(A) n(q), the density per area in the world is 1 / (S |c|).

Derivation: ``docs/theory/implicit.md#emission``.
"""

import functools
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
from warp_psdr.kernels.primitive.kinds import KINDS, join, make_kinds_point
from warp_psdr.kernels.primitive.sphere import sphere_coordinates, sphere_point
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
        draw: ``(tri, u: vec2) -> vec2``, the numbers of a point.
        square: ``(tri, u, v) -> vec2``, its inverse.
        position: ``(tri, u, v) -> vec3``.
        cross: ``(tri, u, v) -> vec3``: c, on the side that shines.
        area: ``(tri) -> float``, S.
        uv: ``(tri, u, v) -> vec2``: texture coordinates.
    """

    draw: wp.Function
    square: wp.Function
    position: wp.Function
    cross: wp.Function
    area: wp.Function
    uv: wp.Function


@functools.cache
def make_shining(shining: tuple[int, ...]) -> ShiningFunctions | None:
    """Return the functions for the kinds that shine; None: there are none."""
    if not shining:
        return None
    position, cross = make_kinds_point(shining)
    return ShiningFunctions(
        draw=join(_either_draw, {kind: _make_draw(DRAWS[kind][0]) for kind in shining}),
        square=join(_either_uv, {kind: _make_square(DRAWS[kind][1]) for kind in shining}),
        position=position,
        cross=cross,
        area=join(_either_area, {kind: _make_area(DRAWS[kind][2]) for kind in shining}),
        uv=join(_either_uv, {kind: _make_uv(kind) for kind in shining}),
    )


def _make_draw(f: wp.Function) -> wp.Function:
    @wp.func
    def draw_of(tri: Triangle, u: wp.vec2) -> wp.vec2:
        return f(u)

    return draw_of


def _make_square(f: wp.Function) -> wp.Function:
    @wp.func
    def square_of(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec2:
        return f(u, v)

    return square_of


def _make_area(area: float) -> wp.Function:
    @wp.func
    def area_of(tri: Triangle) -> wp.float32:
        return wp.static(float(area))

    return area_of


def _make_uv(number: int) -> wp.Function:
    kind = KINDS[number]

    @wp.func
    def uv_of(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec2:
        return kind.uv(kind.point(u, v))

    return uv_of


def _either_draw(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def draw_of_kind(tri: Triangle, u: wp.vec2) -> wp.vec2:
        if tri.i1 == word:
            return f(tri, u)
        return rest(tri, u)

    return draw_of_kind


def _either_area(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def area_of_kind(tri: Triangle) -> wp.float32:
        if tri.i1 == word:
            return f(tri)
        return rest(tri)

    return area_of_kind


def _either_uv(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def uv_of_kind(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec2:
        if tri.i1 == word:
            return f(tri, u, v)
        return rest(tri, u, v)

    return uv_of_kind

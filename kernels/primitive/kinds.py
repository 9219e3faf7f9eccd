"""The kinds of affine shapes, and their functions joined for the kinds that a scene holds.

A scene that holds one kind gets the functions of that kind as they are. A new kind is a file and a row.
"""

import functools
from collections.abc import Callable

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import PRIMITIVE_CYLINDER, PRIMITIVE_DISK, PRIMITIVE_SPHERE
from warp_psdr.kernels.primitive.affine import (
    Kind,
    make_affine_hit,
    make_affine_normal,
    make_affine_point,
    make_affine_sink,
    make_affine_surface,
)
from warp_psdr.kernels.primitive.cylinder import (
    cylinder_hit,
    cylinder_normal,
    cylinder_point,
    cylinder_pull,
    cylinder_rates,
    cylinder_tangents,
    cylinder_uv,
)
from warp_psdr.kernels.primitive.disk import (
    disk_hit,
    disk_normal,
    disk_point,
    disk_pull,
    disk_rates,
    disk_tangents,
    disk_uv,
)
from warp_psdr.kernels.primitive.sphere import (
    sphere_hit,
    sphere_normal,
    sphere_point,
    sphere_pull,
    sphere_rates,
    sphere_tangents,
    sphere_uv,
)
from warp_psdr.kernels.structs import Triangle
from warp_psdr.kernels.surface import RayAdjoint, Surface, VertexAdjoint

#: Kind (PRIMITIVE_*) -> its functions.
KINDS: dict[int, Kind] = {
    PRIMITIVE_SPHERE: Kind(
        point=sphere_point,
        hit=sphere_hit,
        normal=sphere_normal,
        tangents=sphere_tangents,
        uv=sphere_uv,
        rates=sphere_rates,
        pull=sphere_pull,
    ),
    PRIMITIVE_DISK: Kind(
        point=disk_point,
        hit=disk_hit,
        normal=disk_normal,
        tangents=disk_tangents,
        uv=disk_uv,
        rates=disk_rates,
        pull=disk_pull,
    ),
    PRIMITIVE_CYLINDER: Kind(
        point=cylinder_point,
        hit=cylinder_hit,
        normal=cylinder_normal,
        tangents=cylinder_tangents,
        uv=cylinder_uv,
        rates=cylinder_rates,
        pull=cylinder_pull,
    ),
}


def affine_kinds(primitives: tuple[int, ...]) -> tuple[int, ...]:
    """Return the kinds of a scene's affine shapes."""
    return tuple(kind for kind in primitives if kind in KINDS)


def join(either: Callable, functions: dict[int, wp.Function]) -> wp.Function | None:
    """Nest ``either(word, f, rest)`` over the functions of kinds, which ``Triangle.i1`` tells apart."""
    joined = None
    for kind, function in reversed(functions.items()):
        joined = function if joined is None else either(-1 - kind, function, joined)
    return joined


@functools.cache
def make_kinds_hit(kinds: tuple[int, ...]):
    """Return ``make_affine_hit``'s function for several kinds; None: for no kind, as below."""
    return join(_either_hit, {kind: make_affine_hit(KINDS[kind]) for kind in kinds})


@functools.cache
def make_kinds_point(kinds: tuple[int, ...]):
    """Return ``make_affine_point``'s functions for several kinds."""
    made = {kind: make_affine_point(KINDS[kind]) for kind in kinds}
    return tuple(join(_either_vector_at, {kind: both[i] for kind, both in made.items()}) for i in range(2))


@functools.cache
def make_kinds_normal(kinds: tuple[int, ...]):
    """Return ``make_affine_normal``'s function for several kinds."""
    return join(_either_normal, {kind: make_affine_normal(KINDS[kind]) for kind in kinds})


@functools.cache
def make_kinds_surface(kinds: tuple[int, ...], uv: bool, tangent: bool):
    """Return ``make_affine_surface``'s functions for several kinds."""
    made = {kind: make_affine_surface(KINDS[kind], uv, tangent) for kind in kinds}
    return (
        join(_either_surface, {kind: both[0] for kind, both in made.items()}),
        join(_either_partials, {kind: both[1] for kind, both in made.items()}),
    )


@functools.cache
def make_kinds_sink(kinds: tuple[int, ...], role: str, uv: bool, tangent: bool, rays: bool):
    """Return ``make_affine_sink``'s function for several kinds."""
    return join(_either_sink, {kind: make_affine_sink(KINDS[kind], role, uv, tangent, rays) for kind in kinds})


def _either_hit(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def hit_of_kind(tri: Triangle, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
        if tri.i1 == word:
            return f(tri, o, d, t_max)
        return rest(tri, o, d, t_max)

    return hit_of_kind


def _either_vector_at(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def vector_of_kind(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
        if tri.i1 == word:
            return f(tri, u, v)
        return rest(tri, u, v)

    return vector_of_kind


def _either_normal(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def normal_of_kind(tri: Triangle, x: wp.vec3) -> wp.vec3:
        if tri.i1 == word:
            return f(tri, x)
        return rest(tri, x)

    return normal_of_kind


def _either_surface(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def surface_of_kind(tri: Triangle, u: wp.float32, v: wp.float32) -> Surface:
        if tri.i1 == word:
            return f(tri, u, v)
        return rest(tri, u, v)

    return surface_of_kind


def _either_partials(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def partials_of_kind(tri: Triangle, u: wp.float32, v: wp.float32) -> tuple[wp.vec3, wp.vec3]:
        if tri.i1 == word:
            p_du, p_dv = f(tri, u, v)
            return p_du, p_dv
        other_du, other_dv = rest(tri, u, v)
        return other_du, other_dv

    return partials_of_kind


def _either_sink(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def sink_of_kind(
        target: wp.array(dtype=wp.float32),
        tri: Triangle,
        u: wp.float32,
        v: wp.float32,
        adjoint: VertexAdjoint,
        by_ray: wp.bool,
        o: wp.vec3,
        d: wp.vec3,
    ) -> RayAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        if tri.i1 == word:
            return f(target, tri, u, v, adjoint, by_ray, o, d)
        return rest(target, tri, u, v, adjoint, by_ray, o, d)

    return sink_of_kind

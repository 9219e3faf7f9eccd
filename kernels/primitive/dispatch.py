"""Shapes without triangles beside those with: what a scene's kinds add to ray queries, surfaces and adjoints.

A number of a face that is at least the number of triangles names such a shape. Each function takes the one for
triangles, and is that one where a scene holds no such shape, so nothing is compiled. A new kind is a file and a row.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import PRIMITIVE_SPHERE
from warp_psdr.kernels.primitive.affine import (
    Kind,
    is_primitive,
    is_primitive_at,
    last_primitive,
    make_affine_hit,
    make_affine_normal,
    make_affine_point,
    make_affine_sink,
    make_affine_surface,
    step_off_primitive,
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
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.step import step_off_triangle
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import (
    RayAdjoint,
    Surface,
    VertexAdjoint,
    make_surface_of,
    make_vertex_sink,
    point_on,
    uv_partials,
)

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
    )
}


def only_kind(primitives: tuple[int, ...]) -> Kind:
    """Return the kind of a scene that holds one kind."""
    if len(primitives) != 1:
        raise ValueError(f"kinds of shapes without triangles: got {primitives}, expected one")
    return KINDS[primitives[0]]


@functools.cache
def make_primitive_queries(primitives: tuple[int, ...]):
    """Return ``closest(scene, o, d, hit) -> RayHit``, the nearer of a hit and the shapes', and ``occludes``.

    ``occludes(scene, o, d, t_max) -> bool``: whether one of the shapes lies on a segment.
    """
    hit_of = make_affine_hit(only_kind(primitives))

    @wp.func
    def closest_primitive(scene: Scene, o: wp.vec3, d: wp.vec3, hit: RayHit) -> RayHit:
        best = hit
        k = last_primitive(scene)
        while is_primitive_at(scene, k):
            found = hit_of(triangle_at(scene, k), o, d, best.t)
            if found.face >= 0:
                best = found
                best.face = k
            k -= 1
        return best

    @wp.func
    def occluded_by_primitive(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> wp.bool:
        k = last_primitive(scene)
        while is_primitive_at(scene, k):
            if hit_of(triangle_at(scene, k), o, d, t_max).face >= 0:
                return True
            k -= 1
        return False

    return closest_primitive, occluded_by_primitive


@functools.cache
def make_surface_at(smooth: bool, flat: bool, uv: bool, tangent: bool, primitives: tuple[int, ...]):
    """Return ``surface_of(scene, tri, u, v) -> Surface``; other arguments as ``make_surface_of``'s."""
    surface_of = make_surface_of(smooth, flat, uv, tangent)
    if not primitives:
        return surface_of
    of_primitive, _partials = make_affine_surface(only_kind(primitives), uv or tangent, tangent)

    @wp.func
    def surface_of_any(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> Surface:
        if is_primitive(tri):
            return of_primitive(tri, u, v)
        return surface_of(scene, tri, u, v)

    return surface_of_any


@functools.cache
def make_partials(primitives: tuple[int, ...]):
    """Return ``partials(scene, tri, u, v) -> (dp/du, dp/dv)``."""
    of_primitive = make_affine_surface(only_kind(primitives), True, True)[1] if primitives else None

    @wp.func
    def partials_of_any(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> tuple[wp.vec3, wp.vec3]:
        if wp.static(of_primitive is not None):
            if is_primitive(tri):
                p_du, p_dv = of_primitive(tri, u, v)
                return p_du, p_dv
        dp_du, dp_dv = uv_partials(scene, tri)
        return dp_du, dp_dv

    return partials_of_any


@functools.cache
def make_leaving(primitives: tuple[int, ...]):
    """Return ``step_off(scene, tri) -> float``: how far off a surface rays that leave it start, world units."""
    if not primitives:
        return step_off_triangle

    @wp.func
    def step_off_any(scene: Scene, tri: Triangle) -> wp.float32:
        if is_primitive(tri):
            return step_off_primitive(scene, tri)
        return step_off_triangle(scene, tri)

    return step_off_any


@functools.cache
def make_position(primitives: tuple[int, ...]):
    """Return ``(position, cross)``: ``(tri, u, v) -> vec3``.

    A point of a surface, and its normal, which is as long as the area element: of a triangle (p1 - p0) x (p2 - p0).
    """

    @wp.func
    def cross_of_edges(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
        return wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0)

    if not primitives:
        return point_on, cross_of_edges
    point_of, cross_of = make_affine_point(only_kind(primitives))

    @wp.func
    def position_of_any(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
        if is_primitive(tri):
            return point_of(tri, u, v)
        return point_on(tri, u, v)

    @wp.func
    def cross_of_any(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
        if is_primitive(tri):
            return cross_of(tri, u, v)
        return cross_of_edges(tri, u, v)

    return position_of_any, cross_of_any


@functools.cache
def make_normal_at(primitives: tuple[int, ...]) -> wp.Function | None:
    """Return ``normal(tri, x) -> vec3`` of shapes without triangles (``make_affine_normal``); None: there are none."""
    return make_affine_normal(only_kind(primitives)) if primitives else None


@functools.cache
def make_adjoint_sink(
    role: str,
    smooth: bool,
    flat: bool,
    uv: bool,
    tangent: bool,
    texcoords: bool,
    rays: bool,
    primitives: tuple[int, ...],
):
    """Return ``make_vertex_sink``'s function, for vertices on any shape; other arguments as there."""
    of_triangle = make_vertex_sink(role, smooth, flat, uv, tangent, texcoords, rays)
    if not primitives:
        return of_triangle
    of_primitive = make_affine_sink(only_kind(primitives), role, uv or tangent, tangent, rays)

    @wp.func
    def accumulate_any(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        adjoint: VertexAdjoint,
        by_ray: wp.bool,
        o: wp.vec3,
        d: wp.vec3,
    ) -> RayAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        if is_primitive_at(scene, face):
            return of_primitive(target, triangle_at(scene, face), u, v, adjoint, by_ray, o, d)
        return of_triangle(scene, target, face, u, v, adjoint, by_ray, o, d)

    return accumulate_any

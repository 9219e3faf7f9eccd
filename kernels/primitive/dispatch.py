"""Shapes without triangles beside triangles: ray queries, surfaces and adjoints for the kinds that a scene holds.

A face number that is at least the number of triangles names such a shape. Each function takes its counterpart for
triangles, and is that counterpart where a scene holds no such shape, so nothing is compiled. Affine shapes are in
``kinds.py``. Grids (``sdfgrid.py``, ``sdfgrid_cubic.py``), networks (``network.py``) and curves (``curves.py``) are the
other kinds; vertices on them slide along the rays that found them (``docs/theory/implicit.md#form-s``).
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import (
    NORMAL_FLOW,
    PRIMITIVE_BSPLINECURVE,
    PRIMITIVE_LINEARCURVE,
    PRIMITIVE_NEURALSDF,
    PRIMITIVE_SDFGRID,
    PRIMITIVE_SDFGRID_CUBIC,
)
from warp_psdr.kernels.primitive.affine import (
    is_primitive,
    is_primitive_at,
    last_primitive,
    step_off_primitive,
    to_axes,
)
from warp_psdr.kernels.primitive.curves import make_curve_hit
from warp_psdr.kernels.primitive.curves_adjoint import make_curve_sink
from warp_psdr.kernels.primitive.curves_surface import make_curve_surface
from warp_psdr.kernels.primitive.kinds import (
    affine_kinds,
    make_kinds_hit,
    make_kinds_normal,
    make_kinds_point,
    make_kinds_sink,
    make_kinds_surface,
)
from warp_psdr.kernels.primitive.network import step_off_network
from warp_psdr.kernels.primitive.network_surface import make_network_surface, network_normal
from warp_psdr.kernels.primitive.sdfgrid import unpack
from warp_psdr.kernels.primitive.sdfgrid_adjoint import make_sdfgrid_sink
from warp_psdr.kernels.primitive.sdfgrid_cubic_surface import (
    make_sdfgrid_cubic_surface,
    sdfgrid_cubic_normal,
)
from warp_psdr.kernels.primitive.sdfgrid_surface import make_sdfgrid_surface, sdfgrid_normal
from warp_psdr.kernels.primitive.sdfgrid_walk import make_sdfgrid_hit
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

#: Kinds of grids and of curves, and all kinds whose vertices slide along rays.
GRIDS = (PRIMITIVE_SDFGRID, PRIMITIVE_SDFGRID_CUBIC)
CURVES = (PRIMITIVE_LINEARCURVE, PRIMITIVE_BSPLINECURVE)
SLIDING = (*GRIDS, PRIMITIVE_NEURALSDF, *CURVES)
#: Kinds with continuous normals among these, along which vertices may flow instead (``normal_flow.py``).
FLOWING = (PRIMITIVE_SDFGRID_CUBIC, PRIMITIVE_NEURALSDF)
#: Kinds whose vertices hold a point of a box.
BOXED = (*GRIDS, PRIMITIVE_NEURALSDF)


@wp.func
def is_cubic(tri: Triangle) -> wp.bool:
    """Whether the record of a shape without triangles is that of a smooth grid."""
    return tri.i1 == wp.static(-1 - PRIMITIVE_SDFGRID_CUBIC)


@wp.func
def is_grid(tri: Triangle) -> wp.bool:
    """Whether the record of a shape without triangles is that of a grid, smooth or not."""
    return tri.i1 == wp.static(-1 - PRIMITIVE_SDFGRID) or is_cubic(tri)


@wp.func
def is_linear(tri: Triangle) -> wp.bool:
    """Whether the record of a shape without triangles is that of curves of straight segments."""
    return tri.i1 == wp.static(-1 - PRIMITIVE_LINEARCURVE)


@wp.func
def is_bspline(tri: Triangle) -> wp.bool:
    """Whether the record of a shape without triangles is that of B-splines."""
    return tri.i1 == wp.static(-1 - PRIMITIVE_BSPLINECURVE)


@wp.func
def is_network(tri: Triangle) -> wp.bool:
    """Whether the record of a shape without triangles is that of a network."""
    return tri.i1 == wp.static(-1 - PRIMITIVE_NEURALSDF)


@wp.func
def slides_on(tri: Triangle) -> wp.bool:
    """Whether vertices on what a record is of slide along the rays that found them (form S)."""
    return is_grid(tri) or is_linear(tri) or is_bspline(tri) or is_network(tri)


def has_flow(primitives: tuple[int, ...]) -> bool:
    """Return whether vertices flow along normals."""
    return NORMAL_FLOW in primitives


def has_slides(primitives: tuple[int, ...]) -> bool:
    """Return whether vertices slide along rays; where they flow there are no kinds that cannot."""
    return bool(set(SLIDING) & set(primitives)) and not has_flow(primitives)


@wp.func
def flows_on(tri: Triangle) -> wp.bool:
    """Whether vertices on what a record is of may flow along its normals."""
    return is_cubic(tri) or is_network(tri)


@functools.cache
def make_hit(primitives: tuple[int, ...], shadow: bool = False):
    """Return ``hit(scene, tri, o, d, t_max) -> RayHit``; its ``face`` is 0, or -1 for a miss.

    Args:
        primitives: the kinds of a scene.
        shadow: whether there is a hit is all that counts.
    """
    hit_of_affine = make_kinds_hit(affine_kinds(primitives))
    hit_of_grid = make_sdfgrid_hit(False) if PRIMITIVE_SDFGRID in primitives else None
    hit_of_cubic = make_sdfgrid_hit(True) if PRIMITIVE_SDFGRID_CUBIC in primitives else None
    hit_of_network = make_sdfgrid_hit(False, True) if PRIMITIVE_NEURALSDF in primitives else None
    hit_of_linear = make_curve_hit(False, shadow) if PRIMITIVE_LINEARCURVE in primitives else None
    hit_of_bspline = make_curve_hit(True, shadow) if PRIMITIVE_BSPLINECURVE in primitives else None

    @wp.func
    def hit_of_any(scene: Scene, tri: Triangle, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
        if wp.static(hit_of_linear is not None):
            if is_linear(tri):
                return hit_of_linear(scene, tri, o, d, t_max)
        if wp.static(hit_of_bspline is not None):
            if is_bspline(tri):
                return hit_of_bspline(scene, tri, o, d, t_max)
        if wp.static(hit_of_network is not None):
            if is_network(tri):
                return hit_of_network(scene, tri, o, d, t_max)
        if wp.static(hit_of_cubic is not None):
            if is_cubic(tri):
                return hit_of_cubic(scene, tri, o, d, t_max)
        if wp.static(hit_of_grid is not None):
            if wp.static(hit_of_affine is None) or is_grid(tri):
                return hit_of_grid(scene, tri, o, d, t_max)
        if wp.static(hit_of_affine is not None):
            return hit_of_affine(tri, o, d, t_max)
        return RayHit()

    return hit_of_any


@functools.cache
def make_primitive_queries(primitives: tuple[int, ...], hidden: bool = False):
    """Return ``closest(scene, o, d, hit) -> RayHit``, the nearer of a hit and the shapes', and ``occludes``.

    ``occludes(scene, o, d, t_max) -> bool``: whether one of the shapes lies on a segment. ``hidden``: those that shine
    are left out.
    """
    hit_of = make_hit(primitives)
    shadow_of = make_hit(primitives, shadow=True) if set(CURVES) & set(primitives) else hit_of

    @wp.func
    def closest_primitive(scene: Scene, o: wp.vec3, d: wp.vec3, hit: RayHit) -> RayHit:
        best = hit
        k = last_primitive(scene)
        while is_primitive_at(scene, k):
            found = hit_of(scene, triangle_at(scene, k), o, d, best.t)
            if wp.static(hidden):
                if scene.shapes[scene.triangles[k].shape].emitter >= 0:
                    found.face = -1
            if found.face >= 0:
                best = found
                best.face = k
            k -= 1
        return best

    @wp.func
    def occluded_by_primitive(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> wp.bool:
        k = last_primitive(scene)
        while is_primitive_at(scene, k):
            shown = wp.bool(True)
            if wp.static(hidden):
                shown = scene.shapes[scene.triangles[k].shape].emitter < 0
            if shown and shadow_of(scene, triangle_at(scene, k), o, d, t_max).face >= 0:
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
    of_affine = make_kinds_surface(affine_kinds(primitives), uv or tangent, tangent)[0]
    of_grid = make_sdfgrid_surface(tangent) if PRIMITIVE_SDFGRID in primitives else None
    of_cubic = make_sdfgrid_cubic_surface(tangent) if PRIMITIVE_SDFGRID_CUBIC in primitives else None
    of_network = make_network_surface(tangent) if PRIMITIVE_NEURALSDF in primitives else None
    of_linear = make_curve_surface(False, tangent) if PRIMITIVE_LINEARCURVE in primitives else None
    of_bspline = make_curve_surface(True, tangent) if PRIMITIVE_BSPLINECURVE in primitives else None

    @wp.func
    def surface_of_any(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> Surface:
        if is_primitive(tri):
            if wp.static(of_linear is not None):
                if is_linear(tri):
                    return of_linear(scene, tri, u, v)
            if wp.static(of_bspline is not None):
                if is_bspline(tri):
                    return of_bspline(scene, tri, u, v)
            if wp.static(of_network is not None):
                if is_network(tri):
                    return of_network(scene, tri, u, v)
            if wp.static(of_cubic is not None):
                if is_cubic(tri):
                    return of_cubic(scene, tri, u, v)
            if wp.static(of_grid is not None):
                if wp.static(of_affine is None) or is_grid(tri):
                    return of_grid(scene, tri, u, v)
            if wp.static(of_affine is not None):
                return of_affine(tri, u, v)
        return surface_of(scene, tri, u, v)

    return surface_of_any


@functools.cache
def make_partials(primitives: tuple[int, ...]):
    """Return ``partials(scene, tri, u, v) -> (dp/du, dp/dv)``; 0 on grids and curves, which bear no bumps."""
    of_affine = make_kinds_surface(affine_kinds(primitives), True, True)[1]
    has_sliding = bool(set(SLIDING) & set(primitives))

    @wp.func
    def partials_of_any(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> tuple[wp.vec3, wp.vec3]:
        if wp.static(has_sliding):
            if slides_on(tri):
                return wp.vec3(0.0, 0.0, 0.0), wp.vec3(0.0, 0.0, 0.0)
        if wp.static(of_affine is not None):
            if is_primitive(tri):
                p_du, p_dv = of_affine(tri, u, v)
                return p_du, p_dv
        dp_du, dp_dv = uv_partials(scene, tri)
        return dp_du, dp_dv

    return partials_of_any


@functools.cache
def make_leaving(primitives: tuple[int, ...]):
    """Return ``step_off(scene, tri) -> float``: how far off a surface rays that leave it start, world units."""
    if not primitives:
        return step_off_triangle

    has_networks = PRIMITIVE_NEURALSDF in primitives

    @wp.func
    def step_off_any(scene: Scene, tri: Triangle) -> wp.float32:
        step = wp.where(is_primitive(tri), step_off_primitive(scene, tri), step_off_triangle(scene, tri))
        if wp.static(has_networks):
            if is_network(tri):
                step = step_off_network(scene, tri)
        return step

    return step_off_any


@functools.cache
def make_position(primitives: tuple[int, ...]):
    """Return ``(position, cross)``: ``(tri, u, v) -> vec3``.

    A point of a surface, and its normal, which is as long as the area element: of a triangle (p1 - p0) x (p2 - p0). On
    grids the point is the one that is held, and the normal, which nobody asks for, that of their record. On curves
    neither is meant (``make_point_at``).
    """

    @wp.func
    def cross_of_edges(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
        return wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0)

    has_boxes = bool(set(BOXED) & set(primitives))
    if not primitives:
        return point_on, cross_of_edges
    point_of, cross_of = make_kinds_point(affine_kinds(primitives))

    @wp.func
    def position_of_any(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
        if wp.static(has_boxes):
            if is_grid(tri) or is_network(tri):
                return tri.normal + to_axes(tri, unpack(u, v))
        if wp.static(point_of is not None):
            if is_primitive(tri):
                return point_of(tri, u, v)
        return point_on(tri, u, v)

    @wp.func
    def cross_of_any(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
        if wp.static(cross_of is not None):
            if is_primitive(tri):
                return cross_of(tri, u, v)
        return cross_of_edges(tri, u, v)

    return position_of_any, cross_of_any


@functools.cache
def make_point_at(primitives: tuple[int, ...]):
    """Return ``point(scene, tri, u, v) -> vec3``: ``make_position``'s, on curves as well."""
    position, _cross_of = make_position(primitives)
    of_linear = make_curve_surface(False, False) if PRIMITIVE_LINEARCURVE in primitives else None
    of_bspline = make_curve_surface(True, False) if PRIMITIVE_BSPLINECURVE in primitives else None

    @wp.func
    def point_of_any(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
        if wp.static(of_linear is not None):
            if is_linear(tri):
                return of_linear(scene, tri, u, v).x
        if wp.static(of_bspline is not None):
            if is_bspline(tri):
                return of_bspline(scene, tri, u, v).x
        return position(tri, u, v)

    return point_of_any


@functools.cache
def make_normal_at(primitives: tuple[int, ...]) -> wp.Function | None:
    """Return ``normal(scene, tri, x) -> vec3`` of shapes without triangles, of any length; None: there are none.

    It is 0 on curves, which are seen from outside alone.
    """
    if not primitives:
        return None
    of_affine = make_kinds_normal(affine_kinds(primitives))
    has_grids = PRIMITIVE_SDFGRID in primitives
    has_cubic = PRIMITIVE_SDFGRID_CUBIC in primitives
    has_networks = PRIMITIVE_NEURALSDF in primitives

    @wp.func
    def normal_of_any(scene: Scene, tri: Triangle, x: wp.vec3) -> wp.vec3:
        if wp.static(has_networks):
            if is_network(tri):
                return network_normal(scene, tri, x)
        if wp.static(has_cubic):
            if is_cubic(tri):
                return sdfgrid_cubic_normal(scene, tri, x)
        if wp.static(has_grids):
            if wp.static(of_affine is None) or is_grid(tri):
                return sdfgrid_normal(scene, tri, x)
        if wp.static(of_affine is not None):
            return of_affine(tri, x)
        return wp.vec3(0.0, 0.0, 0.0)

    return normal_of_any


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
    of_affine = make_kinds_sink(affine_kinds(primitives), role, uv or tangent, tangent, rays)
    of_grid = make_sdfgrid_sink(role) if PRIMITIVE_SDFGRID in primitives else None
    flow = has_flow(primitives)
    of_cubic = make_sdfgrid_sink(role, True, False, flow) if PRIMITIVE_SDFGRID_CUBIC in primitives else None
    of_network = make_sdfgrid_sink(role, False, True, flow) if PRIMITIVE_NEURALSDF in primitives else None
    of_linear = make_curve_sink(role, False, uv, tangent) if PRIMITIVE_LINEARCURVE in primitives else None
    of_bspline = make_curve_sink(role, True, uv, tangent) if PRIMITIVE_BSPLINECURVE in primitives else None

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
            tri = triangle_at(scene, face)
            if wp.static(of_linear is not None):
                if is_linear(tri):
                    return of_linear(scene, target, tri, u, v, adjoint, by_ray, o, d)
            if wp.static(of_bspline is not None):
                if is_bspline(tri):
                    return of_bspline(scene, target, tri, u, v, adjoint, by_ray, o, d)
            if wp.static(of_network is not None):
                if is_network(tri):
                    return of_network(scene, target, tri, u, v, adjoint, by_ray, o, d)
            if wp.static(of_cubic is not None):
                if is_cubic(tri):
                    return of_cubic(scene, target, tri, u, v, adjoint, by_ray, o, d)
            if wp.static(of_grid is not None):
                if wp.static(of_affine is None) or is_grid(tri):
                    return of_grid(scene, target, tri, u, v, adjoint, by_ray, o, d)
            if wp.static(of_affine is not None):
                return of_affine(target, tri, u, v, adjoint, by_ray, o, d)
        return of_triangle(scene, target, face, u, v, adjoint, by_ray, o, d)

    return accumulate_any

"""Shapes without triangles beside triangles: ray queries, surfaces and adjoints for the kinds that a scene holds.

A face number that is at least the number of triangles names such a shape. Each function takes its counterpart for
triangles, and is that counterpart where a scene holds no such shape, so nothing is compiled. The kinds declare their
functions (``kind.py``), which are joined here.
"""

import functools
from collections.abc import Iterable

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import NORMAL_FLOW
from warp_psdr.kernels.primitive.affine import is_primitive, is_primitive_at, last_primitive, step_off_primitive
from warp_psdr.kernels.primitive.kind import FLOWS, MATERIAL, Kind
from warp_psdr.kernels.primitive.table import KINDS, join, kinds_of
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
from warp_psdr.kernels.vertex_motion import VertexTangent, make_vertex_jvp


def bits_of(kinds: Iterable[Kind]) -> int:
    """Return the number whose bits are 1 at the numbers of some kinds, as ``is_of`` takes it."""
    return sum(1 << kind.number for kind in kinds)


@wp.func
def is_of(tri: Triangle, kinds: wp.int32) -> wp.bool:
    """Whether a record is of one of some kinds (``bits_of``)."""
    number = -1 - tri.i1
    return number >= 0 and ((kinds >> wp.max(number, 0)) & 1) == 1


@wp.func
def slides_on(tri: Triangle) -> wp.bool:
    """Whether vertices on what a record is of slide along the rays that found them (form S)."""
    return is_of(tri, wp.static(bits_of(kind for kind in KINDS if kind.moves != MATERIAL)))


@wp.func
def flows_on(tri: Triangle) -> wp.bool:
    """Whether vertices on what a record is of may flow along its normals instead (``normal_flow.py``)."""
    return is_of(tri, wp.static(bits_of(kind for kind in KINDS if kind.moves == FLOWS)))


@wp.func
def is_outside_alone(tri: Triangle) -> wp.bool:
    """Whether what a record is of is seen from outside alone: rays that start inside leave it unseen."""
    return is_of(tri, wp.static(bits_of(kind for kind in KINDS if kind.outside)))


def has_flow(primitives: tuple[int, ...]) -> bool:
    """Return whether vertices flow along normals."""
    return NORMAL_FLOW in primitives


def has_sliding(primitives: tuple[int, ...]) -> bool:
    """Return whether there are kinds whose vertices slide along rays, or flow."""
    return any(kind.moves != MATERIAL for kind in kinds_of(primitives))


def has_slides(primitives: tuple[int, ...]) -> bool:
    """Return whether vertices slide along rays; where they flow there are no kinds that cannot."""
    return has_sliding(primitives) and not has_flow(primitives)


def has_outside_alone(primitives: tuple[int, ...]) -> bool:
    """Return whether there are kinds that are seen from outside alone."""
    return any(kind.outside for kind in kinds_of(primitives))


@functools.cache
def make_hit(primitives: tuple[int, ...], shadow: bool = False):
    """Return ``hit(scene, tri, o, d, t_max) -> RayHit``; its ``face`` is 0, or -1 for a miss.

    Args:
        primitives: the kinds of a scene.
        shadow: whether there is a hit is all that counts.
    """
    return join("hit_of_kind", {kind.number: kind.make_hit(shadow) for kind in kinds_of(primitives)})


@functools.cache
def make_primitive_queries(primitives: tuple[int, ...], hidden: bool = False):
    """Return ``closest(scene, o, d, hit) -> RayHit``, the nearer of a hit and the shapes', and ``occludes``.

    ``occludes(scene, o, d, t_max) -> bool``: whether one of the shapes lies on a segment. ``hidden``: those that shine
    are left out.
    """
    hit_of = make_hit(primitives)
    shadow_of = make_hit(primitives, shadow=True)

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
    of_kind = join("surface_of_kind", {kind.number: kind.make_surface(uv, tangent) for kind in kinds_of(primitives)})
    if of_kind is None:
        return surface_of

    @wp.func
    def surface_of_any(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> Surface:
        if is_primitive(tri):
            return of_kind(scene, tri, u, v)
        return surface_of(scene, tri, u, v)

    return surface_of_any


@wp.func
def no_partials(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> tuple[wp.vec3, wp.vec3]:
    """What a surface has that bears no bumps."""
    return wp.vec3(0.0, 0.0, 0.0), wp.vec3(0.0, 0.0, 0.0)


@functools.cache
def make_partials(primitives: tuple[int, ...]):
    """Return ``partials(scene, tri, u, v) -> (dp/du, dp/dv)``; 0 on kinds that bear no bumps."""
    of_kind = join("partials_of_kind", {kind.number: kind.partials or no_partials for kind in kinds_of(primitives)})

    @wp.func
    def partials_of_any(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> tuple[wp.vec3, wp.vec3]:
        if wp.static(of_kind is not None):
            if is_primitive(tri):
                p_du, p_dv = of_kind(scene, tri, u, v)
                return p_du, p_dv
        dp_du, dp_dv = uv_partials(scene, tri)
        return dp_du, dp_dv

    return partials_of_any


@functools.cache
def make_leaving(primitives: tuple[int, ...]):
    """Return ``step_off(scene, tri) -> float``: how far off a surface rays that leave it start, world units."""
    if not primitives:
        return step_off_triangle
    own = [kind for kind in kinds_of(primitives) if kind.step is not None]
    own_step = join("own_step_of_kind", {kind.number: kind.step for kind in own})

    @wp.func
    def step_off_any(scene: Scene, tri: Triangle) -> wp.float32:
        step = wp.where(is_primitive(tri), step_off_primitive(scene, tri), step_off_triangle(scene, tri))
        if wp.static(own_step is not None):
            if is_of(tri, wp.static(bits_of(own))):
                step = own_step(scene, tri)
        return step

    return step_off_any


@wp.func
def no_clearance(scene: Scene, tri: Triangle) -> wp.float32:
    """What surfaces need whose far side is told by the last bit."""
    return 0.0


@functools.cache
def make_clear(primitives: tuple[int, ...]) -> wp.Function | None:
    """Return ``clear(scene, tri) -> float`` (``Kind.clear``), 0 on kinds without; None: no kind of a scene has it."""
    made = {kind.number: kind.clear for kind in kinds_of(primitives) if kind.clear is not None}
    return join("clear_of_kind", made, no_clearance) if made else None


@wp.func
def cross_of_edges(tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
    """(p1 - p0) x (p2 - p0)."""
    return wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0)


@functools.cache
def make_position(primitives: tuple[int, ...]):
    """Return ``(position, cross)``: ``(tri, u, v) -> vec3``.

    A point of a surface, and its normal, which is as long as the area element. Neither is meant on kinds that declare
    none (``Kind.position``, ``Kind.cross``); ``make_point_at`` knows the points of all of them.
    """
    kinds = kinds_of(primitives)
    positions = {kind.number: kind.position for kind in kinds if kind.position is not None}
    crosses = {kind.number: kind.cross for kind in kinds if kind.cross is not None}
    return join("position_of_any", positions, point_on), join("cross_of_any", crosses, cross_of_edges)


@functools.cache
def make_point_at(primitives: tuple[int, ...]):
    """Return ``point(scene, tri, u, v) -> vec3``: ``make_position``'s, on all kinds."""
    position, _cross_of = make_position(primitives)
    others = [kind for kind in kinds_of(primitives) if kind.position is None]
    surface_of = join("other_surface_of_kind", {kind.number: kind.make_surface(False, False) for kind in others})

    @wp.func
    def point_of_any(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
        if wp.static(surface_of is not None):
            if is_of(tri, wp.static(bits_of(others))):
                return surface_of(scene, tri, u, v).x
        return position(tri, u, v)

    return point_of_any


@functools.cache
def make_geometric_normal(primitives: tuple[int, ...]):
    """Return ``geometric_normal(scene, tri, u, v) -> vec3``: the unit normal, turned by flip_normals."""
    surface_of = make_surface_at(False, True, False, False, primitives) if primitives else None

    @wp.func
    def geometric_normal(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> wp.vec3:
        if wp.static(surface_of is not None):
            if is_primitive(tri):
                return surface_of(scene, tri, u, v).ng
        return tri.normal

    return geometric_normal


@functools.cache
def make_normal_at(primitives: tuple[int, ...]) -> wp.Function | None:
    """Return ``normal(scene, tri, x) -> vec3`` of shapes without triangles, of any length; None: there are none.

    It is 0 on what is seen from outside alone.
    """
    return join("normal_of_kind", {kind.number: kind.normal for kind in kinds_of(primitives)})


@functools.cache
def make_turn(primitives: tuple[int, ...]) -> wp.Function | None:
    """Return ``turn(scene, tri, u, v, x_dot) -> vec3`` at a point (u, v) that moves by x_dot, along the surface.

    It is the rate of the unit normal (``turned_normal.py``). None: the scene has no shapes without triangles.
    """
    return join("normal_turn_of_kind", {kind.number: kind.make_turn() for kind in kinds_of(primitives)})


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
    flow = has_flow(primitives)
    made = {kind.number: kind.make_sink(role, uv, tangent, rays, flow) for kind in kinds_of(primitives)}
    of_kind = join("sink_of_kind", made, anchored=True)
    if of_kind is None:
        return of_triangle

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
            return of_kind(scene, target, triangle_at(scene, face), u, v, adjoint, by_ray, o, d)
        return of_triangle(scene, target, face, u, v, adjoint, by_ray, o, d)

    return accumulate_any


@functools.cache
def make_velocity(smooth: bool, flat: bool, uv: bool, tangent: bool, primitives: tuple[int, ...]):
    """Return ``make_vertex_jvp``'s function, for vertices on any shape; other arguments as there."""
    of_triangle = make_vertex_jvp(smooth, flat, uv, tangent)
    flow = has_flow(primitives)
    made = {kind.number: kind.make_velocity(uv, tangent, flow) for kind in kinds_of(primitives)}
    of_kind = join("velocity_of_kind", made, anchored=True)
    if of_kind is None:
        return of_triangle

    @wp.func
    def velocity_of_any(
        scene: Scene,
        tangents: wp.array(dtype=wp.float32),
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        by_ray: wp.bool,
        o: wp.vec3,
        d: wp.vec3,
        o_dot: wp.vec3,
        d_dot: wp.vec3,
    ) -> VertexTangent:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        if is_primitive_at(scene, face):
            return of_kind(scene, tangents, triangle_at(scene, face), u, v, by_ray, o, d, o_dot, d_dot)
        return of_triangle(scene, tangents, face, u, v, by_ray, o, d, o_dot, d_dot)

    return velocity_of_any

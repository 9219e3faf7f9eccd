"""What a kind of shapes without triangles declares; ``table.py`` lists the kinds, and ``dispatch.py`` joins them.

A function in the world takes the record ``tri`` of a shape (``affine.py``) and the two numbers u and v that a vertex
holds. Kinds that are a fixed surface under an affine map declare ``Affine`` in the coordinates of that surface, and
``affine_kind.py`` makes the rest of it.
"""

from collections.abc import Callable
from typing import NamedTuple

import warp as wp

#: How vertices move with a shape: they ride on it; they slide along the rays that found them, and rays that leave are
#: tied to the surface (form S, ``docs/theory/implicit.md#form-s``); so too, or they flow along continuous normals
#: (``normal_flow.py``).
MATERIAL, SLIDES, FLOWS = "material", "slides", "flows"
#: What lengths that are divided by are at least, in the coordinates of a kind.
TINY = 1.0e-20


@wp.struct
class Graze:
    """Where a line nearly touches a shape, in the shape's coordinates."""

    q: wp.vec3
    off: wp.float32  # how far the line is from touching it
    rim: wp.int32  # 1: the surface ends there
    normal: wp.vec3  # of the surface, not of rims


class Outline(NamedTuple):
    """The smooth silhouette of an affine kind, phi = 0; phi is positive outside.

    Attributes:
        silhouette: ``(eye, distant, u) -> (q, bool)``: a point of the silhouette, and whether there is one; u in [0, 1)
            goes once around it. ``distant``: the eye is a direction.
        rate: ``(eye, distant, q) -> dq/du`` of that point.
        nearest: ``(eye, q) -> u`` of the point next to a point of the surface.
        seen: ``(eye) -> bool``: whether there is a silhouette.
        place: ``(u: vec2) -> q``, uniform in area.
        square: ``(q) -> vec2``, its inverse.
        gradient: ``(q) -> vec3`` of phi.
        bend: ``(q, w) -> float``: w^T H w, H the Hessian of phi.
        area: of the surface.
    """

    silhouette: wp.Function
    rate: wp.Function
    nearest: wp.Function
    seen: wp.Function
    place: wp.Function
    square: wp.Function
    gradient: wp.Function
    bend: wp.Function
    area: float


class Rim(NamedTuple):
    """The open edge of an affine kind: circles of the shape.

    Attributes:
        point: ``(u) -> q``.
        rate: ``(q) -> dq/du``.
        into: ``(q) -> vec3``, along the surface away from the rim.
        nearest: ``(q) -> u`` of the point next to a point of the surface.
    """

    point: wp.Function
    rate: wp.Function
    into: wp.Function
    nearest: wp.Function


class Facing(NamedTuple):
    """Points of an affine kind drawn from those that face e = A^-1 (x - b).

    Attributes:
        excess: ``(e) -> float``, positive where some points do not face e: it is outside.
        draw: ``(e, u: vec2) -> vec2``, the numbers of a point.
        square: ``(e, u, v) -> vec2``, its inverse.
        pdf: ``(tri, u, v, d, t) -> float``, the density in solid angle at x, in the world, which is t before the point
            along d (unit); negative: x is not outside.
    """

    excess: wp.Function
    draw: wp.Function
    square: wp.Function
    pdf: wp.Function


class Light(NamedTuple):
    """Points of an affine kind that shines (``shining.py``).

    Attributes:
        draw: ``(u: vec2) -> vec2``, the numbers of a point, uniform in area.
        square: ``(u, v) -> vec2``, its inverse.
        area: of the surface.
        facing: points that face the lit point; None: all of them may.
    """

    draw: wp.Function
    square: wp.Function
    area: float
    facing: Facing | None = None


class Affine(NamedTuple):
    """A kind whose shapes are one surface under affine maps, in the coordinates of that surface; q is a point of it.

    Attributes:
        point: ``(u, v) -> q``.
        coordinates: ``(q) -> vec2``, its inverse.
        hit: ``(o, d, t_max) -> RayHit``: the first point of a line; its ``face`` is -1 if there is none.
        normal: ``(q) -> vec3``, as long as the area element.
        tangents: ``(q) -> (dp/du, dp/dv)``.
        uv: ``(q) -> vec2``.
        rates: ``(q, q_dot) -> (normal, dp/du, uv)``: their velocities.
        pull: ``(q, a_normal, a_tangent, a_uv) -> vec3``: the transpose.
        level: ``(p) -> (gradient, phi)`` of a function that is 0 on the surface, at a point next to it.
        graze: ``(hit, o, d) -> Graze`` of a line that nearly touches the surface, which it meets at a hit.
        outline: its smooth silhouette; None: it has none.
        rim: its open edge; None: it has none.
        light: its points as those of a light; None: it cannot shine.
    """

    point: wp.Function
    coordinates: wp.Function
    hit: wp.Function
    normal: wp.Function
    tangents: wp.Function
    uv: wp.Function
    rates: wp.Function
    pull: wp.Function
    level: wp.Function
    graze: wp.Function
    outline: Outline | None = None
    rim: Rim | None = None
    light: Light | None = None


class Kind(NamedTuple):
    """A kind of shapes, in the world.

    Attributes:
        number: of the kind: the word ``i1`` of its records is -1 less that.
        moves: how its vertices move: ``MATERIAL``, ``SLIDES`` or ``FLOWS``.
        make_hit: (any place of it will do) -> ``(scene, tri, o, d, t_max) -> RayHit``: the first point of a ray; its
            ``face`` is 0, or -1 for a miss.
        make_lanes: (number of lanes, first free row) -> ``SteppedLanes``: how rays side by side meet it in steps
            (``lanes/primitive_lanes.py``); None: affine kinds are met by all lanes at once, others one by one.
        make_surface: (texture coordinates are read, dp/du is) -> ``(scene, tri, u, v) -> Surface``.
        partials: ``(scene, tri, u, v) -> (dp/du, dp/dv)``; None: it bears no bumps.
        position: ``(tri, u, v) -> vec3``, the point; None: the surface alone tells it.
        cross: ``(tri, u, v) -> vec3``, the normal as long as the area element; None: nobody asks for it.
        normal: ``(scene, tri, x) -> vec3``, of any length, at a point in the world; 0 where it is seen from outside
            alone.
        step: ``(scene, tri) -> float``: how far off it rays that leave start, world units; None: by the size of the box
            around it.
        clear: ``(scene, tri) -> float``: depth below a silhouette, world units, from which on no ray is taken to meet
            the surface on its far side, as phi is rounded; None: none.
        outside: it is seen from outside alone: rays that start inside leave it unseen.
        make_sink: (role, texture coordinates are read, dp/du is, rays move, vertices flow) -> ``(scene, target, tri, u,
            v, adjoint, by_ray, o, d) -> RayAdjoint``, as ``make_vertex_sink``'s.
        make_velocity: (texture coordinates are read, dp/du is, vertices flow) -> ``(scene, tangents, tri, u, v, by_ray,
            o, d, o_dot, d_dot) -> VertexTangent``, its transpose.
        make_turn: () -> ``(scene, tri, u, v, x_dot) -> vec3``: the rate of the unit normal as a point moves over it.
        patch: ``(scene, tri, u, v) -> int``: tells apart what of it a ray meets (``specular/chain_patches.py``); None:
            its two sides do.
        affine: what it is made of; None: it is no affine kind.
    """

    number: int
    moves: str
    make_hit: Callable[[bool], wp.Function]
    make_surface: Callable[[bool, bool], wp.Function]
    normal: wp.Function
    make_sink: Callable[..., wp.Function]
    make_velocity: Callable[..., wp.Function]
    make_turn: Callable[[], wp.Function]
    make_lanes: Callable | None = None
    partials: wp.Function | None = None
    position: wp.Function | None = None
    cross: wp.Function | None = None
    step: wp.Function | None = None
    clear: wp.Function | None = None
    outside: bool = False
    patch: wp.Function | None = None
    affine: Affine | None = None

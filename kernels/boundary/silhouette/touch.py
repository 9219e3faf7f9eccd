"""What a family of shapes tells the terms of its silhouettes (``primary.py``, ``secondary.py``, ``foreground.py``).

An *item* is a piece of a shape at which visibility, or what is seen, may change. A *touch* is a point of an item with a
direction in which a ray passes there. A family declares its functions in a ``Touch`` and a row of ``table.py``; exact
shapes of all kinds are one family. Directions w lead along the ray, from the sensor to the source, in the world.

Measures: kappa_n dA dtheta of a point of a smooth surface with a tangent direction, sin(phi) dl dsigma of a point of an
edge with a direction. Along the silhouette x(u) that an eye sees they are |dx/du x w| du dsigma.

Derivation: ``docs/theory/implicit.md#secondary-silhouettes``.
"""

from collections.abc import Callable
from typing import NamedTuple

import warp as wp

#: Distances from a silhouette at which a ray inside of it is looked for, each over the one before: float32 may miss the
#: shape at the first.
WIDER, TRIES = 4.0, 4
#: Share by which a ray inside starts farther in front of the silhouette than where it meets the shape.
MARGIN = 3.0
#: Sample slot of the camera's lens.
SLOT_LENS = 1
#: How far in front of an edge that is seen from the front rays back to the sensor start, in steps off the surface.
FRONT = 20.0


@wp.struct
class DrawnItem:
    """An item that was drawn."""

    number: wp.int32  # its place in the list
    face: wp.int32  # number of its shape's record
    along: wp.float32  # uniform in [0, 1) within it
    chance: wp.float32  # of the item: its probability, or of a family whose items are as likely their number
    aims: wp.bool  # it is aimed at lights as well
    factor: wp.float32  # of the guiding cube: weight of the sample; else 1


@wp.struct
class Passing:
    """How a ray along w passes a point."""

    shows: wp.int32  # 0: nothing jumps there
    crease: wp.int32  # 1: both sides show the shape, which is seen from the front
    out: wp.vec3  # unit, across the ray, away from the shape
    normal: wp.vec3  # boundary normal: sin(phi) against ``out``, of creases along it
    beside: wp.float32  # length: how far off the surface rays start, along ``out``
    start: wp.vec3  # where the ray back to the sensor starts
    curvature: wp.float32  # kappa_n along the ray, 1 / length; 0: of edges
    slant: wp.float32  # of edges of exact shapes: sine between ray and surface
    apart: wp.float32  # length: the first distance from the point at which the shape is looked for
    most: wp.float32  # length: the largest one


class Touch(NamedTuple):
    """The functions of a family; ``found`` is a record of its items, ``drawn`` a ``DrawnItem``.

    Attributes:
        items: struct of the items of a scene, with ``share``: of segments whose directions are not towards lights.
        point: struct of a point, with ``valid``, ``face`` (number of its record), ``x``, unit ``out``, and ``along``:
            dx/du of the curve of ``seen``.
        choice: ``(sampler, of_camera) -> float`` in [0, 1): the number that tells roots apart.
        draw: ``(found, own, u) -> DrawnItem``; ``own``: among all, else among those that are aimed at lights.
        draw_guided: ``(found, own, u, weight) -> DrawnItem`` of a point of the guiding cube.
        seen: ``(scene, found, drawn, eye, distant, choice) -> point`` of the curve that an eye sees (``distant``: from
            a direction).
        own: ``(scene, found, drawn, u: vec3, choice) -> (point, w)`` with a direction of its own.
        passing: ``(scene, point, w, step, reach) -> Passing``; ``reach``: distance to where the ray may start.
        ahead: ``(point, passing, w, apart) -> float``: how far in front of the point rays beside it meet the shape.
        meets: ``(point, outside, face, beyond, ahead) -> bool``: whether a hit that lies ``beyond`` the point belongs
            to its shape, on the inner side or beside a crease on the outer one.
        scale: ``(point, drawn, samples) -> float``: one over the density of ``seen`` per u.
        own_scale: ``(scene, point, drawn, w, curvature, samples) -> float``: one over the density of ``own`` in the
            measure of the point, 0 where it has none; None: points of the family are material, and send no foreground.
        own_density: ``(scene, found, point, drawn, w, curvature) -> float`` of ``own`` in the measure of the point,
            times the share of it.
        aimed_density: ``(scene, found, point, drawn, w, end) -> float`` of ``seen`` from ``end.y`` with ``end.towards``
            in that measure, times the share of it.
        weigh: ``(point, drawn, scale, samples, length) -> float``: ``scale`` by what was drawn besides density;
            ``length``: of the boundary normal, where only the size of a contribution counts; else 1.
        outline: ``(scene, point, w) -> vec3``: tangent, of any length, of an edge or of the silhouette from w.
        held: ``(scene, point) -> vec2``: what a vertex there would hold.
        make_sink: ``(role) -> (scene, target, point, g) -> float``: the adjoint g of the point, across its curve.
        tries: how many distances are looked at.
        hides: kinds of curves in which a point may lie unseen (``forwards.py``).
        creases: whether any item may be one that is seen from the front.
    """

    items: type
    point: type
    choice: wp.Function
    draw: wp.Function
    draw_guided: wp.Function
    seen: wp.Function
    own: wp.Function
    passing: wp.Function
    ahead: wp.Function
    meets: wp.Function
    scale: wp.Function
    own_scale: wp.Function | None
    own_density: wp.Function
    aimed_density: wp.Function
    weigh: wp.Function
    outline: wp.Function
    held: wp.Function
    make_sink: Callable[[str], wp.Function]
    tries: int = TRIES
    hides: tuple[int, ...] = ()
    creases: bool = False

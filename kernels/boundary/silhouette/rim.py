"""Rims: the ends of a shape without triangles, open edges that are silhouettes from everywhere.

A rim is a circle of the kind, x(u) = A q(u) + b, u in [0, 1). In the plane across a direction the surface lies on one
side of the rim; the normal towards the other side is perpendicular to the direction and to dx/du. If a disk closes a
cylinder, both rims are one edge of two surfaces: the disk holds it and knows its neighbour. If a cylinder stands on a
surface, its rim is no edge, but a curve of intersection (``crossing/``).

Derivation: ``docs/theory/implicit.md#rims``, ``#rims-that-join``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.boundary.silhouette.point import OutlineItem, SilhouettePoint
from warp_psdr.kernels.primitive.affine import cofactor, from_axes, to_axes
from warp_psdr.kernels.primitive.cylinder import CYLINDER, cylinder_into, cylinder_normal
from warp_psdr.kernels.primitive.disk import DISK, disk_into, disk_normal
from warp_psdr.kernels.primitive.kind import Affine
from warp_psdr.kernels.primitive.table import affine_of, join
from warp_psdr.kernels.structs import Scene, Triangle


@wp.func
def is_open_end(item: OutlineItem, q: wp.vec3) -> wp.bool:
    """Whether a cylinder's rim at q is an edge of its own."""
    return item.closed < 0 or wp.where(q[2] < 0.5, 0, 1) != item.closed


class Rims(NamedTuple):
    """Functions in the world; ``tri`` is the record of a shape.

    Attributes:
        seen: ``(tri, face, u, eye, distant) -> SilhouettePoint`` of the rim, with the normal across the way to an eye,
            or across a direction (``distant``); invalid where that runs along the rim.
        rate: ``(tri, q) -> dx/du``.
        slant: ``(tri, q, w) -> float``: sine of the angle between a direction and the surface.
    """

    seen: wp.Function
    rate: wp.Function
    slant: wp.Function


class Neighbour(NamedTuple):
    """Functions of the cylinder behind a disk's rim, ``item.neighbours[0]``.

    Attributes:
        into: ``(scene, item, x) -> vec3``, from the rim along its wall.
        slant: ``(scene, item, x, w) -> float``: sine of the angle between a direction and its wall.
        corner: ``(scene, item, point, w) -> float``: sine of the angle between disk and wall if rays along w come from
            within; else 0.
    """

    into: wp.Function
    slant: wp.Function
    corner: wp.Function


@functools.cache
def make_neighbour(primitives: tuple[int, ...]) -> Neighbour | None:
    """Return the functions; None: no scene of these kinds has such a rim."""
    if not {DISK.number, CYLINDER.number} <= set(primitives):
        return None

    @wp.func
    def wall_into(scene: Scene, item: OutlineItem, x: wp.vec3) -> wp.vec3:
        tri = scene.triangles[item.neighbours[0]]
        return to_axes(tri, cylinder_into(from_axes(tri, x - tri.normal)))

    @wp.func
    def wall_slant(scene: Scene, item: OutlineItem, x: wp.vec3, w: wp.vec3) -> wp.float32:
        tri = scene.triangles[item.neighbours[0]]
        n = cofactor(tri, cylinder_normal(from_axes(tri, x - tri.normal)))
        return wp.abs(wp.dot(wp.normalize(n), w))

    @wp.func
    def corner(scene: Scene, item: OutlineItem, point: SilhouettePoint, w: wp.vec3) -> wp.float32:
        wall = scene.triangles[item.neighbours[0]]
        cap = scene.triangles[point.face]
        n_wall = wp.normalize(cofactor(wall, cylinder_normal(from_axes(wall, point.x - wall.normal))))
        n_cap = wp.normalize(cofactor(cap, disk_normal(point.q)))
        along_wall = wall_into(scene, item, point.x)
        along_cap = to_axes(cap, disk_into(point.q))
        if wp.dot(w, n_cap) * wp.dot(along_wall, n_cap) < 0.0 and wp.dot(w, n_wall) * wp.dot(along_cap, n_wall) < 0.0:
            return wp.length(wp.cross(n_wall, n_cap))
        return 0.0

    return Neighbour(wall_into, wall_slant, corner)


@functools.cache
def make_rims(primitives: tuple[int, ...]) -> Rims | None:
    """Return the functions for the kinds of a scene; None: none of them has a rim."""
    made = {n: _make_rim(affine) for n, affine in affine_of(primitives).items() if affine.rim is not None}
    if not made:
        return None
    return Rims(*(join(f"rim_{name}", {n: getattr(f, name) for n, f in made.items()}) for name in Rims._fields))


def _make_rim(affine: Affine) -> Rims:
    rim = affine.rim

    @wp.func
    def rim_seen(tri: Triangle, face: wp.int32, u: wp.float32, eye: wp.vec3, distant: wp.bool) -> SilhouettePoint:
        r = SilhouettePoint()
        r.face = face
        r.q = rim.point(u)
        r.x = tri.normal + to_axes(tri, r.q)
        d = eye
        if not distant:
            d = eye - r.x
        m = wp.cross(to_axes(tri, rim.rate(r.q)), wp.normalize(d))
        length = wp.length(m)
        if wp.dot(m, to_axes(tri, rim.into(r.q))) > 0.0:
            m = -m
        r.out = (1.0 / wp.where(length > 0.0, length, 1.0)) * m
        r.valid = wp.where(length > 0.0, 1, 0)
        return r

    @wp.func
    def rim_rate(tri: Triangle, q: wp.vec3) -> wp.vec3:
        return to_axes(tri, rim.rate(q))

    @wp.func
    def rim_slant(tri: Triangle, q: wp.vec3, w: wp.vec3) -> wp.float32:
        return wp.abs(wp.dot(wp.normalize(cofactor(tri, affine.normal(q))), w))

    return Rims(rim_seen, rim_rate, rim_slant)

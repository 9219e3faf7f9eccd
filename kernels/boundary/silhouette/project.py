"""Projection of a point of an exact shape to the visible part of its outline, in closed form.

From an eye e outside of the unit sphere, the nearest point of the circle q . e = 1 keeps the direction across e. On a
cylinder it is the nearer of the two lines, at the same height. On rims the point keeps its angle; of a cylinder's two
rims the nearer one counts. All of it is in the shape's coordinates, so that on ellipsoids the point is near, but not
the nearest one.

Derivation: ``docs/theory/guiding.md#projection-to-exact-shapes``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.boundary.silhouette.sphere import circle_radius
from warp_psdr.kernels.constants import INV_TWO_PI, PRIMITIVE_CYLINDER, PRIMITIVE_DISK, PRIMITIVE_SPHERE
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.primitive.affine import from_axes
from warp_psdr.kernels.primitive.kinds import join
from warp_psdr.kernels.sampling import sphere_to_square
from warp_psdr.kernels.structs import Triangle


@wp.func
def share_of_turn(y: wp.float32, x: wp.float32) -> wp.float32:
    """The angle of (x, y) as a share of a turn, in [0, 1)."""
    t = wp.atan2(y, x) * INV_TWO_PI
    return wp.min(wp.where(t < 0.0, t + 1.0, t), 0.9999999)


@wp.func
def sphere_outline_near(eye: wp.vec3, q: wp.vec3) -> wp.float32:
    """U of the point of ``sphere_silhouette`` that is nearest to a point of the sphere."""
    axis = wp.normalize(eye)
    a = any_tangent(axis)
    return share_of_turn(wp.dot(q, wp.cross(axis, a)), wp.dot(q, a))


@wp.func
def sphere_outline_seen(eye: wp.vec3) -> wp.bool:
    return circle_radius(eye, False) > 0.0


@wp.func
def sphere_square(q: wp.vec3) -> wp.vec2:
    """The inverse of ``sphere_place``."""
    return sphere_to_square(wp.normalize(q))


@wp.func
def cylinder_outline_near(eye: wp.vec3, q: wp.vec3) -> wp.float32:
    """The same of ``cylinder_silhouette``."""
    z = wp.clamp(q[2], 0.0, 0.999999)
    left = eye[0] * q[1] - eye[1] * q[0] >= 0.0
    return 0.5 * (z + wp.where(left, 0.0, 1.0))


@wp.func
def cylinder_outline_seen(eye: wp.vec3) -> wp.bool:
    return eye[0] * eye[0] + eye[1] * eye[1] > 1.0


@wp.func
def cylinder_square(q: wp.vec3) -> wp.vec2:
    """The inverse of ``cylinder_place``."""
    return wp.vec2(share_of_turn(q[1], q[0]), wp.clamp(q[2], 0.0, 0.9999999))


@wp.func
def disk_rim_near(q: wp.vec3) -> wp.float32:
    """U of the point of a rim that is nearest to a point of the surface."""
    return share_of_turn(q[1], q[0])


@wp.func
def cylinder_rim_near(q: wp.vec3) -> wp.float32:
    return 0.5 * (share_of_turn(q[1], q[0]) + wp.where(q[2] < 0.5, 0.0, 1.0))


class Near(NamedTuple):
    """The functions of a kind with a smooth outline, in its own coordinates.

    Attributes:
        outline: ``(eye, q) -> u``.
        seen: ``(eye) -> bool``: whether there is an outline.
        square: ``(q) -> vec2``, the inverse of ``place``.
    """

    outline: wp.Function
    seen: wp.Function
    square: wp.Function


#: Kind (PRIMITIVE_*) -> its functions.
NEAR: dict[int, Near] = {
    PRIMITIVE_SPHERE: Near(sphere_outline_near, sphere_outline_seen, sphere_square),
    PRIMITIVE_CYLINDER: Near(cylinder_outline_near, cylinder_outline_seen, cylinder_square),
}
#: Kind -> ``(q) -> u`` of its rim.
RIM_NEAR: dict[int, wp.Function] = {PRIMITIVE_DISK: disk_rim_near, PRIMITIVE_CYLINDER: cylinder_rim_near}


class Projections(NamedTuple):
    """Functions in the world; ``tri`` is the record of a shape.

    Attributes:
        outline: ``(tri, eye, q) -> u`` of the smooth outline as seen from an eye; negative: there is none.
        square: ``(tri, q) -> vec2``: the numbers of ``Silhouettes.place``; None where no kind has a smooth outline.
        rim: ``(tri, q) -> u``; None where no kind has a rim.
    """

    outline: wp.Function | None
    square: wp.Function | None
    rim: wp.Function | None


@functools.cache
def make_projections(primitives: tuple[int, ...]) -> Projections:
    """Return the functions for the kinds of a scene."""
    smooth = {kind: _make_near(NEAR[kind]) for kind in primitives if kind in NEAR}
    rims = {kind: _make_rim_near(RIM_NEAR[kind]) for kind in primitives if kind in RIM_NEAR}
    return Projections(
        outline=join(_either_near, {kind: f[0] for kind, f in smooth.items()}) if smooth else None,
        square=join(_either_square, {kind: f[1] for kind, f in smooth.items()}) if smooth else None,
        rim=join(_either_rim_near, rims) if rims else None,
    )


def _make_near(kind: Near) -> tuple[wp.Function, wp.Function]:
    @wp.func
    def outline_near(tri: Triangle, eye: wp.vec3, q: wp.vec3) -> wp.float32:
        here = from_axes(tri, eye - tri.normal)
        if kind.seen(here):
            return kind.outline(here, q)
        return -1.0

    @wp.func
    def square_of(tri: Triangle, q: wp.vec3) -> wp.vec2:
        return kind.square(q)

    return outline_near, square_of


def _make_rim_near(f: wp.Function) -> wp.Function:
    @wp.func
    def rim_near(tri: Triangle, q: wp.vec3) -> wp.float32:
        return f(q)

    return rim_near


def _either_near(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def near_of_kind(tri: Triangle, eye: wp.vec3, q: wp.vec3) -> wp.float32:
        if tri.i1 == word:
            return f(tri, eye, q)
        return rest(tri, eye, q)

    return near_of_kind


def _either_square(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def square_of_kind(tri: Triangle, q: wp.vec3) -> wp.vec2:
        if tri.i1 == word:
            return f(tri, q)
        return rest(tri, q)

    return square_of_kind


def _either_rim_near(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def rim_near_of_kind(tri: Triangle, q: wp.vec3) -> wp.float32:
        if tri.i1 == word:
            return f(tri, q)
        return rest(tri, q)

    return rim_near_of_kind

"""Points of smooth silhouettes in the world, for the affine kinds of shapes without triangles (``Affine.outline``).

With the gradient of phi and its Hessian H in the shape's coordinates, x = A q + b, the normal is along A^-T grad phi,
and the normal curvature along a tangent direction w is kappa_n = (A^-1 w)^T H (A^-1 w) / |A^-T grad phi|.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.boundary.silhouette.point import OutlineItem, SilhouettePoint
from warp_psdr.kernels.primitive.affine import cofactor, determinant, from_axes, make_pose_sink, to_axes
from warp_psdr.kernels.primitive.kind import Outline
from warp_psdr.kernels.primitive.table import affine_of, join
from warp_psdr.kernels.structs import Scene, Triangle


class Silhouettes(NamedTuple):
    """Functions in the world; ``tri`` is the record of a shape.

    Attributes:
        seen: ``(tri, face, eye, distant, u) -> SilhouettePoint`` of the silhouette as seen from the eye.
        rate: ``(tri, eye, distant, q) -> dx/du`` of that point.
        place: ``(tri, face, u: vec2) -> SilhouettePoint`` of the surface.
        density: ``(tri, q) -> float``: of ``place``, per area.
        curvature: ``(tri, q, w) -> float``: kappa_n along the tangent w.
    """

    seen: wp.Function
    rate: wp.Function
    place: wp.Function
    density: wp.Function
    curvature: wp.Function


@wp.func
def choose_outline(outlines: wp.array(dtype=OutlineItem), u: wp.float64) -> tuple[wp.int32, wp.float32]:
    """Place of one of some outlines, each as likely, and u within it."""
    scaled = u * wp.float64(outlines.shape[0])
    k = wp.min(wp.int32(scaled), outlines.shape[0] - 1)
    return k, wp.clamp(wp.float32(scaled - wp.float64(k)), 0.0, 1.0)


@functools.cache
def make_silhouettes(primitives: tuple[int, ...]) -> Silhouettes | None:
    """Return the functions for the affine kinds of a scene; None: none of them has a smooth silhouette."""
    smooth = {n: affine.outline for n, affine in affine_of(primitives).items() if affine.outline is not None}
    made = {n: _make_outline(outline) for n, outline in smooth.items()}
    if not made:
        return None
    return Silhouettes(
        *(join(f"outline_{name}", {n: getattr(f, name) for n, f in made.items()}) for name in Silhouettes._fields)
    )


@functools.cache
def make_coordinates(primitives: tuple[int, ...]) -> wp.Function | None:
    """Return ``coordinates(tri, q) -> vec2``: what a vertex would hold at a point of a shape; None: no affine kinds."""
    return join("coordinates_of_kind", {n: _make_coordinates(f.coordinates) for n, f in affine_of(primitives).items()})


def _make_coordinates(f: wp.Function) -> wp.Function:
    @wp.func
    def coordinates_at(tri: Triangle, q: wp.vec3) -> wp.vec2:
        return f(q)

    return coordinates_at


def _make_outline(kind: Outline) -> Silhouettes:
    @wp.func
    def silhouette_point(tri: Triangle, face: wp.int32, q: wp.vec3, valid: wp.bool) -> SilhouettePoint:
        r = SilhouettePoint()
        r.valid = wp.where(valid, 1, 0)
        r.face = face
        r.q = q
        r.x = tri.normal + to_axes(tri, q)
        r.out = wp.normalize(cofactor(tri, kind.gradient(q)))
        if determinant(tri) < 0.0:
            r.out = -r.out
        return r

    @wp.func
    def silhouette_seen(
        tri: Triangle, face: wp.int32, eye: wp.vec3, distant: wp.bool, u: wp.float32
    ) -> SilhouettePoint:
        here = from_axes(tri, eye)
        if not distant:
            here = from_axes(tri, eye - tri.normal)
        q, some = kind.silhouette(here, distant, u)
        return silhouette_point(tri, face, q, some)

    @wp.func
    def silhouette_rate(tri: Triangle, eye: wp.vec3, distant: wp.bool, q: wp.vec3) -> wp.vec3:
        here = from_axes(tri, eye)
        if not distant:
            here = from_axes(tri, eye - tri.normal)
        return to_axes(tri, kind.rate(here, distant, q))

    @wp.func
    def surface_place(tri: Triangle, face: wp.int32, u: wp.vec2) -> SilhouettePoint:
        return silhouette_point(tri, face, kind.place(u), True)

    @wp.func
    def place_density(tri: Triangle, q: wp.vec3) -> wp.float32:
        return 1.0 / (wp.static(kind.area) * wp.length(cofactor(tri, kind.gradient(q))))

    @wp.func
    def normal_curvature(tri: Triangle, q: wp.vec3, w: wp.vec3) -> wp.float32:
        slope = wp.length(cofactor(tri, kind.gradient(q))) / wp.abs(determinant(tri))
        return kind.bend(q, from_axes(tri, w)) / slope

    return Silhouettes(silhouette_seen, silhouette_rate, surface_place, place_density, normal_curvature)


@functools.cache
def make_silhouette_sink(role: str):
    """Return ``accumulate(scene, target, point, g) -> float``: the adjoint g of a point that rides on its shape."""
    accumulate_pose = make_pose_sink(role)

    @wp.func
    def accumulate_silhouette(
        scene: Scene, target: wp.array(dtype=wp.float32), point: SilhouettePoint, g: wp.vec3
    ) -> wp.float32:
        tri = scene.triangles[point.face]
        return accumulate_pose(target, tri, point.q[0] * g, point.q[1] * g, point.q[2] * g, g)

    return accumulate_silhouette

"""Points of smooth silhouettes in the world, for the kinds of shapes without triangles; a new kind is a file and a row.

With the gradient of phi and its Hessian H in the shape's coordinates, x = A q + b, the normal is along A^-T grad phi,
and the normal curvature along a tangent direction w is kappa_n = (A^-1 w)^T H (A^-1 w) / |A^-T grad phi|.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.boundary.silhouette.sphere import (
    SPHERE_AREA,
    sphere_bend,
    sphere_gradient,
    sphere_place,
    sphere_silhouette,
    sphere_silhouette_rate,
)
from warp_psdr.kernels.constants import PRIMITIVE_SPHERE
from warp_psdr.kernels.primitive.affine import cofactor, determinant, from_axes, make_pose_sink, to_axes
from warp_psdr.kernels.primitive.sphere import sphere_coordinates
from warp_psdr.kernels.structs import Scene, Triangle


class Outline(NamedTuple):
    """The functions of a kind, in its own coordinates.

    Attributes:
        silhouette: ``(eye, distant, u) -> (q, bool)``: a point of the silhouette, and whether there is one; u in [0, 1)
            goes once around it. ``distant``: the eye is a direction.
        rate: ``(eye, distant, q) -> dq/du`` of that point.
        place: ``(u: vec2) -> q``, uniform in area.
        gradient: ``(q) -> vec3`` of phi.
        bend: ``(q, w) -> float``: w^T H w.
        coordinates: ``(q) -> vec2``: what a vertex there would hold.
        area: of the surface.
    """

    silhouette: wp.Function
    rate: wp.Function
    place: wp.Function
    gradient: wp.Function
    bend: wp.Function
    coordinates: wp.Function
    area: float


#: Kind (PRIMITIVE_*) -> its functions.
OUTLINES: dict[int, Outline] = {
    PRIMITIVE_SPHERE: Outline(
        silhouette=sphere_silhouette,
        rate=sphere_silhouette_rate,
        place=sphere_place,
        gradient=sphere_gradient,
        bend=sphere_bend,
        coordinates=sphere_coordinates,
        area=SPHERE_AREA,
    )
}


@wp.struct
class SilhouettePoint:
    """A point of a shape without triangles."""

    valid: wp.int32
    face: wp.int32  # number of the record
    q: wp.vec3  # in the shape's coordinates
    x: wp.vec3
    out: wp.vec3  # unit normal to the outside


class Silhouettes(NamedTuple):
    """Functions in the world; ``tri`` is the record of a shape.

    Attributes:
        choose: ``(faces, u: float64) -> (int, float)``: one of some shapes, each as likely, and u within it.
        seen: ``(tri, face, eye, distant, u) -> SilhouettePoint`` of the silhouette as seen from the eye.
        rate: ``(tri, eye, distant, q) -> dx/du`` of that point.
        place: ``(tri, face, u: vec2) -> SilhouettePoint`` of the surface.
        density: ``(tri, q) -> float``: of ``place``, per area.
        curvature: ``(tri, q, w) -> float``: kappa_n along the tangent w.
        coordinates: ``(q) -> vec2``.
    """

    choose: wp.Function
    seen: wp.Function
    rate: wp.Function
    place: wp.Function
    density: wp.Function
    curvature: wp.Function
    coordinates: wp.Function


@functools.cache
def make_silhouettes(primitives: tuple[int, ...]) -> Silhouettes:
    """Return the functions for a scene that holds one kind."""
    if len(primitives) != 1:
        raise ValueError(f"kinds of shapes without triangles: got {primitives}, expected one")
    kind = OUTLINES[primitives[0]]

    @wp.func
    def choose_shape(faces: wp.array(dtype=wp.int32), u: wp.float64) -> tuple[wp.int32, wp.float32]:
        scaled = u * wp.float64(faces.shape[0])
        k = wp.min(wp.int32(scaled), faces.shape[0] - 1)
        return faces[k], wp.clamp(wp.float32(scaled - wp.float64(k)), 0.0, 1.0)

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

    return Silhouettes(
        choose_shape,
        silhouette_seen,
        silhouette_rate,
        surface_place,
        place_density,
        normal_curvature,
        kind.coordinates,
    )


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

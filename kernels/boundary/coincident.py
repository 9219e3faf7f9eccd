"""Coincident silhouettes: edges of several shapes on one jump of light, which counts once.

Shapes that abut share the jump along their common line. Point, spot and directional lights and orthographic cameras may
see edges one behind the other; the edge nearest to x_1, or to the camera, then counts.

Derivation: ``docs/theory/boundary.md#silhouettes-that-coincide``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, edge_step, facing_side
from warp_psdr.kernels.emitter.dispatch import is_delta_light, make_delta_sample
from warp_psdr.kernels.step import leaving_step
from warp_psdr.kernels.structs import Accel, LightSample, Scene
from warp_psdr.kernels.vertex import PathConfig, RayConfig
from warp_psdr.kernels.visibility import visibility_of

#: Distance, over that of an edge, at which a light counts as infinitely far.
DISTANT = 1.0e3
#: Distance from an edge at which its rays to lights start, in the distances at which they pass it.
CLEAR = 10.0


@wp.func
def edge_share(
    scene: Scene, edges: Edges, point: EdgePoint, along: wp.vec3, w: wp.vec3, side: wp.float32
) -> wp.float32:
    """Return the part of the jump at a point of a silhouette that is its own edge's.

    Args:
        scene: the scene.
        edges: with ``beside``.
        point: on one of them.
        along: its unit tangent.
        w: direction of the segment, a unit vector.
        side: of ``facing_side`` there.
    """
    count = wp.int32(1)
    if edges.beside_first.shape[0] > 1:
        outward = -side * wp.normalize(wp.cross(along, w))
        for i in range(edges.beside_first[point.edge], edges.beside_first[point.edge + 1]):
            other = EdgePoint()
            other.edge = edges.beside[i]
            other.p0 = edges.points[other.edge, 0]
            other.p1 = edges.points[other.edge, 1]
            way = other.p1 - other.p0
            r = point.x - other.p0
            t = wp.dot(r, way)
            if t >= 0.0 and t < wp.dot(way, way) and facing_side(scene, edges, other, along, w) == side:
                if wp.dot(r, outward) < edge_step(scene, edges, other.edge):
                    count += 1
    return 1.0 / wp.float32(count)


@wp.func
def distance_to_plane(scene: Scene, face: wp.int32, x: wp.vec3, w: wp.vec3, margin: wp.float32) -> wp.float32:
    """Distance from x against w to the plane of a face, less what keeps a ray from there off it."""
    tri = scene.triangles[face]
    cosine = wp.dot(tri.normal, w)
    return wp.dot(tri.normal, x - tri.p0) / cosine - (margin + leaving_step(scene, face)) / wp.abs(cosine)


@functools.cache
def make_screened(rays: RayConfig, primitives: tuple[int, ...]):
    """Return ``screened(scene, accel, edges, point, x, w, way, face, behind) -> bool``: whether another edge counts.

    That is whether a ray along w to x, beside a point of a silhouette on the occluder's side, from the distance ``way``
    on, meets another body first. The triangle ``face``, off which it starts (-1: none), does not count.
    """
    visibility = visibility_of(rays, primitives)

    @wp.func
    def screened(
        scene: Scene,
        accel: Accel,
        edges: Edges,
        point: EdgePoint,
        x: wp.vec3,
        w: wp.vec3,
        way: wp.float32,
        face: wp.int32,
        behind: wp.float32,
    ) -> wp.bool:
        if way <= behind:
            return False
        hit = visibility.closest_in(accel, x - way * w, w, way - behind)
        if hit.face < 0:
            return False
        part = edges.parts[hit.face]
        for i in range(edges.first[point.edge], edges.first[point.edge + 1]):
            if edges.parts[edges.faces[i]] == part:
                return False
        return hit.face != face

    return screened


@wp.func
def pass_together(r: wp.vec3, w: wp.vec3, t: wp.float32, step: wp.float32) -> wp.bool:
    """Whether a segment r from a point, and the ray w, a unit vector, pass an edge at the distance t there together."""
    distance = wp.length(r)
    return distance > t and wp.dot(r, w) > 0.0 and t * wp.length(wp.cross(r, w)) <= step * distance


@functools.cache
def make_lit_along(others: tuple[int, ...]):
    """Return ``lit_along(scene, x, v, step) -> bool``: whether a light of no area lights x past an edge at x + v."""

    @wp.func
    def passes(scene: Scene, x: wp.vec3, v: wp.vec3, step: wp.float32, ls: LightSample) -> wp.bool:
        t = wp.length(v)
        return pass_together(wp.min(ls.distance, DISTANT * t) * ls.wi, wp.normalize(v), t, step)

    return _make_any_light(others, passes)


@functools.cache
def make_shadow_along(config: PathConfig):
    """Return ``shadow_along(scene, x, into, step) -> bool``: whether an edge's shadow falls along another edge.

    Args of it: x on that edge; the unit vector ``into`` from there in its face; the distance on either side of x at
    which the light of a lamp without area is looked for.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)

    @wp.func
    def ends(scene: Scene, x: wp.vec3, into: wp.vec3, step: wp.float32, ls: LightSample) -> wp.bool:
        start = x + (CLEAR * step) * ls.wi
        reach = ls.distance - CLEAR * step
        hidden = visibility.occluded(scene, start + step * into, ls.wi, reach)
        return hidden and not visibility.occluded(scene, start - step * into, ls.wi, reach)

    return _make_any_light(config.lights.others, ends)


def _make_any_light(others: tuple[int, ...], test: wp.Function):
    """Return ``any_light(scene, x, v, step) -> bool``: whether ``test`` holds for some light of no area, from x."""
    sample = make_delta_sample(others)

    @wp.func
    def any_light(scene: Scene, x: wp.vec3, v: wp.vec3, step: wp.float32) -> wp.bool:
        for i in range(scene.emitters.shape[0]):
            emitter = scene.emitters[i]
            if is_delta_light(emitter.kind):
                if test(scene, x, v, step, sample(scene, emitter, x, wp.vec2(0.0, 0.0))):
                    return True
        return False

    return any_light

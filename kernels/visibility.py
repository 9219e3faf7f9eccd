"""Ray queries for all kernels: the hit of a ray, and whether light passes between two points.

A segment is free if no ray hits anything on it. Where light passes surfaces (masks, thin glass), the transmittance of a
shadow ray's segment replaces ``occluded`` (``transmittance.py``). The camera's own rays meet everything, or all but
area lights where lights are hidden (``hide_emitters``): a structure without the lights, and no rays that continue
behind a light, since a step past the light would cross whatever touches it.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bvh.wide import Accel, RayHit, make_intersect
from warp_psdr.kernels.primitive.dispatch import make_primitive_queries
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import RayConfig


class Visibility(NamedTuple):
    """Warp functions of ray queries; directions are unit, ``t_max`` is a length in world units.

    Attributes:
        closest: ``(scene, o, d, t_max) -> RayHit``.
        occluded: ``(scene, o, d, t_max) -> bool``: whether anything lies on the segment.
        camera_accel: ``(scene) -> Accel``: what the camera's own rays meet.
        seen: ``(scene, o, d, t_max, depth) -> RayHit``: the closest hit behind ``depth`` path vertices; at depth 0 it
            is what the camera sees.
        closest_in: ``(accel, o, d, t_max) -> RayHit``: of triangles.
        hidden_from_camera: ``(scene, o, d, t_max) -> bool``: ``occluded`` for segments that end in the camera.
    """

    closest: wp.Function
    occluded: wp.Function
    camera_accel: wp.Function
    seen: wp.Function
    closest_in: wp.Function
    hidden_from_camera: wp.Function


@functools.cache
def make_visibility(backend: str, width: int, hidden: bool = False, primitives: tuple[int, ...] = ()) -> Visibility:
    """Return the functions.

    Args:
        backend: "wide" or "warp", see ``bvh/wide.py``.
        width: number of lanes of the wide structure.
        hidden: True: there are area lights, which the camera does not see.
        primitives: kinds of shapes without triangles; ``closest_in`` does not meet them.
    """
    closest_hit, any_hit = make_intersect(backend, width)

    @wp.func
    def closest(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
        return closest_hit(scene.accel, o, d, t_max)

    @wp.func
    def occluded(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> wp.bool:
        return any_hit(scene.accel, o, d, t_max)

    @wp.func
    def camera_accel(scene: Scene) -> Accel:
        if wp.static(hidden):
            return scene.sight
        return scene.accel

    @wp.func
    def accel_at(scene: Scene, depth: wp.int32) -> Accel:
        if wp.static(hidden):
            if depth == 0:
                return camera_accel(scene)
        return scene.accel

    @wp.func
    def seen(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32, depth: wp.int32) -> RayHit:
        return closest_hit(accel_at(scene, depth), o, d, t_max)

    @wp.func
    def hidden_from_camera(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> wp.bool:
        return any_hit(camera_accel(scene), o, d, t_max)

    if not primitives:
        return Visibility(closest, occluded, camera_accel, seen, closest_hit, hidden_from_camera)
    closest_primitive, occluded_by_primitive = make_primitive_queries(primitives)
    closest_shown, occluded_by_shown = make_primitive_queries(primitives, hidden)

    @wp.func
    def closest_of_any(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
        return closest_primitive(scene, o, d, closest(scene, o, d, t_max))

    @wp.func
    def occluded_by_any(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> wp.bool:
        return occluded_by_primitive(scene, o, d, t_max) or occluded(scene, o, d, t_max)

    @wp.func
    def any_seen(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32, depth: wp.int32) -> RayHit:
        hit = seen(scene, o, d, t_max, depth)
        if wp.static(hidden):
            if depth == 0:
                return closest_shown(scene, o, d, hit)
        return closest_primitive(scene, o, d, hit)

    @wp.func
    def any_hidden_from_camera(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> wp.bool:
        return occluded_by_shown(scene, o, d, t_max) or hidden_from_camera(scene, o, d, t_max)

    return Visibility(closest_of_any, occluded_by_any, camera_accel, any_seen, closest_hit, any_hidden_from_camera)


def visibility_of(rays: RayConfig, primitives: tuple[int, ...]) -> Visibility:
    """Return the functions for a scene; ``primitives``: its kinds of shapes without triangles."""
    return make_visibility(rays.backend, rays.width, rays.hidden, primitives)


def visibility_of_meshes(rays: RayConfig) -> Visibility:
    """Return those that meet triangles alone."""
    return make_visibility(rays.backend, rays.width, rays.hidden)

"""Visibility of a point along a segment that is followed forwards: rays that start inside a tube leave it unseen.

A part of a mesh may lie inside a tube that it runs through, and a part of a tube inside its neighbour at a joint. Such
a part sees everything outside, and nothing sees it.

Derivation: ``docs/theory/implicit.md#silhouettes-of-tubes``.
"""

import functools

import warp as wp

from warp_psdr.kernels.primitive.curve_kinds import CURVES
from warp_psdr.kernels.primitive.dispatch import has_outside_alone
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import RayConfig
from warp_psdr.kernels.visibility import visibility_of

#: Share of the way from x_1 on which the segment is followed forwards.
FORWARDS = 0.999


@functools.cache
def make_sees(rays: RayConfig, primitives: tuple[int, ...], kinds: tuple[int, ...] = CURVES):
    """Return ``sees(scene, x, w, t1) -> bool``: whether a ray comes along w, from the distance t1, to a point.

    ``kinds``: those of curves that the point may lie in; in scenes without them no ray is traced.
    """
    visibility = visibility_of(rays, primitives)
    asks = bool(set(kinds) & set(primitives))

    @wp.func
    def sees(scene: Scene, x: wp.vec3, w: wp.vec3, t1: wp.float32) -> wp.bool:
        if wp.static(asks):
            way = FORWARDS * t1
            return not visibility.occluded(scene, x - way * w, w, way)
        return True

    return sees


@functools.cache
def make_hidden(rays: RayConfig, primitives: tuple[int, ...], inside: bool = True):
    """Return ``hidden(scene, x, origin, near) -> bool``: whether something is between a camera's ray origin and x.

    What is nearer than ``near`` does not count. ``inside``: x may lie inside a shape that is seen from outside alone.
    """
    visibility = visibility_of(rays, primitives)
    forwards = inside and has_outside_alone(primitives)

    @wp.func
    def hidden(scene: Scene, x: wp.vec3, origin: wp.vec3, near: wp.float32) -> wp.bool:
        back = origin - x
        length = wp.length(back)
        if length <= near:
            return False
        back = back / length
        if wp.static(forwards):
            return visibility.hidden_from_camera(scene, origin - near * back, -back, length - near)
        return visibility.hidden_from_camera(scene, x, back, length - near)

    return hidden

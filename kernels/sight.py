"""What the camera sees: where lights are hidden (``hide_emitters``), its rays pass through area lights."""

import functools

import warp as wp

from warp_psdr.kernels.bvh.wide import make_intersect
from warp_psdr.kernels.step import leaving_step
from warp_psdr.kernels.structs import Scene


@functools.cache
def make_sight(backend: str, width: int, hidden: bool):
    """Return ``(past, blocked)``.

    ``past(scene, o, d, t_max) -> float``: the distance from o at which a ray of the camera has passed the hidden
    lights in front of what it meets; ``blocked(scene, o, d, t_max) -> bool``: whether it meets anything.
    """
    closest_hit, any_hit = make_intersect(backend, width)

    @wp.func
    def past(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> wp.float32:
        behind = wp.float32(0.0)
        if wp.static(hidden):
            hit = closest_hit(scene.accel, o, d, t_max)
            while hit.face >= 0 and scene.shapes[scene.triangles[wp.max(hit.face, 0)].shape].emitter >= 0:
                behind += hit.t + leaving_step(scene, hit.face)
                hit = closest_hit(scene.accel, o + behind * d, d, t_max - behind)
        return behind

    @wp.func
    def blocked(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> wp.bool:
        if wp.static(hidden):
            behind = past(scene, o, d, t_max)
            return any_hit(scene.accel, o + behind * d, d, t_max - behind)
        return any_hit(scene.accel, o, d, t_max)

    return past, blocked

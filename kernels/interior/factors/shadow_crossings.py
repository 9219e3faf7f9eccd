"""The crossings of a shadow segment, found again for the sweep with less searching than the first time.

The first walk has kept the first surface and the number of surfaces. The second walk therefore traces one ray less than
there are surfaces, and none through a single interface.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.path_media import MediaVertex
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import RayConfig
from warp_psdr.kernels.visibility import visibility_of


@functools.cache
def make_crossed_surface(rays: RayConfig, primitives: tuple[int, ...]):
    """Return ``shadow_crossing(scene, vertex, number, start, t_max) -> RayHit``.

    The surface of that ``number`` on the segment to the vertex's light, which nothing blocks; face -1: none is left.
    ``start``: behind the one before, ``t_max``: what is left of the segment there.
    """
    visibility = visibility_of(rays, primitives)

    @wp.func
    def shadow_crossing(scene: Scene, v: MediaVertex, number: wp.int32, start: wp.vec3, t_max: wp.float32) -> RayHit:
        if number == 0:
            return v.shadow_hit
        if number < v.shadow_crossings:
            return visibility.closest(scene, start, v.shadow_d, t_max)
        none = RayHit()
        none.face = -1
        none.t = t_max
        return none

    return shadow_crossing

"""Shadow rays to lights of no area, from surface to surface, where masks and thin sheets let them pass.

Derivation: ``docs/theory/boundary.md#shadows-of-masks``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.step import step_beside
from warp_psdr.kernels.structs import LightSample, Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@wp.struct
class ShadowWalk:
    """A shadow ray on its way from surface to surface."""

    o: wp.vec3
    left: wp.float32  # of its length
    hit: RayHit
    passes: wp.bool
    x: wp.vec3  # what it meets, and the normal there
    ng: wp.vec3


@functools.cache
def make_shadow_walk(config: PathConfig):
    """Return ``(start, onward)``: a shadow ray to its first surface, and from there to the next one.

    ``start(scene, x, ng, ls) -> ShadowWalk``, ``onward(scene, walk, w) -> ShadowWalk``.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    has_null = interaction.bsdf.has_null

    @wp.func
    def met(scene: Scene, o: wp.vec3, w: wp.vec3, left: wp.float32) -> ShadowWalk:
        r = ShadowWalk()
        r.o = o
        r.left = left
        r.hit = visibility.closest(scene, o, w, left)
        if r.hit.face >= 0:
            at = interaction.at(scene, r.hit.face, r.hit.u, r.hit.v, w)
            r.x = at.x
            r.ng = at.ng
            r.passes = has_null(at.model)
        return r

    @wp.func
    def start(scene: Scene, x: wp.vec3, ng: wp.vec3, ls: LightSample) -> ShadowWalk:
        return met(scene, step_beside(x, ng, ls.wi, scene.ray_epsilon), ls.wi, ls.distance)

    @wp.func
    def onward(scene: Scene, walk: ShadowWalk, w: wp.vec3) -> ShadowWalk:
        o = step_beside(walk.x, walk.ng, w, scene.ray_epsilon)
        return met(scene, o, w, walk.left - wp.dot(o - walk.o, w))

    return start, onward

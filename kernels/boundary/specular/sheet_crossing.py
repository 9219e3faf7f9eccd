"""Where what the light of a point, spot or directional light passes on its way to the end of a chain changes.

Shadow rays pass masks and thin sheets (``kernels/transmittance.py``). So a line crosses a discontinuity where the
surfaces change that a shadow ray meets, not only where light ends.

Derivation: ``docs/theory/boundary.md#shadows-of-masks``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.boundary.shadow_walk import ShadowWalk, make_shadow_walk
from warp_psdr.kernels.boundary.specular.specular_chain import Link
from warp_psdr.kernels.boundary.specular.triangle_borders import Tables, joined
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.emitter.dispatch import make_delta_sample
from warp_psdr.kernels.structs import LightSample, Scene
from warp_psdr.kernels.transmittance import MOST_CROSSINGS
from warp_psdr.kernels.vertex import PathConfig


@wp.struct
class ShadowEnd:
    """Where two neighbouring shadow rays part: the nearer surface that one of them meets."""

    found: wp.int32
    x: wp.vec3  # where its ray starts, on the surface that is lit
    o: wp.vec3  # where it is traced from, at last
    ls: LightSample
    hit: RayHit


@functools.cache
def make_sheet_end(config: PathConfig):
    """Return ``sheet_end(scene, edges, tables, p, q, light) -> ShadowEnd``: of the shadow rays from two points."""
    sample = make_delta_sample(config.lights.others)
    start, onward = make_shadow_walk(config)

    @wp.func
    def met(walk: ShadowWalk) -> Link:
        r = Link()
        r.face = walk.hit.face
        r.x = walk.x
        return r

    @wp.func
    def sheet_end(scene: Scene, edges: Edges, tables: Tables, p: Link, q: Link, light: wp.int32) -> ShadowEnd:
        r = ShadowEnd()
        to_p = sample(scene, scene.emitters[light], p.x, wp.vec2(0.5, 0.5))
        to_q = sample(scene, scene.emitters[light], q.x, wp.vec2(0.5, 0.5))
        a = start(scene, p.x, p.ng, to_p)
        b = start(scene, q.x, q.ng, to_q)
        count = wp.int32(0)
        more = wp.bool(True)
        while more:
            more = a.hit.face >= 0 and b.hit.face >= 0 and count < MOST_CROSSINGS
            if more:
                more = joined(scene, edges, tables, met(a), met(b))
            if more:
                if not a.passes or not b.passes:
                    return r
                count += 1
                a = onward(scene, a, to_p.wi)
                b = onward(scene, b, to_q.wi)
        if a.hit.face < 0 and b.hit.face < 0:
            return r
        r.found = 1
        if a.hit.face >= 0 and (b.hit.face < 0 or a.hit.t <= b.hit.t):
            r.x = p.x
            r.o = a.o
            r.ls = to_p
            r.hit = a.hit
        else:
            r.x = q.x
            r.o = b.o
            r.ls = to_q
            r.hit = b.hit
        return r

    return sheet_end

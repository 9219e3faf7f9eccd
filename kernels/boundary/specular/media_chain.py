"""The radiance that comes by way of a chain of mirrors and glass in media, and of what is scattered on its rays.

A ray of a chain brings what the media on it scatter and emit, and what the mirror or glass at its end sends, with the
transmittance of all of it. So F(q) is the radiance of whole rays, as at edges (``media_radiance.py``): the flights are
those of ``path_media.py``, and a path that collides goes on as any other. Surfaces that are not there are no vertices.

Derivation: ``docs/theory/media.md#mirrors-and-glass-beside-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.specular.specular_chain import (
    MEETS_DEAD,
    MEETS_DELTA,
    Block,
    goes_on,
    make_chain_depth,
    make_intersect_link,
    make_start,
)
from warp_psdr.kernels.constants import FAR, LOBE_NULL, LOBE_SMOOTH
from warp_psdr.kernels.medium.null_surface import make_null_surface
from warp_psdr.kernels.medium.passage import is_lost, medium_towards
from warp_psdr.kernels.path_media import MediaVertex, make_media_step, media_path_from, radiance_of_step
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, path_from


@functools.cache
def make_follow_media_chain(config: PathConfig):
    """Return ``follow_chain`` in media (``specular_chain.make_follow_chain``)."""
    start_at = make_start(config.camera)
    intersect_link = make_intersect_link(config)
    chain_depth, behind = make_chain_depth(config.media is not None)
    media_step = make_media_step(config, False)
    is_interface, _past = make_null_surface(config.surfaces, config.lights)

    @wp.func
    def follow_chain(
        scene: Scene,
        camera: Camera,
        block: Block,
        s: wp.float32,
        sampler: Sampler,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> wp.vec3:
        ray = start_at(scene, camera, block, s)
        medium = block.medium
        if block.shape >= 0:
            medium = medium_towards(scene, block.shape, block.n, block.arrives, ray.d, medium)
        state = media_path_from(path_from(ray.o, ray.d, ray.t_max, block.depth), medium)
        total = wp.vec3(0.0, 0.0, 0.0)
        i = wp.int32(0)
        chained = wp.bool(True)
        while chained:
            path = state.path
            most = chain_depth(block, i, max_depth)
            link = intersect_link(scene, path.o, path.d, path.t_max, path.depth, goes_on(block, i), most)
            # ---- Up to what the ray meets, through surfaces that are not there ----
            before = state
            step = MediaVertex()
            flies = wp.bool(True)
            while flies:
                before = state
                step, state = media_step(scene, sampler, before, max_depth, rr_depth)
                flies = wp.bool(False)
                if state.path.alive == 1 and not step.collides:
                    flies = step.surface.lobe == LOBE_NULL and is_interface(scene, step.surface.face)
                if flies:
                    total += radiance_of_step(step)
            # ---- What it sends ----
            chained = wp.bool(False)
            if step.collides or step.surface.face != link.face:
                # It collides, or is lost at the border of a medium.
                total += radiance_of_step(step)
            elif link.kind == MEETS_DELTA or link.kind == MEETS_DEAD:
                throughput = step.surface.throughput
                total += wp.cw_mul(step.before, step.emitted) + wp.cw_mul(throughput, link.emitted)
                shape = scene.triangles[link.face].shape
                chained = link.kind == MEETS_DELTA and not is_lost(scene, shape, link.ng, path.d, before.medium)
                medium = medium_towards(scene, shape, link.ng, path.d, link.d, before.medium)
                state = media_path_from(path_from(link.o, link.d, FAR, behind(path.depth, link.lobe)), medium)
                state.path.throughput = wp.cw_mul(throughput, link.weight)
                state.path.eta = path.eta
                state.path.alive = wp.where(chained, 1, 0)
                state.steps = before.steps + 1
                state.crossings = before.crossings
                i += 1
            else:
                sent = wp.cw_mul(step.surface.throughput, step.surface.direct)
                total += wp.cw_mul(step.before, step.emitted) + wp.cw_mul(link.weight, sent)
                state.path.throughput = wp.cw_mul(state.path.throughput, link.weight)
                if link.lobe == LOBE_SMOOTH and step.surface.lobe > LOBE_SMOOTH:
                    state.path.alive = 0
        while state.path.alive == 1:
            step, state = media_step(scene, sampler, state, max_depth, rr_depth)
            total += radiance_of_step(step)
        return total

    return follow_chain

"""The lobes by which a path vertex weighs edges: about its scattering or phase function, and about a light point.

The light point is drawn as for next-event estimation. It is an auxiliary variable: for any light point, the mixture of
lobes is positive wherever light is scattered.

Derivation: ``docs/theory/edge_sampling.md#edges-as-a-path-vertex-sees-them``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.edge_sampling.ltc_line import Lobe, Lobes, make_lobe, make_scattering_lobes
from warp_psdr.kernels.constants import PI
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.scattering import make_light_sampler
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import LightConfig, SurfaceConfig

#: Share of the light's lobe in the mixture: half [LADL18], more where only a light itself can be the background.
LIGHT_SHARE, LIGHT_SHARE_LAST = 0.5, 0.8
#: Roughness up to which the scattering lobe is left alone [LADL18].
GLOSSY = 0.1
#: Narrowest and widest lobe (slope) about a light point.
MIN_LIGHT_SCALE, MAX_LIGHT_SCALE = 0.01, 1.0


@functools.cache
def make_vertex_lobes(surfaces: SurfaceConfig, lights: LightConfig):
    """Return ``(surface_lobes, volume_lobes)``.

    ``surface_lobes(scene, at, u4, last) -> Lobes`` of an interaction, ``volume_lobes(scene, x, u4, last) -> Lobes`` of
    a point in a medium. ``u4`` draws the light, ``last``: only a light may follow.
    """
    interaction = make_interaction(surfaces, lights)
    record, slopes = interaction.record, interaction.bsdf.slopes
    scattering_lobes = make_scattering_lobes(surfaces, lights) if interaction.eval is not None else None
    sample_light = make_light_sampler(lights) if lights.area or lights.others else None

    @wp.func
    def light_lobe(scene: Scene, x: wp.vec3, u4: wp.vec4, last: wp.bool) -> Lobe:
        """About a light point; its share is 0 if it is none that a path meets."""
        r = Lobe()
        if wp.static(sample_light is not None):
            ls, _index, _probability = sample_light(scene, x, u4)
            if ls.pdf > 0.0 and ls.delta == 0:
                share = wp.where(last, LIGHT_SHARE_LAST, LIGHT_SHARE)
                scale = wp.clamp(wp.sqrt(1.0 / (PI * ls.pdf)), MIN_LIGHT_SCALE, MAX_LIGHT_SCALE)
                r = make_lobe(ls.wi, any_tangent(ls.wi), scale, scale, share)
        return r

    @wp.func
    def volume_lobes(scene: Scene, x: wp.vec3, u4: wp.vec4, last: wp.bool) -> Lobes:
        r = Lobes()
        r.light = light_lobe(scene, x, u4, last)
        r.sphere = 1.0 - r.light.share
        return r

    if interaction.eval is None:
        return None, volume_lobes

    @wp.func
    def surface_lobes(scene: Scene, at: record, u4: wp.vec4, last: wp.bool) -> Lobes:
        r = scattering_lobes(at)
        if wp.static(slopes is not None):
            slope = slopes(at.model, at.material)
            if wp.min(slope[0], slope[1]) <= GLOSSY and wp.max(slope[0], slope[1]) > 0.0:
                return r
        light = light_lobe(scene, at.x, u4, last)
        if light.share > 0.0 and wp.dot(light.z, r.cosine.z) > 0.0:
            r.cosine.share = (1.0 - light.share) * r.cosine.share
            r.glossy.share = (1.0 - light.share) * r.glossy.share
            r.light = light
        return r

    return surface_lobes, volume_lobes

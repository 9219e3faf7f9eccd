"""Shadow rays in scenes with media: the transmittance of the media and of the surfaces that let light pass.

Interfaces (Mitsuba's ``null``) change the medium and nothing else. Mitsuba's rule gives the medium that a ray enters:
that of the side, inside or outside, of the shape that it crosses.

Derivation: ``docs/theory/media.md#next-event-estimation``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.dispatch import has_null_lobes, models_of
from warp_psdr.kernels.bsdf.null import NULL
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import LOBE_NULL, NO_INTERFACE, PHASE_SGGX
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.medium.coefficients import coefficients_of, exp_minus
from warp_psdr.kernels.medium.flight import mean_of
from warp_psdr.kernels.medium.null_surface import make_null_surface
from warp_psdr.kernels.medium.tracking import make_tracking
from warp_psdr.kernels.medium.volume import GRID
from warp_psdr.kernels.phase.sggx import make_flake_length
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.transmittance import Passage, passage_behind, transmittance_of
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Surfaces without a change of direction that a path, or a shadow ray, crosses at most. What is behind is dark, and
#: that is counted.
MOST_INTERFACES = 64


def steps_kept(block: int) -> int:
    """Return how many steps are kept for a block of vertices: most paths cross fewer interfaces than the rest."""
    return 2 * block + 4


@wp.func
def medium_towards(scene: Scene, shape: wp.int32, ng: wp.vec3, d: wp.vec3, w: wp.vec3, medium: wp.int32) -> wp.int32:
    """The medium of a ray that leaves a shape along w, where one arrived along d in a medium.

    On the side that it came from it is still there. A shape that bounds no medium changes none.
    """
    sides = scene.media.sides[shape]
    beyond = wp.where(wp.dot(ng, w) > 0.0, sides[0], sides[1])
    stays = sides[0] == NO_INTERFACE or wp.dot(ng, d) * wp.dot(ng, w) <= 0.0
    return wp.where(stays, medium, beyond)


@wp.func
def is_lost(scene: Scene, shape: wp.int32, ng: wp.vec3, d: wp.vec3, medium: wp.int32) -> wp.bool:
    """Whether a shape has another medium on the side that a ray along d in a medium arrives at."""
    sides = scene.media.sides[shape]
    return sides[0] != NO_INTERFACE and medium != wp.where(wp.dot(ng, d) > 0.0, sides[1], sides[0])


@functools.cache
def make_media_passage(config: PathConfig, differential: bool):
    """Return ``media_passage(scene, o, d, t_max, medium, draws, sampler, step) -> (Passage, RayHit)`` of a segment.

    The hit is the first surface on the segment, if any. ``probability`` of the passage is that of a path which drew the
    same direction and passed all of it; ``draws``: it would collide there at random (``Flight``), grids aside.
    ``sampler`` and the number of the ``step`` say which numbers estimate the transmittance of grids. ``differential``:
    keep going where the transmittance is exactly zero.
    """
    assert config.media is not None
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    bsdf = interaction.bsdf
    is_interface, past = make_null_surface(config.surfaces, config.lights)
    chromatic = config.media.chromatic
    grids = config.media.grids
    flakes = PHASE_SGGX in config.media.phases
    flake_length = make_flake_length(config.media.phases)
    _tracked_flight, tracked_transmittance = make_tracking(config.media, False)

    @wp.func
    def fly(
        scene: Scene,
        passage: Passage,
        medium: wp.int32,
        o: wp.vec3,
        d: wp.vec3,
        length: wp.float32,
        draws: wp.bool,
        sampler: Sampler,
        step: wp.int32,
    ) -> Passage:
        r = passage
        if wp.static(grids):
            if medium >= 0:
                m = scene.media.records[medium]
                if m.sigma_t_channels == GRID:
                    number = (MOST_INTERFACES + 1) * step + r.crossings
                    r.product = wp.cw_mul(r.product, tracked_transmittance(scene, m, o, d, length, sampler, number))
                    return r
        if medium >= 0:
            optical = length
            if wp.static(flakes):
                optical = flake_length(scene, scene.media.records[medium], d, length)
            passed = exp_minus(coefficients_of(scene, scene.media.records[medium]).sigma_t, optical)
            r.product = wp.cw_mul(r.product, passed)
            if draws:
                if wp.static(chromatic):
                    r.probability *= mean_of(passed)
                else:
                    r.probability *= passed[0]
        return r

    if not has_null_lobes(config.surfaces.bsdfs):

        @wp.func
        def media_segment(
            scene: Scene,
            o: wp.vec3,
            d: wp.vec3,
            t_max: wp.float32,
            medium: wp.int32,
            draws: wp.bool,
            sampler: Sampler,
            step: wp.int32,
        ) -> tuple[Passage, RayHit]:
            r = Passage()
            none = RayHit()
            none.face = -1
            none.t = t_max
            r.product = wp.vec3(1.0, 1.0, 1.0)
            r.probability = 1.0
            if visibility.occluded(scene, o, d, t_max):
                r.blocked = 1
            else:
                r = fly(scene, r, medium, o, d, t_max, draws, sampler, step)
            return r, none

        return media_segment

    # Masks and thin glass, which have a weight; unless they are vertices, which block.
    weighs = config.through and any(model.has_null and model is not NULL for model in models_of(config.surfaces.bsdfs))

    @wp.func
    def media_passage(
        scene: Scene,
        o: wp.vec3,
        d: wp.vec3,
        t_max: wp.float32,
        medium: wp.int32,
        draws: wp.bool,
        sampler: Sampler,
        step: wp.int32,
    ) -> tuple[Passage, RayHit]:
        r = Passage()
        first = RayHit()
        r.product = wp.vec3(1.0, 1.0, 1.0)
        r.probability = 1.0
        start = o
        inside = medium
        more = wp.bool(True)
        while more:
            rest = t_max - wp.dot(start - o, d)
            hit = visibility.closest(scene, start, d, rest)
            if r.crossings == 0:
                first = hit
            if hit.face < 0:
                r = fly(scene, r, inside, start, d, rest, draws, sampler, step)
                more = False
            elif is_interface(scene, hit.face):
                met = past(scene, hit.face, hit.u, hit.v, d)
                if is_lost(scene, met.shape, met.ng, d, inside) or r.crossings == MOST_INTERFACES:
                    r.blocked = 2
                    more = False
                else:
                    r = fly(scene, r, inside, start, d, hit.t, draws, sampler, step)
                    inside = medium_towards(scene, met.shape, met.ng, d, d, inside)
                    r.crossings += 1
                    start = met.o
                    if wp.static(not differential):
                        if vanishes(transmittance_of(r)):
                            r.blocked = 1
                            more = False
            elif wp.static(not weighs):
                r.blocked = 1
                more = False
            else:
                at = interaction.at(scene, hit.face, hit.u, hit.v, d)
                passes = bsdf.has_null(at.model)
                lost = is_lost(scene, at.shape, at.ng, d, inside)
                if passes and not lost and r.crossings < MOST_INTERFACES:
                    r = fly(scene, r, inside, start, d, hit.t, draws, sampler, step)
                    inside = medium_towards(scene, at.shape, at.ng, d, d, inside)
                    value = interaction.scatter(at, LOBE_NULL).value
                    r = passage_behind(r, value, bsdf.probability(at.model, at.material, at.wi, LOBE_NULL))
                    start = interaction.offset(at, d)
                    if wp.static(not differential):
                        if vanishes(transmittance_of(r)):
                            r.blocked = 1
                            more = False
                else:
                    r.blocked = wp.where(passes, 2, 1)
                    more = False
        return r, first

    return media_passage

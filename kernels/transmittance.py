"""Shadow rays through surfaces that let light pass without turning it: masks, thin glass, and ``null``.

The transmittance of a segment is the product of the null lobes' weights on its way, T = prod T_i; a surface without a
null lobe blocks it. A path that drew the same direction finds the same light with the density p prod P_i, with the
probability P_i of the null lobe. Both techniques of multiple importance sampling use that density, and measure
distances from where the direction was drawn. A crossing counts as a path vertex.

Derivation: ``docs/theory/interior.md#null-lobes``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import LOBE_NULL
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Surfaces that a shadow ray crosses at most. Behind them it is dark, and that is counted.
MOST_CROSSINGS = 32


@wp.struct
class Passage:
    """What a segment crosses."""

    product: wp.vec3  # of the weights that are not zero
    zeros: wp.vec3  # the number of those that are, in each channel
    probability: wp.float32  # prod P_i
    crossings: wp.int32
    blocked: wp.int32  # 1: by a surface without a null lobe; 2: by one more than may be crossed


@wp.func
def transmittance_of(p: Passage) -> wp.vec3:
    """T."""
    return wp.vec3(
        wp.where(p.zeros[0] == 0.0, p.product[0], 0.0),
        wp.where(p.zeros[1] == 0.0, p.product[1], 0.0),
        wp.where(p.zeros[2] == 0.0, p.product[2], 0.0),
    )


@wp.func
def other_factor(product: wp.float32, zeros: wp.float32, value: wp.float32) -> wp.float32:
    """T / T_i of one channel, also where T_i is zero; ``value`` is T_i."""
    own = wp.where(value == 0.0, 1.0, 0.0)
    return wp.where(zeros == own, product / wp.where(value == 0.0, 1.0, value), 0.0)


@wp.func
def other_factors(p: Passage, value: wp.vec3) -> wp.vec3:
    """T / T_i, the product of all factors but one."""
    return wp.vec3(
        other_factor(p.product[0], p.zeros[0], value[0]),
        other_factor(p.product[1], p.zeros[1], value[1]),
        other_factor(p.product[2], p.zeros[2], value[2]),
    )


@wp.func
def passage_behind(passage: Passage, value: wp.vec3, probability: wp.float32) -> Passage:
    """The passage behind one more surface, whose null lobe has this weight and probability."""
    r = passage
    for c in range(3):
        zero = value[c] == 0.0
        r.product[c] = r.product[c] * wp.where(zero, 1.0, value[c])
        r.zeros[c] = r.zeros[c] + wp.where(zero, 1.0, 0.0)
    r.probability *= probability
    r.crossings += 1
    return r


@wp.func
def most_crossings(depth: wp.int32, max_depth: wp.int32) -> wp.int32:
    """Surfaces that the shadow ray of the vertex behind ``depth`` others may cross: they and the light are vertices."""
    return wp.where(max_depth < 0, MOST_CROSSINGS, wp.min(MOST_CROSSINGS, max_depth - 2 - depth))


@functools.cache
def make_passage(config: PathConfig, differential: bool):
    """Return ``passage(scene, o, d, t_max, most) -> Passage`` for a segment; ``most``: ``most_crossings``.

    ``differential``: keep going where the transmittance is exactly zero, since its derivative may not be.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    bsdf = interaction.bsdf

    @wp.func
    def passage(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32, most: wp.int32) -> Passage:
        r = Passage()
        r.product = wp.vec3(1.0, 1.0, 1.0)
        r.probability = 1.0
        start = o
        more = wp.bool(True)
        while more:
            hit = visibility.closest(scene, start, d, t_max - wp.dot(start - o, d))
            more = hit.face >= 0
            if more:
                at = interaction.at(scene, hit.face, hit.u, hit.v, d)
                passes = bsdf.has_null(at.model)
                if passes and r.crossings < most:
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
        return r

    return passage

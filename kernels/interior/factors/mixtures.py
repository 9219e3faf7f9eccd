"""Decomposed branches of mixtures: the derivative by a weight, from the two ends of its range [BXB*24, section 4.3].

A value that is linear in its weight w, f = (1 - w) f_0 + w f_1, has the derivative f_1 - f_0. The model's own sampler,
with the weight at either end, draws a direction from each of the two, and both are traced with equal random numbers.
Multiple importance sampling uses the image's density, at the actual weight.

Derivation: ``docs/theory/interior.md#weights-of-mixtures``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.dispatch import make_bsdf, models_of
from warp_psdr.kernels.bsdf.record import merge_values
from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.generated import make_generated
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.branch_point import DIRECTION_SLOT, NO_ROULETTE, VERTEX_SLOT, BranchPoint
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.rng import Sampler, hashed, make_sampler, unit_float
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig, SurfaceConfig

#: Slot of the number that chooses a weight where several move at once.
WEIGHT_SLOT = VERTEX_SLOT - 3


def mixed_values(surfaces: SurfaceConfig, wanted: GradientRequest) -> list[str]:
    """Return the names of the requested values that weigh lobes, of any model of a scene."""
    names = {name for model in models_of(surfaces.bsdfs) for name in model.mixes}
    return [s.name for s, w in zip(surfaces.material, wanted.material, strict=True) if w and s.name in names]


@functools.cache
def make_mixture(
    surfaces: SurfaceConfig, wanted: GradientRequest
) -> tuple[wp.Function, wp.Function, wp.Function, wp.Function]:
    """Return functions over the weights that ``wanted`` holds, of a direction in which a material moves.

    ``count(direction) -> int32``: how many of them move; ``rate(direction, number) -> float32``: of one, its velocity
    over the length of its range; ``end(material, direction, number, upper) -> record``: the material with that one at
    an end of its range; ``member(direction, number, x) -> record``: ``x`` at that one.
    """
    record = make_bsdf(surfaces.bsdfs).record
    bounds = {value.name: (value.low, value.high) for value in merge_values(models_of(surfaces.bsdfs))}
    names = mixed_values(surfaces, wanted)

    def function(head: str, before: list[str], of_one: str, after: str) -> wp.Function:
        lines = [head, *(f"    {line}" for line in before), "    n = wp.int32(0)"]
        for name in names:
            low, high = bounds[name]
            lines += [f"    if direction.{name} != 0.0:"]
            if of_one:
                lines += ["        if n == number:", f"            {of_one.format(name=name, low=low, high=high)}"]
            lines += ["        n += 1"]
        return make_generated("\n".join([*lines, f"    return {after}", ""]), record=record)

    count = function("def mixture_count(direction: record) -> wp.int32:", [], "", "n")
    rate = function(
        "def mixture_rate(direction: record, number: wp.int32) -> wp.float32:",
        ["r = wp.float32(0.0)"],
        "r = direction.{name} / ({high} - {low})",
        "r",
    )
    end = function(
        "def mixture_end(material: record, direction: record, number: wp.int32, upper: wp.bool) -> record:",
        ["m = material"],
        "m.{name} = wp.where(upper, {high}, {low})",
        "m",
    )
    member = function(
        "def mixture_member(direction: record, number: wp.int32, x: wp.float32) -> record:",
        ["m = record()"],
        "m.{name} = x / ({high} - {low})",
        "m",
    )
    return count, rate, end, member


def make_mixture_directions(
    config: PathConfig, wanted: GradientRequest, role: str, path_radiance: wp.Function, scatter: wp.Function
) -> wp.Function:
    """Return ``from_directions`` of ``branch.py`` for vertices whose branched values are weights."""
    interaction = make_interaction(config.surfaces, config.lights)
    record, material_record = interaction.record, interaction.bsdf.record
    count_of, rate_of, end_of, member_of = make_mixture(config.surfaces, wanted)
    sample_4d = make_sampler(config.sampler).sample_4d
    forward = role == "forward"

    @wp.func
    def from_ends(
        scene: Scene,
        branch: Sampler,
        at: record,
        point: BranchPoint,
        direction: material_record,
        moved: material_record,
        a_n: wp.vec3,
        u: wp.vec2,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        t: wp.array(dtype=wp.float32),
    ) -> tuple[material_record, wp.vec3]:
        """dbeta_n L_{n+1}, of a direction from each end; ``a_n``: adjoint of what leaves the vertex."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r4 = sample_4d(branch, DIRECTION_SLOT)
        count = count_of(direction)
        choice = unit_float(hashed(branch, WEIGHT_SLOT).x)
        number = wp.min(wp.int32(choice * wp.float32(count)), count - 1)
        found = wp.vec3(0.0, 0.0, 0.0)
        end = wp.int32(0)
        while end < 2:
            upper = end == 1
            end += 1
            there = at
            there.material = end_of(at.material, direction, number, upper)
            goes_on = scatter(there, point.state, point.face, r4, NO_ROULETTE)
            state = goes_on.after
            if goes_on.lobe == LOBE_SMOOTH:
                state.pdf = interaction.pdf(at, enter_frame(at.frame, goes_on.wo))
                if state.pdf <= 0.0:
                    state.alive = 0
            if state.alive == 1:
                radiance = path_radiance(scene, branch, state, max_depth, rr_depth)
                found += wp.where(upper, 1.0, -1.0) * wp.cw_mul(goes_on.beta, radiance)
        found = wp.float32(count) * wp.cw_mul(a_n, found)
        if wp.static(forward):
            return material_record(), rate_of(direction, number) * found
        else:
            return member_of(direction, number, found[0] + found[1] + found[2]), found

    return from_ends

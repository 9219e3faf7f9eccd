"""Decomposed branches by numbers whose derivative is the sum of two lobes of one sign each [BXB*24].

A, B and C of ``abc`` scale a density of normals or turn it into another one of a single sign. sigma of ``orennayar``
has one term that falls and one that grows. A direction is drawn from each of the two lobes, in proportion to the
derivative, and both are traced.

Derivation: ``docs/theory/interior.md#lobes-of-one-sign``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.dispatch import make_bsdf, models_of
from warp_psdr.kernels.generated import make_generated
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.interior.factors.branch_point import (
    DIRECTION_SLOT,
    VERTEX_SLOT,
    BranchPoint,
    make_onward_radiance,
)
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.rng import Sampler, hashed, make_sampler, unit_float
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig, SurfaceConfig

#: Slot of the number that chooses a value where several move at once.
NUMBER_SLOT = VERTEX_SLOT - 4


def signed_values(surfaces: SurfaceConfig, wanted: GradientRequest) -> list[str]:
    """Return the names of the requested values whose derivative is lobes of one sign, of any model of a scene."""
    names = {name for model in models_of(surfaces.bsdfs) for name in model.signed}
    return [s.name for s, w in zip(surfaces.material, wanted.material, strict=True) if w and s.name in names]


@functools.cache
def make_signed_numbers(
    surfaces: SurfaceConfig, wanted: GradientRequest
) -> tuple[wp.Function, wp.Function, wp.Function, wp.Function]:
    """Return functions over the values that ``wanted`` holds, of a direction in which a material moves.

    ``count(model, direction) -> int32``: how many of them move; ``number(model, direction, n) -> int32``: the place of
    the n-th in ``Model.signed``; ``rate(model, direction, number) -> float32``: its velocity;
    ``member(model, number, x) -> record``: ``x`` at that one.
    """
    record = make_bsdf(surfaces.bsdfs).record
    names = signed_values(surfaces, wanted)
    count = ["def signed_count(model: wp.int32, direction: record) -> wp.int32:", "    n = wp.int32(0)"]
    number = ["def signed_number(model: wp.int32, direction: record, n: wp.int32) -> wp.int32:"]
    number += ["    left = n", "    found = wp.int32(-1)"]
    rate = ["def signed_rate(model: wp.int32, direction: record, number: wp.int32) -> wp.float32:"]
    rate += ["    r = wp.float32(0.0)"]
    member = ["def signed_member(model: wp.int32, number: wp.int32, x: wp.float32) -> record:", "    m = record()"]
    for place, model in enumerate(models_of(surfaces.bsdfs)):
        for k, name in enumerate(model.signed):
            if name in names:
                moves = f"    if model == {place} and direction.{name} != 0.0:"
                own = f"    if model == {place} and number == {k}:"
                count += [moves, "        n += 1"]
                number += [moves, "        if left == 0:", f"            found = {k}", "        left -= 1"]
                rate += [own, f"        r = direction.{name}"]
                member += [own, f"        m.{name} = x"]
    functions = ((count, "n"), (number, "found"), (rate, "r"), (member, "m"))
    made = [make_generated("\n".join([*lines, f"    return {r}", ""]), record=record) for lines, r in functions]
    return made[0], made[1], made[2], made[3]


def make_signed_directions(
    config: PathConfig, wanted: GradientRequest, role: str, path_radiance: wp.Function
) -> wp.Function:
    """Return ``from_directions`` of ``branch.py`` for vertices whose branched values have lobes of one sign."""
    interaction = make_interaction(config.surfaces, config.lights)
    record, material_record = interaction.record, interaction.bsdf.record
    draw, weight_of = interaction.bsdf.signed
    count_of, number_of, rate_of, member_of = make_signed_numbers(config.surfaces, wanted)
    onward_radiance = make_onward_radiance(interaction, path_radiance)
    sample_4d = make_sampler(config.sampler).sample_4d
    forward = role == "forward"

    @wp.func
    def from_signed(
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
        """dbeta_n L_{n+1}, of a direction from each lobe; ``a_n``: adjoint of what leaves the vertex."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r4 = sample_4d(branch, DIRECTION_SLOT)
        count = count_of(at.model, direction)
        choice = unit_float(hashed(branch, NUMBER_SLOT).x)
        number = number_of(at.model, direction, wp.min(wp.int32(choice * wp.float32(count)), count - 1))
        found = wp.vec3(0.0, 0.0, 0.0)
        lobe = wp.int32(0)
        while lobe < 2:
            second = lobe == 1
            lobe += 1
            wo = draw(at.model, at.material, at.wi, number, second, wp.vec2(r4[2], r4[3]))
            pdf = interaction.pdf(at, wo)
            if pdf > 0.0:
                radiance = onward_radiance(scene, branch, at, point, wo, pdf, max_depth, rr_depth)
                found += wp.cw_mul(weight_of(at.model, at.material, at.wi, wo, number, second), radiance)
        found = wp.float32(count) * wp.cw_mul(a_n, found)
        if wp.static(forward):
            return material_record(), rate_of(at.model, direction, number) * found
        else:
            return member_of(at.model, number, found[0] + found[1] + found[2]), found

    return from_signed

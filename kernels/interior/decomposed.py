"""Decomposed branches: the derivative of a microfacet lobe by its roughness, drawn by its sign [BXB*24].

    df = f_D d(log D) + (df - f_D d(log D)),    f_D the part that is proportional to D.

The first part is positive outside and negative in the middle (the reverse for an exponent). A direction is drawn from
each of the two, with densities proportional to the derivative of D cos (``bsdf/decomposition.py``), and both are
traced. The model's own sampler draws for the second part, which masking causes; models without masking have none.

Derivation: ``docs/theory/interior.md#decomposed-branches``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.decomposition import ACROSS, ALONG, BOTH
from warp_psdr.kernels.bsdf.dispatch import make_bsdf, models_of
from warp_psdr.kernels.generated import make_generated
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.branch_point import (
    DIRECTION_SLOT,
    NO_ROULETTE,
    VERTEX_SLOT,
    BranchPoint,
    make_onward_radiance,
)
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.mixtures import make_mixture, make_mixture_directions, mixed_values
from warp_psdr.kernels.interior.factors.signed_lobes import make_signed_directions, make_signed_numbers, signed_values
from warp_psdr.kernels.rng import Sampler, hashed, make_sampler, unit_float
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig

#: Slot of the number that chooses an axis where both roughnesses move by themselves.
AXIS_SLOT = VERTEX_SLOT - 2


@wp.struct
class Axis:
    """Which roughness a sample differentiates by."""

    axis: wp.int32
    rate: wp.float32  # its velocity
    weight: wp.float32  # inverse of the probability of the choice


@wp.func
def axis_of(values: wp.vec2, d: wp.vec2, u: wp.float32) -> Axis:
    """Both roughnesses where they are one number, else one of those that move; ``d``: their velocities."""
    a = Axis()
    a.weight = 1.0
    if values[0] == values[1] and d[0] == d[1]:
        a.axis = BOTH
        a.rate = d[0]
    else:
        across = d[0] == 0.0
        if d[0] != 0.0 and d[1] != 0.0:
            across = u < 0.5
            a.weight = 2.0
        a.axis = wp.where(across, ACROSS, ALONG)
        a.rate = wp.where(across, d[1], d[0])
    return a


@functools.cache
def make_split_values(bsdfs: tuple[str, ...]) -> tuple[wp.Function, wp.Function]:
    """Return functions of the two values of a scene's models that are split (``Model.splits``).

    ``split_values(model, m: record) -> vec2``; ``split_record(model, u, v) -> record``: one that holds them alone.
    """
    record = make_bsdf(bsdfs).record
    get = ["def split_values(model: wp.int32, m: record) -> wp.vec2:", "    x = wp.vec2(0.0, 0.0)"]
    put = ["def split_record(model: wp.int32, u: wp.float32, v: wp.float32) -> record:", "    m = record()"]
    for number, model in enumerate(models_of(bsdfs)):
        if model.splits:
            along, across = model.splits
            get += [f"    if model == {number}:", f"        x = wp.vec2(m.{along}, m.{across})"]
            put += [f"    if model == {number}:", f"        m.{along} = u", f"        m.{across} = v"]
    return (
        make_generated("\n".join([*get, "    return x", ""]), record=record),
        make_generated("\n".join([*put, "    return m", ""]), record=record),
    )


def make_decomposed_directions(
    config: PathConfig,
    wanted: GradientRequest,
    role: str,
    path_radiance: wp.Function,
    scatter: wp.Function,
    partial: wp.Function,
) -> wp.Function:
    """Return ``from_directions`` of ``branch.py``.

    A vertex has weights of mixtures, numbers with lobes of one sign, or roughnesses that are split.
    """
    interaction = make_interaction(config.surfaces, config.lights)
    record, material_record = interaction.record, interaction.bsdf.record
    mixed, signed = mixed_values(config.surfaces, wanted), signed_values(config.surfaces, wanted)
    split = sum(wanted.material) > len(mixed) + len(signed)
    from_ends = make_mixture_directions(config, wanted, role, path_radiance, scatter) if mixed else None
    from_signed = make_signed_directions(config, wanted, role, path_radiance) if signed else None
    from_lobes = make_lobe_directions(config, role, path_radiance, scatter, partial) if split else None
    mixture_count = make_mixture(config.surfaces, wanted)[0] if mixed else None
    signed_count = make_signed_numbers(config.surfaces, wanted)[0] if signed else None

    @wp.func
    def from_any(
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
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        if wp.static(bool(mixed)):
            if mixture_count(direction) > 0:
                return from_ends(scene, branch, at, point, direction, moved, a_n, u, max_depth, rr_depth, t)
        if wp.static(bool(signed)):
            if signed_count(at.model, direction) > 0:
                return from_signed(scene, branch, at, point, direction, moved, a_n, u, max_depth, rr_depth, t)
        if wp.static(split):
            return from_lobes(scene, branch, at, point, direction, moved, a_n, u, max_depth, rr_depth, t)
        return material_record(), wp.vec3(0.0, 0.0, 0.0)

    return from_any


def make_lobe_directions(
    config: PathConfig, role: str, path_radiance: wp.Function, scatter: wp.Function, partial: wp.Function
) -> wp.Function:
    """Return ``from_directions`` of ``branch.py`` for vertices whose branched values are roughnesses that are split."""
    interaction = make_interaction(config.surfaces, config.lights)
    record, bsdf = interaction.record, interaction.bsdf
    material_record, add_materials = bsdf.record, bsdf.algebra.add
    draw, density, value_of, mass, rate = bsdf.split
    masked = bsdf.masked
    split_values, split_record = make_split_values(config.surfaces.bsdfs)
    onward_radiance = make_onward_radiance(interaction, path_radiance)
    sample_4d = make_sampler(config.sampler).sample_4d
    forward = role == "forward"

    @wp.func
    def on_axis(model: wp.int32, axis: wp.int32, x: wp.float32) -> material_record:
        """A record that is ``x`` at the roughness, or both, of an axis."""
        return split_record(model, wp.where(axis == ACROSS, 0.0, x), wp.where(axis == ALONG, 0.0, x))

    @wp.func
    def from_lobes(
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
        """dbeta_n L_{n+1}, of a direction of each sign and one for the rest; ``a_n``: adjoint of what leaves."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r4 = sample_4d(branch, DIRECTION_SLOT)
        material = at.material
        choice = unit_float(hashed(branch, AXIS_SLOT).x)
        axis = axis_of(split_values(at.model, material), split_values(at.model, direction), choice)
        a = axis.weight * a_n
        found = wp.vec3(0.0, 0.0, 0.0)
        sign = wp.int32(0)
        while sign < 2:
            outer = sign == 1
            sign += 1
            wo = draw(at.model, material, at.wi, axis.axis, outer, wp.vec3(r4[2], r4[3], r4[1]))
            pdf = interaction.pdf(at, wo)
            if pdf > 0.0:
                radiance = onward_radiance(scene, branch, at, point, wo, pdf, max_depth, rr_depth)
                # f_D d(log D) over the density |d(D cos)| / (4 wi . h mass).
                weight = mass(at.model, material, axis.axis) / density(at.model, material, at.wi, wo)
                value = wp.cw_mul(value_of(at.model, material, at.wi, wo), radiance)
                found += wp.where(outer, weight, -weight) * wp.cw_mul(a, value)
        # The rest.
        a_material = material_record()
        along = wp.vec3(0.0, 0.0, 0.0)
        if masked(at.model):
            goes_on = scatter(at, point.state, point.face, r4, NO_ROULETTE)
            if goes_on.after.alive == 1:
                wo = enter_frame(at.frame, goes_on.wo)
                radiance = path_radiance(scene, branch, goes_on.after, max_depth, rr_depth)
                w = goes_on.inv_pdf * wp.cw_mul(a, radiance)
                whole, d = partial(at, goes_on.lobe, wo, w, on_axis(at.model, axis.axis, axis.rate))
                value = value_of(at.model, material, at.wi, wo)
                found -= rate(at.model, material, at.wi, wo, axis.axis) * wp.cw_mul(w, value)
                a_material = whole
                along = d
        if wp.static(forward):
            return a_material, along + axis.rate * found
        else:
            # Both are one number, which collects the two.
            share = wp.where(axis.axis == BOTH, 0.5, 1.0) * (found[0] + found[1] + found[2])
            return add_materials(a_material, on_axis(at.model, axis.axis, share)), found

    return from_lobes

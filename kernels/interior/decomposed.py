"""Decomposed branches: the derivative of a microfacet lobe by its roughness, drawn by its sign [BXB*24].

    df = f d(log D) + (df - f d(log D)):

the first part is positive outside and negative in the middle. A direction is drawn from each of the two, with densities
that are proportional to the derivative of D cos (``bsdf/decomposition.py``), and both are traced. The second part, by
masking, is drawn by the model's own sampler.

Derivation: ``docs/theory/interior.md#decomposed-branches``.
"""

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.decomposition import ACROSS, ALONG, BOTH
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.interaction import enter_frame, leave_frame, make_interaction
from warp_psdr.kernels.interior.branch_point import DIRECTION_SLOT, NO_ROULETTE, VERTEX_SLOT, BranchPoint
from warp_psdr.kernels.interior.gradient_request import GradientRequest
from warp_psdr.kernels.interior.mixtures import make_mixture, make_mixture_directions, mixed_values
from warp_psdr.kernels.rng import Sampler, hashed, make_sampler, unit_float
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig, path_from

#: Slot of the number that chooses an axis where both roughnesses move by themselves.
AXIS_SLOT = VERTEX_SLOT - 2


@wp.struct
class Axis:
    """Which roughness a sample differentiates by."""

    axis: wp.int32
    rate: wp.float32  # its velocity
    weight: wp.float32  # inverse of the probability of the choice


@wp.func
def axis_of(alpha_u: wp.float32, alpha_v: wp.float32, du: wp.float32, dv: wp.float32, u: wp.float32) -> Axis:
    """Both roughnesses where they are one number, else one of those that move."""
    a = Axis()
    a.weight = 1.0
    if alpha_u == alpha_v and du == dv:
        a.axis = BOTH
        a.rate = du
    else:
        across = du == 0.0
        if du != 0.0 and dv != 0.0:
            across = u < 0.5
            a.weight = 2.0
        a.axis = wp.where(across, ACROSS, ALONG)
        a.rate = wp.where(across, dv, du)
    return a


def make_decomposed_directions(
    config: PathConfig,
    wanted: GradientRequest,
    role: str,
    path_radiance: wp.Function,
    scatter: wp.Function,
    partial: wp.Function,
) -> wp.Function:
    """Return ``from_directions`` of ``branch.py``: a vertex has roughnesses that are split, or weights of mixtures."""
    mixed = mixed_values(config, wanted)
    if not mixed:
        return make_lobe_directions(config, role, path_radiance, scatter, partial)
    from_ends = make_mixture_directions(config, wanted, role, path_radiance, scatter)
    if sum(wanted.material) == len(mixed):
        return from_ends
    from_lobes = make_lobe_directions(config, role, path_radiance, scatter, partial)
    interaction = make_interaction(config)
    record, material_record = interaction.record, interaction.bsdf.record
    count_of = make_mixture(config, wanted)[0]

    @wp.func
    def from_either(
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
        if count_of(direction) > 0:
            return from_ends(scene, branch, at, point, direction, moved, a_n, u, max_depth, rr_depth, t)
        return from_lobes(scene, branch, at, point, direction, moved, a_n, u, max_depth, rr_depth, t)

    return from_either


def make_lobe_directions(
    config: PathConfig, role: str, path_radiance: wp.Function, scatter: wp.Function, partial: wp.Function
) -> wp.Function:
    """Return ``from_directions`` of ``branch.py`` for vertices whose branched values are roughnesses that are split."""
    interaction = make_interaction(config)
    record, bsdf = interaction.record, interaction.bsdf
    material_record, add_materials = bsdf.record, bsdf.algebra.add
    draw, density, mass, rate = bsdf.split
    sample_4d = make_sampler(config.sampler).sample_4d
    forward = role == "forward"

    @wp.func
    def on_axis(axis: wp.int32, x: wp.float32) -> material_record:
        """A record that is ``x`` at the roughness, or both, of an axis."""
        m = material_record()
        m.alpha_u = wp.where(axis == ACROSS, 0.0, x)
        m.alpha_v = wp.where(axis == ALONG, 0.0, x)
        return m

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
        axis = axis_of(material.alpha_u, material.alpha_v, direction.alpha_u, direction.alpha_v, choice)
        a = axis.weight * a_n
        found = wp.vec3(0.0, 0.0, 0.0)
        sign = wp.int32(0)
        while sign < 2:
            outer = sign == 1
            sign += 1
            wo = draw(at.model, material, at.wi, axis.axis, outer, wp.vec3(r4[2], r4[3], r4[1]))
            pdf = interaction.pdf(at, wo)
            if pdf > 0.0:
                d = leave_frame(at.frame, wo)
                state = path_from(interaction.offset(at, d), d, FAR, point.state.depth + 1)
                state.pdf = pdf
                state.eta = point.state.eta
                state.left_face = point.face + 1
                radiance = path_radiance(scene, branch, state, max_depth, rr_depth)
                # f d(log D) over the density |d(D cos)| / (4 wi . h mass).
                weight = mass(at.model, material, axis.axis) / density(at.model, material, at.wi, wo)
                value = wp.cw_mul(interaction.eval(at, wo), radiance)
                found += wp.where(outer, weight, -weight) * wp.cw_mul(a, value)
        # The rest.
        a_material = material_record()
        along = wp.vec3(0.0, 0.0, 0.0)
        goes_on = scatter(at, point.state, point.face, r4, NO_ROULETTE)
        if goes_on.after.alive == 1:
            wo = enter_frame(at.frame, goes_on.wo)
            radiance = path_radiance(scene, branch, goes_on.after, max_depth, rr_depth)
            w = goes_on.inv_pdf * wp.cw_mul(a, radiance)
            whole, d = partial(at, goes_on.lobe, wo, w, on_axis(axis.axis, axis.rate))
            found -= rate(at.model, material, at.wi, wo, axis.axis) * wp.cw_mul(w, interaction.eval(at, wo))
            a_material = whole
            along = d
        if wp.static(forward):
            return a_material, along + axis.rate * found
        else:
            # Both are one number, which collects the two.
            share = wp.where(axis.axis == BOTH, 0.5, 1.0) * (found[0] + found[1] + found[2])
            return add_materials(a_material, on_axis(axis.axis, share)), found

    return from_lobes

"""Derivatives in forward mode by numbers of materials, at the vertices of paths side by side.

With A_n' and S, the derivative so far, in the rows of a path, a vertex adds

    S       += A_n' (E_n + D_n) + A_n D_n',        A_{n+1}' = A_n' beta_n + A_n beta_n'.

The derivative of a scattering value along the tangent is found, channel by channel, from the adjoints that reverse mode
finds (``material_sweep.py``), in loops over all lanes. A model is skipped if no lane that stands on it has a tangent
other than 0. Directions and positions do not move: no next vertex is needed, and the places of a step are used before
the next step overwrites them.

Derivation: ``docs/theory/interior.md#forward-mode``.
"""

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.velocities import axis_vec3, make_material_jvp_of_each
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.lanes.lanes import ROWS, stack_rows
from warp_psdr.kernels.lanes.material_sweep import ScatteringWeight
from warp_psdr.kernels.lanes.model_lanes import make_adjoints_of_each, model_bit
from warp_psdr.kernels.lanes.path_lanes import LanePaths
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import LightConfig, SurfaceConfig
from warp_psdr.kernels.vertex_motion import VertexTangent


@wp.struct
class DerivativeCarry:
    """A_n', and the derivative so far."""

    throughput_dot: wp.vec3
    sum_dot: wp.vec3


@wp.struct
class ScatteringWeights:
    """What derivatives of the two scattering values of a vertex are weighted by; 0 where there are none."""

    light: wp.vec3
    onward: wp.vec3


@wp.struct
class Differentiated:
    """Whether a path stands on a material that has a tangent; else the row of the tangent may be anything."""

    on: wp.int32


def make_material_forward(surfaces: SurfaceConfig, lights: LightConfig, wanted: GradientRequest, paths: LanePaths):
    """Return ``(end, begin, differentiate, carries)``, as of ``make_forward_of_each`` (``interior/forward_lanes.py``).

    Args:
        surfaces: what the surfaces need.
        lights: what the lights need.
        wanted: what is differentiated, see ``sweeps_materials``.
        paths: how its paths are traced; of their vertices the radiance is kept.
    """
    width, on_places = paths.width, paths.on_places
    places, choices = on_places.places, on_places.choices
    interaction = make_interaction(surfaces, lights)
    record, dot, rests = interaction.bsdf.record, interaction.bsdf.algebra.dot, interaction.bsdf.algebra.vanishes
    carries, factors, moving, tangents, weights, adjoints = stack_rows(
        width, paths.end, DerivativeCarry, ScatteringWeights, Differentiated, record, ScatteringWeight, record
    )
    add_adjoints = make_adjoints_of_each(surfaces, lights, width, places, weights, adjoints)
    material_jvp = make_material_jvp_of_each(surfaces, wanted)
    scatter_vjp = interaction.scatter_vjp

    @wp.func
    def begin(rows: ROWS):
        j = wp.int32(0)
        while j < width:
            carries.put(rows, j, DerivativeCarry())
            j += 1

    @wp.func
    def weigh(n: wp.int32, rows: ROWS):
        """A_n' (E_n + D_n) and A_n' beta_n, and the weights of D_n' and beta_n'."""
        zero = wp.vec3(0.0, 0.0, 0.0)
        j = wp.int32(0)
        while j < width:
            vertex = paths.vertex(rows, j, n)
            carry = carries.get(rows, j)
            there = n < paths.gathered(rows, j).vertices
            on = there and vertex.face >= 0
            carry.sum_dot += where3(there, wp.cw_mul(carry.throughput_dot, vertex.direct), zero)
            carry.throughput_dot = where3(there, wp.cw_mul(carry.throughput_dot, vertex.beta), zero)
            carries.put(rows, j, carry)
            by_light = vertex.light_weight * wp.cw_mul(vertex.throughput, paths.light(rows, j, n).radiance)
            by_onward = vertex.inv_pdf * vertex.throughput
            factor = ScatteringWeights()
            factor.light = where3(on and vertex.light >= 0, by_light, zero)
            factor.onward = where3(on and vertex.lobe >= LOBE_SMOOTH, by_onward, zero)
            factors.put(rows, j, factor)
            j += 1

    @wp.func
    def move(scene: Scene, target: wp.array(dtype=wp.float32), count: wp.int32, rows: ROWS) -> wp.int32:
        """Tangents of the materials that paths stand on; the bits of the models that have any."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        models = wp.int32(0)
        for j in range(count):
            factor = factors.get(rows, j)
            found = Differentiated()
            if not (vanishes(factor.light) and vanishes(factor.onward)):
                at = places.get(rows, j)
                c = choices.get(rows, j)
                uv = on_places.surfaces.get(rows, j).uv
                tangent = material_jvp(scene, target, at.slots, c.face, c.u, c.v, uv, VertexTangent(), at.model)
                if not rests(tangent):
                    models = models | model_bit(at.model)
                    found.on = 1
                    tangents.put(rows, j, tangent)
            moving.put(rows, j, found)
        return models

    @wp.func
    def weigh_channel(to_light: wp.bool, channel: wp.int32, n: wp.int32, rows: ROWS):
        axis = axis_vec3(channel)
        j = wp.int32(0)
        while j < width:
            vertex = paths.vertex(rows, j, n)
            factor = factors.get(rows, j)
            on = moving.get(rows, j).on == 1 and (to_light or vertex.lobe == LOBE_SMOOTH)
            wo = enter_frame(places.get(rows, j).frame, where3(to_light, vertex.light_wi, vertex.wo))
            weight = ScatteringWeight()
            weight.wo = where3(on, wo, wp.vec3(0.0, 0.0, 1.0))
            w = wp.dot(axis, where3(to_light, factor.light, factor.onward))
            weight.w = wp.where(on, w, 0.0) * axis
            weights.put(rows, j, weight)
            adjoints.put(rows, j, record())
            j += 1

    @wp.func
    def add_channel(to_light: wp.bool, channel: wp.int32, rows: ROWS):
        zero = wp.vec3(0.0, 0.0, 0.0)
        axis = axis_vec3(channel)
        j = wp.int32(0)
        while j < width:
            carry = carries.get(rows, j)
            along = dot(adjoints.get(rows, j), tangents.get(rows, j))
            more = wp.where(moving.get(rows, j).on == 1, along, 0.0) * axis
            carry.sum_dot += where3(to_light, more, zero)
            carry.throughput_dot += where3(to_light, zero, more)
            carries.put(rows, j, carry)
            j += 1

    @wp.func
    def add_delta(count: wp.int32, n: wp.int32, rows: ROWS):
        """beta_n' of delta lobes."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        zero = wp.vec3(0.0, 0.0, 0.0)
        for j in range(count):
            if moving.get(rows, j).on == 1:
                lobe = paths.vertex(rows, j, n).lobe
                if lobe > LOBE_SMOOTH:
                    at = places.get(rows, j)
                    tangent = tangents.get(rows, j)
                    carry = carries.get(rows, j)
                    onward = factors.get(rows, j).onward
                    for channel in range(3):
                        fa = scatter_vjp(at, lobe, onward[channel] * axis_vec3(channel), zero)
                        carry.throughput_dot[channel] += dot(fa.material, tangent)
                    carries.put(rows, j, carry)

    @wp.func
    def differentiate(
        scene: Scene, camera: Camera, target: wp.array(dtype=wp.float32), count: wp.int32, n: wp.int32, rows: ROWS
    ):
        """The n-th vertices, which the paths have just left."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        weigh(n, rows)
        models = move(scene, target, count, rows)
        if models > 0:
            part = wp.int32(0)
            while part < 6:  # one call of what is large
                weigh_channel(part < 3, part % 3, n, rows)
                add_adjoints(models, count, rows)
                add_channel(part < 3, part % 3, rows)
                part += 1
            if wp.static(scatter_vjp is not None):
                add_delta(count, n, rows)

    return adjoints.end, begin, differentiate, carries

"""The derivative of a shadow ray's transmittance: the segment is walked again, dT = sum_i (T / T_i) dT_i.

Where vertices move, the segment is straight between its ends, and its crossings slide over their surfaces: they are
where an attached ray meets these.

Derivation: ``docs/theory/interior.md#null-lobes``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.constants import FAR, LOBE_NULL
from warp_psdr.kernels.emitter.dispatch import is_delta_light, make_delta_sample
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.pullback import make_frame_vjp
from warp_psdr.kernels.interior.factors.sinks import make_material_sink
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.primitive.dispatch import make_adjoint_sink
from warp_psdr.kernels.scattering import shadow_ray
from warp_psdr.kernels.step import step_off_triangle
from warp_psdr.kernels.structs import LightSample, Scene
from warp_psdr.kernels.surface import VertexAdjoint, point_on
from warp_psdr.kernels.transmittance import (
    MOST_CROSSINGS,
    Passage,
    make_passage,
    other_factors,
    transmittance_of,
)
from warp_psdr.kernels.vertex import PathConfig, PathVertex
from warp_psdr.kernels.visibility import visibility_of


@wp.struct
class LightSegment:
    """The free segment from a vertex to the light that next-event estimation found, and what it crosses."""

    o: wp.vec3
    d: wp.vec3
    transmittance: wp.vec3
    passage: Passage


@wp.struct
class CrossedAdjoint:
    """The adjoints of a segment's start and of its direction, and what the sinks returned."""

    o: wp.vec3
    d: wp.vec3
    dot: wp.float32


class TransmittanceSink(NamedTuple):
    """Functions of the segment to a vertex's light; ``at`` is the interaction at the vertex.

    Attributes:
        segment: ``(scene, at, vertex) -> LightSegment``.
        accumulate: ``(scene, target, segment, w) -> CrossedAdjoint`` scatters ``w``, the adjoint of the transmittance.
    """

    segment: wp.Function
    accumulate: wp.Function


@functools.cache
def make_transmittance_sink(config: PathConfig, wanted: GradientRequest, role: str) -> TransmittanceSink:
    """Return the functions; arguments as ``make_sweep``'s."""
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    record = interaction.record
    passage = make_passage(config, True)
    delta_sample = make_delta_sample(config.lights.others)
    accumulate_material = make_material_sink(config.surfaces, wanted, role)
    moves = wanted.geometry
    frame_vjp = make_frame_vjp(config.surfaces.tangent)
    accumulate_vertex = None
    if moves:
        accumulate_vertex = make_adjoint_sink(
            role,
            config.surfaces.smooth,
            config.surfaces.flat,
            config.surfaces.uv,
            config.surfaces.tangent,
            wanted.texcoords,
            True,
            config.surfaces.primitives,
        )

    @wp.func
    def segment_to_light(scene: Scene, at: record, vertex: PathVertex) -> LightSegment:
        r = LightSegment()
        ls = LightSample()
        ls.wi = vertex.light_wi
        ls.face = vertex.light_face
        ls.distance = FAR
        emitter = scene.emitters[vertex.light]
        if vertex.light_face >= 0:
            tri = scene.triangles[vertex.light_face]
            ls.target = point_on(tri, vertex.light_u, vertex.light_v) + step_off_triangle(scene, tri) * tri.normal
        else:
            if wp.static(delta_sample is not None):
                if is_delta_light(emitter.kind):
                    ls.distance = delta_sample(scene, emitter, at.x, wp.vec2(0.0, 0.0)).distance
        r.o = interaction.offset(at, vertex.light_wi)
        d, t_max = shadow_ray(r.o, ls)
        r.d = d
        r.passage = passage(scene, r.o, d, t_max, MOST_CROSSINGS)
        # The segment is free. Were it blocked now, by another rounding, it would count for nothing.
        r.transmittance = where3(r.passage.blocked == 0, transmittance_of(r.passage), wp.vec3(0.0, 0.0, 0.0))
        return r

    @wp.func
    def accumulate_transmittance(
        scene: Scene, target: wp.array(dtype=wp.float32), segment: LightSegment, w: wp.vec3
    ) -> CrossedAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = CrossedAdjoint()
        start = segment.o
        count = wp.where(segment.passage.blocked == 0, segment.passage.crossings, 0)
        i = wp.int32(0)
        while i < count:
            hit = visibility.closest(scene, start, segment.d, FAR)
            i += 1
            if hit.face < 0:
                i = count
            else:
                surface = interaction.surface(scene, hit.face, hit.u, hit.v)
                at = interaction.on(scene, surface, hit.face, hit.u, hit.v, segment.d)
                others = other_factors(segment.passage, interaction.scatter(at, LOBE_NULL).value)
                zero = wp.vec3(0.0, 0.0, 0.0)
                fa = interaction.scatter_vjp(at, LOBE_NULL, wp.cw_mul(w, others), zero)
                adjoint, dot = accumulate_material(
                    scene, target, at.slots, hit.face, hit.u, hit.v, surface.uv, fa.material, VertexAdjoint()
                )
                r.dot += dot
                if wp.static(moves):
                    turned = frame_vjp(at.frame, surface.tangent, -segment.d, -segment.d, fa.wi, zero)
                    adjoint.n = at.frame.side * turned.n
                    if wp.static(config.surfaces.tangent):
                        adjoint.tangent = turned.tangent
                    met = accumulate_vertex(scene, target, hit.face, hit.u, hit.v, adjoint, True, segment.o, segment.d)
                    r.dot += met.dot
                    r.o += met.o
                    r.d += met.d - turned.wi
                start = interaction.offset(at, segment.d)
        return r

    return TransmittanceSink(segment_to_light, accumulate_transmittance)

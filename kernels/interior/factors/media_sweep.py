"""The backward sweep over the steps of a path through media: the derivatives of one step's factors.

A step is L_n = M_n + V_n (E_n + D_n + beta_n L_{n+1}). This file differentiates M_n, V_n, D_n and the phase function;
``sweep.py`` differentiates the rest of a surface. Nothing moves: distances, directions and densities are detached.

Derivation: ``docs/theory/media.md#derivatives``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.dispatch import has_null_lobes
from warp_psdr.kernels.constants import FAR, LOBE_NULL, LOBE_SMOOTH, PHASE_SGGX
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.shadow_crossings import make_crossed_surface
from warp_psdr.kernels.interior.factors.sinks import make_light_sink, make_material_sink
from warp_psdr.kernels.interior.factors.sweep import Carry, make_sweep
from warp_psdr.kernels.medium.coefficients import (
    EMISSION,
    PHASE,
    SCALE,
    SIGMA_T,
    coefficients_of,
    exp_minus,
    make_coefficient_sinks,
)
from warp_psdr.kernels.medium.emission import make_emission_sink
from warp_psdr.kernels.medium.grid_adjoint import SALT_POINTS, make_grid_adjoint
from warp_psdr.kernels.medium.grid_emission import make_grid_emission_sink
from warp_psdr.kernels.medium.passage import MOST_INTERFACES, make_media_passage, medium_towards
from warp_psdr.kernels.medium.volume import GRID
from warp_psdr.kernels.path_media import MediaVertex, collision_point
from warp_psdr.kernels.phase.dispatch import make_phase, make_phase_sink
from warp_psdr.kernels.phase.microflakes import has_flakes, make_flake_sinks
from warp_psdr.kernels.phase.sggx import make_flake_length
from warp_psdr.kernels.rng import Sampler, salted
from warp_psdr.kernels.scattering import samples_lights
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.transmittance import other_factors
from warp_psdr.kernels.vertex import MediaConfig, PathConfig


def explores_density(wanted: GradientRequest) -> bool:
    """Whether flights have to collide where there is no density, too."""
    return SIGMA_T in wanted.media or SCALE in wanted.media


def turns_flakes(media: MediaConfig, wanted: GradientRequest) -> bool:
    """Whether the extinction of what flies along a direction is differentiated by S (``phase/microflakes.py``)."""
    assert media is not None
    return PHASE in wanted.media and has_flakes(media.phases)


@wp.func
def number_of(v: MediaVertex) -> wp.int32:
    """The number of a step's first stretch among all: its flight and those of its shadow ray."""
    return (MOST_INTERFACES + 2) * v.step


@functools.cache
def make_attenuation_sink(config: PathConfig, wanted: GradientRequest, role: str):
    """Return ``accumulate_segment(scene, target, sampler, vertex, w) -> float32``.

    ``w`` is the adjoint of the transmittance of the segment to the vertex's light, which is walked again.
    """
    assert config.media is not None
    shadow_crossing = make_crossed_surface(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    passage = make_media_passage(config, True)
    accumulate_extinction, _accumulate_flight = make_coefficient_sinks(role, wanted.media)
    accumulate_material = make_material_sink(config.surfaces, wanted, role)
    accumulate_depth, _tracked, _extinction_at = make_grid_adjoint(config.media, role, wanted.media)
    grids = config.media.grids
    density = explores_density(wanted)
    flakes = PHASE_SGGX in config.media.phases
    turned = turns_flakes(config.media, wanted)
    flake_length = make_flake_length(config.media.phases)
    _value, accumulate_area = make_flake_sinks(config.media.phases, role)
    materials = any(wanted.material) or wanted.to_uv

    @wp.func
    def accumulate_stretch(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        medium: wp.int32,
        o: wp.vec3,
        d: wp.vec3,
        length: wp.float32,
        transmittance: wp.vec3,
        sampler: Sampler,
        number: wp.int32,
        w: wp.vec3,
    ) -> wp.float32:
        total = wp.float32(0.0)
        if wp.static((density or turned) and grids):
            if medium >= 0:
                m = scene.media.records[medium]
                if m.sigma_t_channels == GRID:
                    stream = salted(sampler, SALT_POINTS, number)
                    w_depth = -wp.cw_mul(w, transmittance)
                    return accumulate_depth(scene, target, m, o, d, length, stream, w_depth)
        optical = length
        if wp.static(flakes):
            if medium >= 0:
                optical = flake_length(scene, scene.media.records[medium], d, length)
        if wp.static(turned):
            if medium >= 0 and length < FAR:
                m_flakes = scene.media.records[medium]
                if m_flakes.phase == PHASE_SGGX:
                    w_sigma = wp.dot(coefficients_of(scene, m_flakes).sigma_t, wp.cw_mul(w, transmittance))
                    total += accumulate_area(scene, target, m_flakes, o, d, -optical * w_sigma)
        if wp.static(density):
            if medium >= 0:
                a_sigma = wp.vec3(0.0, 0.0, 0.0)
                for k in range(3):
                    value = w[k] * transmittance[k]
                    if value != 0.0:
                        # Without an end the transmittance falls from 1 to 0 as soon as there is any density.
                        a_sigma[k] = wp.where(length < FAR, -optical * value, -wp.INF)
                total += accumulate_extinction(scene, target, scene.media.records[medium], a_sigma)
        return total

    if not has_null_lobes(config.surfaces.bsdfs):

        @wp.func
        def accumulate_free_segment(
            scene: Scene, target: wp.array(dtype=wp.float32), sampler: Sampler, v: MediaVertex, w: wp.vec3
        ) -> wp.float32:
            return accumulate_stretch(
                scene,
                target,
                v.shadow_medium,
                v.shadow_o,
                v.shadow_d,
                v.shadow_t,
                v.transmittance,
                sampler,
                number_of(v) + 1,
                w,
            )

        return accumulate_free_segment

    @wp.func
    def accumulate_segment(
        scene: Scene, target: wp.array(dtype=wp.float32), sampler: Sampler, v: MediaVertex, w: wp.vec3
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = wp.float32(0.0)
        if wp.static(materials):
            passed, _first = passage(scene, v.shadow_o, v.shadow_d, v.shadow_t, v.shadow_medium, False, sampler, v.step)
        start = v.shadow_o
        inside = v.shadow_medium
        crossings = wp.int32(0)
        while crossings <= MOST_INTERFACES:
            rest = v.shadow_t - wp.dot(start - v.shadow_o, v.shadow_d)
            hit = shadow_crossing(scene, v, crossings, start, rest)
            length = wp.where(hit.face >= 0, hit.t, rest)
            number = number_of(v) + 1 + crossings
            total += accumulate_stretch(
                scene, target, inside, start, v.shadow_d, length, v.transmittance, sampler, number, w
            )
            crossings += 1
            if hit.face < 0:
                crossings = MOST_INTERFACES + 1
            else:
                surface = interaction.surface(scene, hit.face, hit.u, hit.v)
                at = interaction.on(scene, surface, hit.face, hit.u, hit.v, v.shadow_d)
                if wp.static(materials):
                    others = other_factors(passed, interaction.scatter(at, LOBE_NULL).value)
                    fa = interaction.scatter_vjp(at, LOBE_NULL, wp.cw_mul(w, others), wp.vec3(0.0, 0.0, 0.0))
                    _adjoint, dot = accumulate_material(
                        scene, target, at.slots, hit.face, hit.u, hit.v, surface.uv, fa.material, VertexAdjoint()
                    )
                    total += dot
                inside = medium_towards(scene, at.shape, at.ng, v.shadow_d, v.shadow_d, inside)
                start = interaction.offset(at, v.shadow_d)
        return total

    return accumulate_segment


@functools.cache
def make_media_sweep(config: PathConfig, wanted: GradientRequest, role: str, ratio: bool = False):
    """Return ``media_sweep(scene, target, sampler, vertex, delta, radiance) -> (vec3, float32)``.

    ``radiance`` is L_{n+1}, ``sampler`` the path's; the results are L_n and what the sinks returned.
    ``ratio``: in-scattering in grids is shared with differential ratio tracking.
    """
    assert config.media is not None
    interaction = make_interaction(config.surfaces, config.lights)
    sweep, _finish, _finish_vertex = make_sweep(config, wanted, role, direct=False)
    phase = make_phase(config.media.phases)
    accumulate_phase = make_phase_sink(config.media.phases, role)
    _accumulate_extinction, accumulate_flight = make_coefficient_sinks(role, wanted.media)
    _depth, accumulate_tracked, _extinction_at = make_grid_adjoint(config.media, role, wanted.media, ratio)
    grids = config.media.grids
    turned = turns_flakes(config.media, wanted)
    emissive = config.media.emissive and (turned or bool({SIGMA_T, SCALE, EMISSION} & set(wanted.media)))
    accumulate_emission = make_emission_sink(config.media.phases, role, wanted.media)
    accumulate_grid_emission = make_grid_emission_sink(config.media, role, wanted.media) if emissive and grids else None
    accumulate_segment = make_attenuation_sink(config, wanted, role)
    accumulate_material = make_material_sink(config.surfaces, wanted, role)
    has_lights = bool(config.lights.area or config.lights.others)
    smooth = samples_lights(config.lights, config.surfaces.bsdfs)
    radiance_of, accumulate_light = (
        make_light_sink(config.surfaces, config.lights, wanted, role) if has_lights else (None, None)
    )
    materials = any(wanted.material) or wanted.to_uv
    lights = wanted.radiance or wanted.to_uv or bool(wanted.lights)
    flakes = PHASE_SGGX in config.media.phases
    flake_length = make_flake_length(config.media.phases)
    _value, accumulate_area = make_flake_sinks(config.media.phases, role)
    segments = explores_density(wanted) or turned or (materials and has_null_lobes(config.surfaces.bsdfs))
    scattered = PHASE in wanted.media

    @wp.func
    def surface_value(
        scene: Scene, target: wp.array(dtype=wp.float32), v: MediaVertex, a_direct: wp.vec3
    ) -> tuple[wp.vec3, wp.vec3, wp.float32]:
        """f_s of the light's direction and the light's radiance; what is left of the vector-Jacobian product."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        vertex = v.surface
        f = wp.vec3(0.0, 0.0, 0.0)
        radiance = wp.vec3(0.0, 0.0, 0.0)
        dot = wp.float32(0.0)
        if wp.static(smooth):
            surface = interaction.surface(scene, vertex.face, vertex.u, vertex.v)
            at = interaction.on(scene, surface, vertex.face, vertex.u, vertex.v, vertex.d)
            wo = enter_frame(at.frame, vertex.light_wi)
            f = wp.static(interaction.eval)(at, wo)
            radiance = radiance_of(scene, vertex, surface.x)
            if wp.static(materials):
                fa = wp.static(interaction.eval_vjp)(at, wo, vertex.light_weight * wp.cw_mul(a_direct, radiance))
                _adjoint, d = accumulate_material(
                    scene, target, at.slots, vertex.face, vertex.u, vertex.v, surface.uv, fa.material, VertexAdjoint()
                )
                dot = d
        return f, radiance, dot

    @wp.func
    def direct(
        scene: Scene, target: wp.array(dtype=wp.float32), sampler: Sampler, v: MediaVertex, a_n: wp.vec3
    ) -> wp.float32:
        """D_n: the factors of next-event estimation."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        vertex = v.surface
        total = wp.float32(0.0)
        if wp.static(has_lights):
            a_direct = wp.cw_mul(a_n, v.transmittance)
            x = collision_point(v)
            f = wp.vec3(0.0, 0.0, 0.0)
            radiance = wp.vec3(0.0, 0.0, 0.0)
            if v.collides:
                m = scene.media.records[v.medium]
                value = phase.eval(scene, m, x, vertex.d, vertex.light_wi)
                f = wp.vec3(value, value, value)
                radiance = radiance_of(scene, vertex, x)
                if wp.static(scattered):
                    w = vertex.light_weight * wp.dot(a_direct, radiance)
                    total += accumulate_phase(scene, target, m, x, vertex.d, vertex.light_wi, w)
            else:
                f_s, emitted, dot = surface_value(scene, target, v, a_direct)
                f = f_s
                radiance = emitted
                total += dot
                x = v.shadow_o
            if wp.static(lights):
                w_radiance = vertex.light_weight * wp.cw_mul(a_direct, f)
                _x, dot = accumulate_light(scene, target, vertex, x, w_radiance, 0.0, wp.vec3(0.0, 0.0, 0.0), 1.0)
                total += dot
            if wp.static(segments):
                w_t = vertex.light_weight * wp.cw_mul(wp.cw_mul(a_n, radiance), f)
                total += accumulate_segment(scene, target, sampler, v, w_t)
        return total

    @wp.func
    def media_sweep(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        sampler: Sampler,
        v: MediaVertex,
        delta: wp.vec3,
        radiance: wp.vec3,
    ) -> tuple[wp.vec3, wp.float32]:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        vertex = v.surface
        a_n = wp.cw_mul(delta, vertex.throughput)
        inner = vertex.direct + wp.cw_mul(vertex.beta, radiance)
        total = wp.float32(0.0)
        if v.collides:
            if wp.static(scattered):
                if vertex.lobe == LOBE_SMOOTH:
                    w = vertex.inv_pdf * wp.dot(a_n, radiance)
                    m_scatters = scene.media.records[v.medium]
                    total += accumulate_phase(scene, target, m_scatters, collision_point(v), vertex.d, vertex.wo, w)
        else:
            vertex.light = -1
            carry = Carry()
            carry.face = -2
            carry.radiance = radiance
            done = sweep(scene, target, vertex, delta, carry)
            total += done.dot
        if v.surface.light >= 0:
            total += direct(scene, target, sampler, v, a_n)
        if v.medium >= 0:
            m = scene.media.records[v.medium]
            w_v = v.inv_p * wp.cw_mul(wp.cw_mul(delta, v.before), inner)
            in_grid = wp.bool(False)
            if wp.static(grids):
                in_grid = m.sigma_t_channels == GRID
                if in_grid:
                    stream = salted(sampler, SALT_POINTS, number_of(v))
                    total += accumulate_tracked(
                        scene, target, m, vertex.o, vertex.d, v.t, v.collides, v.passed, stream, w_v
                    )
            if not in_grid:
                optical = v.t
                if wp.static(flakes):
                    optical = flake_length(scene, m, vertex.d, v.t)
                total += accumulate_flight(scene, target, m, optical, v.collides, w_v)
                if wp.static(turned):
                    if m.phase == PHASE_SGGX and v.t < FAR:
                        c = coefficients_of(scene, m)
                        depth = optical * c.sigma_t
                        slope = wp.cw_mul(-depth, exp_minus(c.sigma_t, optical))
                        if v.collides:
                            ones = wp.vec3(1.0, 1.0, 1.0)
                            slope = wp.cw_mul(ones - depth, exp_minus(c.sigma_t, optical))
                            slope = wp.cw_mul(wp.cw_mul(c.albedo, c.sigma_t), slope)
                        total += accumulate_area(scene, target, m, vertex.o, vertex.d, wp.dot(w_v, slope))
            if wp.static(emissive):
                w_emitted = wp.cw_mul(delta, v.before)
                if wp.static(grids):
                    if in_grid:
                        total += accumulate_grid_emission(
                            scene, target, m, vertex.o, vertex.d, v.stretch, sampler, v.step, v.emitted, w_emitted
                        )
                if not in_grid:
                    total += accumulate_emission(scene, target, m, vertex.d, v.stretch, w_emitted)
        return v.emitted + wp.cw_mul(v.weight, inner), total

    return media_sweep

"""The sweep over a path through media for everything that moves: vertices, lights, the camera, interfaces [ZYZ21].

A volume vertex rides as a fraction of its stretch between two attached crossings of a ray. The ray runs from y, where
its direction was drawn, to z, the first surface behind the vertex that is no interface. Then dV = (f G(y, z) J(z)) dA
ds times the length of the stretch, sigma_s, f_p and T: the connection y -> z is that of surfaces, and no term stands
for moving domains. Grids add the variation of their density (``grid_motion.py``). Emission along a stretch changes with
its length.

Derivation: ``docs/theory/media.md#what-moves``.
"""

import functools
from dataclasses import replace

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.dispatch import has_chain_lobes, is_diffuse
from warp_psdr.kernels.constants import FAR, LOBE_NONE, LOBE_NULL, LOBE_SMOOTH, PHASE_BLEND_GRID, PHASE_SGGX
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.contact import make_contact_weights
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.grid_motion import (
    make_grid_emission_motion,
    make_grid_flight_sink,
    make_grid_shadow_sink,
)
from warp_psdr.kernels.interior.factors.media_sweep import number_of
from warp_psdr.kernels.interior.factors.moved_step import MovedStep, make_stretch
from warp_psdr.kernels.interior.factors.nearness import make_nearness, weight_of_half
from warp_psdr.kernels.interior.factors.pullback import connection_vjp
from warp_psdr.kernels.interior.factors.shadow_motion import make_light_end_sink, make_shadow_sink
from warp_psdr.kernels.interior.factors.sinks import make_light_sink
from warp_psdr.kernels.interior.factors.sweep import Carry, make_sweep
from warp_psdr.kernels.medium.coefficients import POSE, exp_minus
from warp_psdr.kernels.medium.emission import emission_of
from warp_psdr.kernels.medium.grid_adjoint import SALT_POINTS
from warp_psdr.kernels.medium.grid_span import Span, span_length, span_of
from warp_psdr.kernels.medium.interface import make_interface, make_interface_sink
from warp_psdr.kernels.medium.volume import GRID
from warp_psdr.kernels.path_media import MediaVertex, collision_point
from warp_psdr.kernels.phase.dispatch import make_phase, make_phase_slopes
from warp_psdr.kernels.phase.sggx import flake_area_slope, flakes_of, make_extinction_along, sggx_slopes
from warp_psdr.kernels.primitive.dispatch import make_position
from warp_psdr.kernels.reading import texture_record
from warp_psdr.kernels.rng import Sampler, salted
from warp_psdr.kernels.scattering import samples_lights
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_sink
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import normalize_vjp
from warp_psdr.kernels.vertex import PathConfig


@wp.struct
class MovedCarry:
    """What the sweep hands from a step to the one before it."""

    #: Radiance, and z: its adjoint, and in ``a_x`` that of y.
    end: Carry
    a_w: wp.vec3  # adjoint of the direction of the ray from y
    a_wi: wp.vec3  # what of the adjoint of y, and with the opposite sign of z, is that of the direction from z to y
    a_t: wp.float32  # adjoint of the distance from y to where the step's flight starts


@functools.cache
def make_moved_sweep(config: PathConfig, wanted: GradientRequest, role: str):
    """Return ``(moved_sweep, finish)``.

    ``moved_sweep(scene, target, sampler, step, delta, carry) -> MovedCarry``; ``end.dot`` of the result is what the
    sinks of this step returned, ``sampler`` is the path's.
    ``finish(scene, target, camera, sample, carry) -> float32``: from the first step to the camera.
    """
    assert config.media is not None
    # Transmittances are this sweep's.
    bare = replace(config, through=False)
    # A diffuse surface does not see where light goes.
    glossy = wanted.geometry and not is_diffuse(config.surfaces.bsdfs)
    sweep, _finish, finish_vertex = make_sweep(bare, wanted, role, before=weight_of_half if glossy else None)
    weight_before, _weight_of_light = make_contact_weights(
        config.rays.backend, config.rays.width, config.surfaces.primitives
    )
    interaction = make_interaction(config.surfaces, config.lights)
    position, cross_of = make_position(config.surfaces.primitives)
    stretch_of, _reach_of = make_stretch(config.media.grids, config.surfaces.primitives)
    phase = make_phase(config.media.phases)
    by_cosine, by_place = make_phase_slopes(config.media.phases)
    placed = PHASE_BLEND_GRID in config.media.phases
    flakes = PHASE_SGGX in config.media.phases
    extinction_along = make_extinction_along(config.media.phases)
    has_lights = bool(config.lights.area or config.lights.others)
    smooth = samples_lights(config.lights, config.surfaces.bsdfs)
    radiance_of, accumulate_light = (
        make_light_sink(config.surfaces, config.lights, wanted, role) if has_lights else (None, None)
    )
    grids = config.media.grids
    grids_move = POSE in wanted.media
    accumulate_shadow = make_grid_shadow_sink(config, role, grids_move) if grids else make_shadow_sink(config, role)
    accumulate_grid_flight = make_grid_flight_sink(role, grids_move) if grids else None
    emissive = config.media.emissive
    accumulate_glow = make_grid_emission_motion(config.media, role, grids_move) if emissive and grids else None
    accumulate_end = make_light_end_sink(config.surfaces, config.lights, wanted, role)
    accumulate_crossing = make_interface_sink(role, config.surfaces.primitives)
    is_interface, _behind = make_interface(config)
    accumulate_camera = make_camera_sink(role, config.camera) if wanted.camera else None
    geometry = wanted.geometry
    nearness = make_nearness(config.surfaces, config.lights, geometry)
    chains = has_chain_lobes(config.surfaces.bsdfs, True)

    @wp.func
    def attached(scene: Scene, target: wp.array(dtype=wp.float32), carry: MovedCarry) -> Carry:
        """The ray that leaves a delta lobe, with the adjoint of what it meets: nothing behind is left to be done."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        end = carry.end
        end.dot = wp.float32(0.0)
        done = finish_vertex(scene, target, end, True)
        r = Carry()
        r.face = -1
        r.radiance = end.radiance
        r.a_x = done.a_x
        r.a_d = done.a_d + carry.a_w
        r.dot = done.dot
        return r

    @wp.func
    def closed(scene: Scene, carry: MovedCarry) -> Carry:
        """The end of a ray whose direction is that from y to the material point z."""
        r = carry.end
        r.dot = wp.float32(0.0)
        if r.face >= 0:
            length = wp.length(position(scene.triangles[r.face], r.u, r.v) - r.o)
            across = normalize_vjp(r.d, length, carry.a_w)
            r.adjoint.x = r.adjoint.x + across
            r.a_x -= across
        return r

    @wp.func
    def towards_light(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        sampler: Sampler,
        v: MediaVertex,
        x: wp.vec3,
        w_radiance: wp.vec3,
        value: wp.float32,
        a_wo: wp.vec3,
        chi: wp.float32,
        w_t: wp.vec3,
    ) -> tuple[wp.vec3, wp.float32]:
        """Adjoint of x: arguments as of ``accumulate_light``; ``w_t``: of the logarithm of the transmittance."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        if wp.static(grids):
            segment = accumulate_shadow(scene, target, sampler, v, w_t)
        else:
            segment = accumulate_shadow(scene, target, v, w_t)
        a_x, total = accumulate_light(scene, target, v.surface, x, w_radiance, value, a_wo + segment.d, chi)
        total += segment.dot
        a_x += segment.o
        along = segment.length * v.shadow_d
        ends, dot = accumulate_end(scene, target, v, along)
        if ends:
            a_x -= along
            total += dot
        return a_x, total

    @wp.func
    def of_collision(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        sampler: Sampler,
        s: MovedStep,
        a_n: wp.vec3,
        carry: MovedCarry,
        stretch: wp.float32,
    ) -> tuple[wp.vec3, wp.vec3, wp.float32]:
        """Adjoint of a volume vertex and of the direction in which it is reached; ``stretch``: its longest."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        v = s.step
        vertex = v.surface
        x = collision_point(v)
        m = scene.media.records[v.medium]
        a_x = wp.vec3(0.0, 0.0, 0.0)
        a_d = wp.vec3(0.0, 0.0, 0.0)
        total = wp.float32(0.0)
        if wp.static(geometry):
            if vertex.lobe == LOBE_SMOOTH:
                value = wp.dot(wp.cw_mul(a_n, vertex.beta), carry.end.radiance)
                w = vertex.inv_pdf * wp.dot(a_n, carry.end.radiance)
                turned = w * by_cosine(scene, m, x, wp.dot(vertex.d, vertex.wo))
                a_d += turned * vertex.wo
                a_wo = turned * vertex.d
                if wp.static(placed):
                    a_x += w * by_place(scene, m, x, vertex.d, vertex.wo)
                if wp.static(flakes):
                    if m.phase == PHASE_SGGX:
                        slope_d, slope_wo = sggx_slopes(flakes_of(scene, m.g), vertex.d, vertex.wo)
                        a_d += w * slope_d
                        a_wo = w * slope_wo
                end = closed(scene, carry)
                if end.face >= 0:
                    tri = scene.triangles[end.face]
                    z = position(tri, end.u, end.v)
                    cross = cross_of(tri, end.u, end.v)
                    chi = nearness(scene, x, stretch, end.face, end.u, end.v)
                    if wp.static(chains):
                        # A mirror or glass turns by it what it sends.
                        end.a_x -= (1.0 - chi) * carry.a_wi
                        end.adjoint.x = end.adjoint.x + (1.0 - chi) * carry.a_wi
                    if wp.static(flakes):
                        a_wo = chi * a_wo
                    else:
                        a_wo = (chi * turned) * vertex.d
                    link = connection_vjp(end.o, z, cross, vertex.wo, a_wo, value, chi)
                    a_x += link.x
                    end.adjoint.x = end.adjoint.x - link.x
                    end.adjoint.c = end.adjoint.c + link.c
                done = finish_vertex(scene, target, end, False)
                a_x += done.a_x
                total += done.dot
        if wp.static(has_lights):
            if vertex.light >= 0:
                a_direct = vertex.light_weight * wp.cw_mul(a_n, v.transmittance)
                radiance = radiance_of(scene, vertex, x)
                turned = wp.dot(a_direct, radiance) * by_cosine(scene, m, x, wp.dot(vertex.d, vertex.light_wi))
                w_radiance = phase.eval(scene, m, x, vertex.d, vertex.light_wi) * a_direct
                w_t = wp.cw_mul(w_radiance, radiance)
                value = w_t[0] + w_t[1] + w_t[2]
                chi = wp.float32(1.0)
                if vertex.light_face >= 0:
                    chi = nearness(scene, x, stretch, vertex.light_face, vertex.light_u, vertex.light_v)
                a_wo = (chi * turned) * vertex.d
                if wp.static(flakes):
                    if m.phase == PHASE_SGGX:
                        slope_d, slope_wo = sggx_slopes(flakes_of(scene, m.g), vertex.d, vertex.light_wi)
                        w_f = wp.dot(a_direct, radiance)
                        a_d += w_f * slope_d
                        a_wo = (chi * w_f) * slope_wo
                lit, dot = towards_light(scene, target, sampler, v, x, w_radiance, value, a_wo, chi, w_t)
                a_d += turned * vertex.light_wi
                a_x += lit
                if wp.static(placed):
                    a_x += wp.dot(a_direct, radiance) * by_place(scene, m, x, vertex.d, vertex.light_wi)
                total += dot
        return a_x, a_d, total

    @wp.func
    def of_surface(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        sampler: Sampler,
        s: MovedStep,
        delta: wp.vec3,
        carry: MovedCarry,
    ) -> Carry:
        """The sweep of a surface, once for E_n and what goes on, once for D_n, which has a transmittance."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        v = s.step
        vertex = v.surface
        vertex.o = s.start
        vertex.light = -1
        behind = Carry()
        if wp.static(chains and geometry):
            if vertex.lobe > LOBE_SMOOTH:
                behind = attached(scene, target, carry)
            else:
                behind = closed(scene, carry)
        else:
            behind = closed(scene, carry)
        result = Carry()
        if wp.static(glossy):
            chi = weight_before(scene, vertex)
            if s.reach > 0.0 and vertex.face >= 0 and vertex.lobe <= LOBE_SMOOTH:
                chi = nearness(scene, s.start, s.reach, vertex.face, vertex.u, vertex.v)
            vertex.light_weight = chi
        of_light = v.surface.light >= 0
        count = wp.where(of_light, 2, 1)
        factor = delta
        k = wp.int32(0)
        while k < count:
            done = sweep(scene, target, vertex, factor, behind)
            if k == 0:
                result = done
            else:
                result.adjoint.x = result.adjoint.x + done.adjoint.x
                result.adjoint.n = result.adjoint.n + done.adjoint.n
                result.adjoint.tangent = result.adjoint.tangent + done.adjoint.tangent
                result.adjoint.uv = result.adjoint.uv + done.adjoint.uv
                result.adjoint.u = result.adjoint.u + done.adjoint.u
                result.adjoint.v = result.adjoint.v + done.adjoint.v
                result.adjoint.c = result.adjoint.c + done.adjoint.c
                result.a_x += done.a_x
                result.dot += done.dot
            vertex.light = v.surface.light
            vertex.lobe = LOBE_NONE
            vertex.e_weight = 0.0
            if wp.static(glossy):
                vertex.light_weight = v.surface.light_weight
                vertex.inv_pdf = chi
            factor = wp.cw_mul(delta, v.transmittance)
            behind = Carry()
            behind.face = -2
            k += 1
        if wp.static(smooth):
            if of_light:
                surface = interaction.surface(scene, vertex.face, vertex.u, vertex.v)
                at = interaction.on(scene, surface, vertex.face, vertex.u, vertex.v, vertex.d)
                f = interaction.eval(at, enter_frame(at.frame, vertex.light_wi))
                a_direct = vertex.light_weight * wp.cw_mul(wp.cw_mul(delta, vertex.throughput), v.transmittance)
                w_t = wp.cw_mul(wp.cw_mul(a_direct, f), radiance_of(scene, vertex, surface.x))
                none = wp.vec3(0.0, 0.0, 0.0)
                lit, dot = towards_light(scene, target, sampler, v, v.shadow_o, none, 0.0, none, 1.0, w_t)
                result.adjoint.x = result.adjoint.x + lit
                result.dot += dot
        return result

    @wp.func
    def moved_sweep(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        sampler: Sampler,
        s: MovedStep,
        delta: wp.vec3,
        carry: MovedCarry,
    ) -> MovedCarry:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        v = s.step
        vertex = v.surface
        d = vertex.d
        r = MovedCarry()
        inner = vertex.direct + wp.cw_mul(vertex.beta, carry.end.radiance)
        passes = vertex.lobe == LOBE_NULL and not v.collides
        if wp.static(chains):
            passes = passes and is_interface(scene, vertex.face)
        a_near = wp.float32(0.0)  # adjoint of the distances from y at which the stretch begins and ends
        a_far = wp.float32(0.0)
        far = wp.float32(0.0)
        inv_length = wp.float32(0.0)
        stretch = wp.float32(0.0)
        if vertex.face >= 0:
            far, stretch = stretch_of(scene, s)
            inv_length = 1.0 / stretch
        in_grid = wp.bool(False)
        if wp.static(grids):
            a_point = wp.vec3(0.0, 0.0, 0.0)
            # The ray that was tracked: behind an interface it is beside that from y, by the step off the surface.
            y = vertex.o - s.before * d
            span = Span()
            if v.medium >= 0:
                m = scene.media.records[v.medium]
                in_grid = m.sigma_t_channels == GRID
                if in_grid:
                    ends = wp.where(vertex.face >= 0, s.before + stretch, FAR)
                    span = span_of(scene, texture_record(scene, m.sigma_t), y, d, s.before, ends)
                    stretch = span_length(span)
        if passes:
            r.end = carry.end
            r.end.dot = wp.float32(0.0)
            r.a_w = carry.a_w
            r.a_wi = carry.a_wi
            a_far = carry.a_t
        elif v.collides:
            a_n = wp.cw_mul(delta, vertex.throughput)
            a_x, a_d, dot = of_collision(scene, target, sampler, s, a_n, carry, stretch)
            r.end.face = s.face
            r.end.u = s.u
            r.end.v = s.v
            r.end.o = s.start
            r.end.d = d
            r.end.chi = 1.0
            r.end.dot = dot
            r.a_w = a_d
            if wp.static(grids):
                a_point = a_x
            if not in_grid:
                r.end.a_x = a_x
                r.a_w += (s.before + v.t) * a_x
                a_near = wp.dot(d, a_x)
                a_far = v.t * inv_length * a_near
                a_near -= a_far
        else:
            r.end = of_surface(scene, target, sampler, s, delta, carry)
            if wp.static(chains):
                if vertex.lobe > LOBE_SMOOTH:  # what smooth lobes turn has its weight
                    r.a_wi = r.end.a_x
        r.end.radiance = wp.cw_mul(v.weight, inner)
        if wp.static(geometry):
            if wp.static(grids):
                if in_grid:
                    m = scene.media.records[v.medium]
                    w_v = wp.cw_mul(wp.cw_mul(delta, v.before), r.end.radiance)
                    w_at = wp.cw_mul(wp.cw_mul(delta, v.before), wp.cw_mul(v.passed, inner))
                    stream = salted(sampler, SALT_POINTS, number_of(v))
                    a_flight = accumulate_grid_flight(
                        scene, target, m, span, y, d, s.before + v.t, v.collides, stream, w_v, w_at, a_point
                    )
                    r.end.a_x += a_flight.o
                    r.a_w += a_flight.d
                    r.end.dot += a_flight.dot
                    a_far += a_flight.far
                    a_near += a_flight.near
            if v.medium >= 0 and vertex.face >= 0 and not in_grid:
                w_v = wp.cw_mul(wp.cw_mul(delta, v.before), r.end.radiance)
                thins = wp.dot(extinction_along(scene, scene.media.records[v.medium], d).sigma_t, w_v)
                rate = -thins
                if v.collides:
                    rate = inv_length * (w_v[0] + w_v[1] + w_v[2] - v.t * thins)
                a_far += rate
                a_near -= rate
            if wp.static(flakes):
                if v.medium >= 0 and not in_grid and v.t < FAR:
                    m = scene.media.records[v.medium]
                    if m.phase == PHASE_SGGX:
                        w_v = wp.cw_mul(wp.cw_mul(delta, v.before), r.end.radiance)
                        rate = -v.t * wp.dot(extinction_along(scene, m, d).sigma_t, w_v)
                        if v.collides:
                            rate += w_v[0] + w_v[1] + w_v[2]
                        r.a_w += rate * flake_area_slope(flakes_of(scene, m.g), d)
            if wp.static(emissive):
                if v.medium >= 0:
                    m = scene.media.records[v.medium]
                    w_m = wp.cw_mul(delta, v.before)
                    if wp.static(grids):
                        if in_grid:
                            a_glow = accumulate_glow(scene, target, m, span, s.before, v, sampler, w_m)
                            r.end.a_x += a_glow.o
                            r.a_w += a_glow.d
                            r.end.dot += a_glow.dot
                            a_far += a_glow.far
                            a_near += a_glow.near
                    if vertex.face >= 0 and not in_grid:
                        left = exp_minus(extinction_along(scene, m, d).sigma_t, v.stretch)
                        longer = wp.dot(w_m, wp.cw_mul(left, emission_of(scene, m)))
                        a_far += longer
                        a_near -= longer
            if vertex.face >= 0:
                if passes or (v.collides and is_interface(scene, vertex.face)):
                    a = accumulate_crossing(scene, target, vertex.face, vertex.u, vertex.v, d, far, a_far)
                    r.end.a_x += a.o
                    r.a_w += a.d
                    r.end.dot += a.dot
                else:
                    r.end.adjoint.x = r.end.adjoint.x + a_far * d
                    r.end.a_x -= a_far * d
            r.a_t = a_near
        if wp.static(emissive):
            r.end.radiance = r.end.radiance + v.emitted
        return r

    @wp.func
    def finish(
        scene: Scene, target: wp.array(dtype=wp.float32), camera: Camera, sample: CameraSample, carry: MovedCarry
    ) -> wp.float32:
        if wp.static(not geometry):
            return 0.0
        else:
            _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
            end = carry.end
            end.dot = wp.float32(0.0)
            done = finish_vertex(scene, target, end, True)
            total = done.dot
            if wp.static(wanted.camera):
                total += accumulate_camera(scene, target, camera, sample, done.a_x, done.a_d + carry.a_w)
            return total

    return moved_sweep, finish

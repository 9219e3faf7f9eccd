"""One step of a path in a scene with media: a flight, and the vertex at its end (``path.py``: scenes without media).

At every step L_n = M_n + V_n (E_n + D_n + beta_n L_{n+1}). V_n is the factor of the flight through the ray's medium,
over its density, and M_n what the medium emits along it. The vertex at the end is a collision (E_n = 0), a surface, or
the sky behind the scene. Surfaces that let light pass without turning it are steps, but do not count as depth;
collisions do, as in Mitsuba's ``volpath``.

Derivation: ``docs/theory/media.md#paths``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.dispatch import has_null_lobes
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import FAR, LOBE_NONE, LOBE_NULL, LOBE_SMOOTH, PHASE_SGGX, PHASE_TABLE
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.invalid import count_invalid, finite, inverse_pdf, vanishes
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.medium.emission import make_emission
from warp_psdr.kernels.medium.flight import Flight, make_flight
from warp_psdr.kernels.medium.grid_emission import make_grid_emission
from warp_psdr.kernels.medium.null_surface import make_null_surface, null_model_of, told_apart
from warp_psdr.kernels.medium.passage import MOST_INTERFACES, is_lost, make_media_passage, medium_towards
from warp_psdr.kernels.medium.tracking import make_tracking
from warp_psdr.kernels.medium.volume import GRID
from warp_psdr.kernels.path import vertex_of
from warp_psdr.kernels.phase.dispatch import make_phase
from warp_psdr.kernels.phase.sggx import make_flake_length
from warp_psdr.kernels.primitive.affine import is_primitive
from warp_psdr.kernels.primitive.dispatch import make_leaving
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.sampling import mis_weight, sphere_pdf, square_to_sphere
from warp_psdr.kernels.scattering import (
    ROULETTE_MAX,
    ROULETTE_MIN,
    EmissionHit,
    NextEvent,
    ScatterSample,
    make_emission_hit,
    make_light_sampler,
    make_next_event,
    make_scatter,
    make_through_event,
    samples_lights,
    shadow_ray,
)
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.transmittance import transmittance_of
from warp_psdr.kernels.vertex import PathConfig, PathState, PathVertex
from warp_psdr.kernels.visibility import visibility_of

#: Sample slots per step: flight, next-event estimation, scattering. Slot 0 is the camera's.
SLOTS_PER_STEP = 3
#: Least cosine that the distance of collisions from a surface is divided by.
GRAZING = 1.0e-4
#: Share of directions that are drawn from the whole sphere where derivatives by tables, which may be zero, are.
EVERYWHERE = 0.1
#: Depth at which no path is ended by roulette.
NEVER = 2147483647


@wp.struct
class MediaState:
    """What one step hands to the next."""

    path: PathState
    medium: wp.int32  # that the ray is in, or NO_MEDIUM
    steps: wp.int32  # so far
    crossings: wp.int32  # surfaces passed without a change of direction so far
    skip: wp.vec3  # from its origin, where it crossed an interface, to where the ray is cast
    least: wp.float32  # length of a flight from which float32 tells its end from that interface


@wp.struct
class MediaVertex:
    """A step of a path and what was sampled there; enough to recompute every factor."""

    #: The vertex at the end of the flight. At a collision: the face behind it, and what the phase function drew.
    surface: PathVertex
    collides: wp.bool
    medium: wp.int32  # of the flight
    t: wp.float32  # its length
    stretch: wp.float32  # up to the surface behind it
    emitted: wp.vec3  # M, of the whole stretch
    length: wp.float32  # as long as it could have been and collided
    inv_p: wp.float32  # 1 / p, or 1 / P
    passed: wp.vec3  # in grids: the weight without a sigma
    weight: wp.vec3  # V over its density
    before: wp.vec3  # throughput before the flight; that of ``surface`` is the one behind it
    #: The segment to the light that next-event estimation found, the medium it starts in, and its transmittance.
    shadow_o: wp.vec3
    shadow_d: wp.vec3
    shadow_t: wp.float32
    shadow_medium: wp.int32
    shadow_hit: RayHit  # the first surface that it crosses
    shadow_crossings: wp.int32
    transmittance: wp.vec3
    step: wp.int32  # the number of this one


@wp.func
def media_path_from(path: PathState, medium: wp.int32) -> MediaState:
    state = MediaState()
    state.path = path
    state.medium = medium
    return state


@wp.func
def radiance_of_step(v: MediaVertex) -> wp.vec3:
    """What a step adds to the radiance of its path."""
    return wp.cw_mul(v.before, v.emitted) + wp.cw_mul(v.surface.throughput, v.surface.direct)


@wp.func
def collision_point(v: MediaVertex) -> wp.vec3:
    """Where a flight ends in its medium."""
    return v.surface.o + v.t * v.surface.d


@functools.cache
def make_collision(config: PathConfig, differential: bool):
    """Return ``collide(scene, sampler, state, vertex, u4, r4, max_depth, rr_depth) -> (MediaVertex, MediaState)``.

    Next-event estimation and scattering where the flight of ``vertex``, which started in ``state``, ends in its medium.
    ``differential``: as of ``make_media_step``.
    """
    assert config.media is not None
    phase = make_phase(config.media.phases)
    passage = make_media_passage(config, differential)
    has_lights = bool(config.lights.area or config.lights.others)
    sample_light = make_light_sampler(config.lights) if has_lights else None
    # Where a table is zero its derivative is not, so directions are drawn there, too.
    everywhere = differential and PHASE_TABLE in config.media.phases

    @wp.func
    def density_of(value: wp.float32) -> wp.float32:
        if wp.static(everywhere):
            return (1.0 - EVERYWHERE) * value + EVERYWHERE * sphere_pdf()
        return value

    @wp.func
    def survival_of(throughput: wp.vec3, eta: wp.float32) -> wp.float32:
        survival = wp.min(wp.max(throughput) * eta * eta, ROULETTE_MAX)
        if wp.static(differential):
            survival = wp.max(survival, ROULETTE_MIN)
        return survival

    @wp.func
    def collide(
        scene: Scene,
        sampler: Sampler,
        state: MediaState,
        vertex: MediaVertex,
        u4: wp.vec4,
        r4: wp.vec4,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> tuple[MediaVertex, MediaState]:
        r = vertex
        after = MediaState()
        path = state.path
        m = scene.media.records[state.medium]
        x = collision_point(vertex)
        throughput = vertex.surface.throughput
        # ---- Next-event estimation ----
        r.surface.light = -1
        if wp.static(has_lights):
            ls, light, _probability = sample_light(scene, x, u4)
            f = phase.eval(scene, m, x, path.d, ls.wi)
            pdf_light = ls.pdf * ls.probability
            traces_shadow_ray = not ls.pdf <= 0.0
            if wp.static(not differential):
                traces_shadow_ray = traces_shadow_ray and not vanishes(ls.radiance)
            if traces_shadow_ray:
                d, t_max = shadow_ray(x, ls)
                draws = max_depth < 0 or path.depth + 2 < max_depth
                passed, first = passage(scene, x, d, t_max, state.medium, draws, sampler, state.steps)
                if passed.blocked == 0:
                    weight = inverse_pdf(pdf_light)
                    if ls.delta == 0:
                        weight *= mis_weight(pdf_light, passed.probability * density_of(f))
                    r.transmittance = transmittance_of(passed)
                    r.surface.direct = weight * f * wp.cw_mul(ls.radiance, r.transmittance)
                    r.surface.light = light
                    r.surface.light_face = ls.face
                    r.surface.light_u = ls.u
                    r.surface.light_v = ls.v
                    r.surface.light_wi = ls.wi
                    r.surface.light_weight = weight
                    r.shadow_o = x
                    r.shadow_d = d
                    r.shadow_t = t_max
                    r.shadow_medium = state.medium
                    r.shadow_hit = first
                    r.shadow_crossings = passed.crossings
                elif passed.blocked == 2:
                    count_invalid(scene, sampler)
        # ---- Scattering ----
        wo = phase.sample(scene, m, x, path.d, wp.vec2(r4[2], r4[3]))
        if wp.static(everywhere):
            if r4[0] < EVERYWHERE:
                wo = square_to_sphere(wp.vec2(r4[2], r4[3]))
        value = phase.eval(scene, m, x, path.d, wo)
        pdf = density_of(value)
        survival = survival_of(throughput, path.eta)
        late = path.depth + 1 >= rr_depth
        alive = not (late and r4[1] >= survival)
        inv_q = wp.where(late, 1.0 / survival, 1.0)
        r.surface.wo = wo
        if alive:
            r.surface.lobe = LOBE_SMOOTH
            r.surface.inv_pdf = inv_q / pdf
            beta = inv_q
            if wp.static(everywhere):
                beta = inv_q * value / pdf
            r.surface.beta = wp.vec3(beta, beta, beta)
            after.path.alive = 1
            after.path.depth = path.depth + 1
            after.path.o = x
            after.path.d = wo
            after.path.t_max = FAR
            after.path.throughput = beta * throughput
            after.path.pdf = pdf
            after.path.eta = path.eta
            after.medium = state.medium
            after.steps = state.steps + 1
            after.crossings = state.crossings
        return r, after

    return collide


@functools.cache
def make_media_step(config: PathConfig, differential: bool, explores: bool = False, clocked: bool = True):
    """Return ``media_step(scene, sampler, state, max_depth, rr_depth) -> (MediaVertex, MediaState)``.

    ``differential``: keep going where one factor is exactly zero, since its derivative may not be. ``explores``: also
    the density may be zero, and collide (``Flight``); in grids by a clock, unless not ``clocked``.
    """
    assert config.media is not None
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    flight = make_flight(config.media, explores)
    tracked_flight, _tracked_transmittance = make_tracking(config.media, explores and clocked)
    grids = config.media.grids
    flakes = PHASE_SGGX in config.media.phases
    flake_length = make_flake_length(config.media.phases)
    emissive = config.media.emissive
    emitted_along = make_emission(config.media.phases)
    emitted_in_grid = make_grid_emission(config.media) if emissive and grids else None
    collide = make_collision(config, differential)
    passage = make_media_passage(config, differential)
    emission_hit = make_emission_hit(config.lights, has_null_lobes(config.surfaces.bsdfs))
    scatter = make_scatter(config, differential)
    has_smooth = interaction.bsdf.has_smooth
    has_lights = bool(config.lights.area or config.lights.others)
    surface_lights = samples_lights(config.lights, config.surfaces.bsdfs)
    sample_light = make_light_sampler(config.lights) if has_lights else None
    next_event = make_next_event(config.surfaces, config.lights, differential) if surface_lights else None
    through_event = make_through_event(config.surfaces, config.lights) if surface_lights else None
    sample_4d = make_sampler(config.sampler).sample_4d
    nulls = has_null_lobes(config.surfaces.bsdfs)
    null_model = null_model_of(config.surfaces.bsdfs)
    is_interface, past = make_null_surface(config.surfaces, config.lights)
    step_off = make_leaving(config.surfaces.primitives)

    @wp.func
    def plane_at(scene: Scene, hit: RayHit) -> tuple[wp.vec3, wp.vec3]:
        """The normal of a surface at a hit, and a point of its tangent plane."""
        tri = triangle_at(scene, hit.face)
        if wp.static(len(config.surfaces.primitives) > 0):
            if is_primitive(tri):
                met = interaction.surface(scene, hit.face, hit.u, hit.v)
                return met.ng, met.x
        return tri.normal, tri.p0

    @wp.func
    def cross(
        scene: Scene, sampler: Sampler, state: MediaState, vertex: MediaVertex, path: PathState, hit: RayHit
    ) -> tuple[MediaVertex, MediaState]:
        """Pass a surface that is not there; ``path``: behind the flight of ``vertex``, which started in ``state``."""
        at = past(scene, hit.face, hit.u, hit.v, path.d)
        scatter_sample = ScatterSample()
        scatter_sample.wo = path.d
        scatter_sample.inv_pdf = 1.0
        scatter_sample.beta = wp.vec3(1.0, 1.0, 1.0)
        after = MediaState()
        after.crossings = state.crossings + 1
        lost = is_lost(scene, at.shape, at.ng, path.d, state.medium) or after.crossings > MOST_INTERFACES
        if lost:
            count_invalid(scene, sampler)
            scatter_sample.lobe = LOBE_NONE
            scatter_sample.beta = wp.vec3(0.0, 0.0, 0.0)
        else:
            scatter_sample.lobe = LOBE_NULL
            after.steps = state.steps + 1
            after.medium = medium_towards(scene, at.shape, at.ng, path.d, path.d, state.medium)
            after.path.alive = 1
            after.path.depth = path.depth
            after.path.o = at.x
            after.skip = at.o - at.x
            cosine = wp.max(wp.abs(wp.dot(at.ng, path.d)), GRAZING)
            after.least = told_apart(triangle_at(scene, hit.face)) / cosine
            after.path.d = path.d
            after.path.t_max = FAR
            after.path.throughput = path.throughput
            after.path.eta = path.eta
            # As ``make_scatter`` has it.
            after.path.pdf = path.pdf
            after.path.seen.t = path.seen.t + wp.length(at.x - path.o)
        r = vertex
        r.surface = vertex_of(path, hit, EmissionHit(), False, NextEvent(), True, scatter_sample)
        return r, after

    @wp.func
    def media_step(
        scene: Scene, sampler: Sampler, state_in: MediaState, max_depth: wp.int32, rr_depth: wp.int32
    ) -> tuple[MediaVertex, MediaState]:
        state = state_in
        # Each number is drawn where it is used: most steps of a path cross interfaces or leave the scene.
        slot = 1 + SLOTS_PER_STEP * state.steps
        u4 = wp.vec4(0.0, 0.0, 0.0, 0.0)
        path = state.path
        hit = visibility.seen(scene, path.o + state.skip, path.d, path.t_max, path.depth)
        lead = wp.dot(state.skip, path.d)
        if hit.face >= 0:
            hit.t += lead
            if lead > 0.0:
                # Where the ray itself meets the tangent plane: the one that is cast runs beside it.
                n, point = plane_at(scene, hit)
                across = wp.dot(n, path.d)
                if wp.abs(across) > GRAZING:
                    hit.t = wp.clamp(wp.dot(n, point - path.o) / across, 0.0, hit.t)
        scatters = max_depth < 0 or path.depth + 1 < max_depth
        # ---- Flight ----
        vertex = MediaVertex()
        vertex.medium = state.medium
        vertex.step = state.steps
        vertex.before = path.throughput
        vertex.inv_p = 1.0
        vertex.weight = wp.vec3(1.0, 1.0, 1.0)
        if state.medium >= 0:
            length = path.t_max
            end = path.t_max
            if hit.face >= 0:
                length = hit.t
                # As far before the surface as rays start off it: rounded, a point would be behind it, and lost.
                tri = triangle_at(scene, hit.face)
                normal, _point = plane_at(scene, hit)
                cosine = wp.max(wp.abs(wp.dot(normal, path.d)), GRAZING)
                end = hit.t - step_off(scene, tri) / cosine
            vertex.length = wp.max(end, 0.0)
            if wp.static(emissive):
                vertex.stretch = length
                shining = scene.media.records[state.medium]
                if wp.static(grids):
                    if shining.sigma_t_channels == GRID:
                        vertex.emitted = emitted_in_grid(scene, shining, path.o, path.d, length, sampler, state.steps)
                    else:
                        vertex.emitted = emitted_along(scene, shining, path.d, length)
                else:
                    vertex.emitted = emitted_along(scene, shining, path.d, length)
            u = sample_4d(sampler, slot)
            m = scene.media.records[state.medium]
            f = Flight()
            in_grid = wp.bool(False)
            if wp.static(grids):
                in_grid = m.sigma_t_channels == GRID
                if in_grid:
                    f = tracked_flight(scene, m, path.o, path.d, length, end, sampler, state.steps, scatters)
            if not in_grid:
                if wp.static(flakes):
                    optical = flake_length(scene, m, path.d, 1.0)
                    optical_length = flake_length(scene, m, path.d, length)
                    f = flight(scene, m, optical_length, optical * end, hit.face < 0, u, state.steps, scatters)
                    f.t = wp.where(f.collides, wp.min(f.t / optical, end), length)
                else:
                    f = flight(scene, m, length, end, hit.face < 0, u, state.steps, scatters)
            if f.collides:
                f.t = wp.max(f.t, wp.min(state.least, end))
            vertex.passed = f.passed
            vertex.t = f.t
            vertex.inv_p = f.inv_p
            vertex.weight = f.weight
            path.throughput = wp.cw_mul(path.throughput, f.weight)
            path.pdf *= f.passing
            vertex.collides = f.collides
        # ---- Collision ----
        if vertex.collides:
            vertex.surface.face = hit.face
            vertex.surface.u = hit.u
            vertex.surface.v = hit.v
            vertex.surface.previous_face = -1
            vertex.surface.light = -1
            vertex.surface.lobe = LOBE_NONE
            vertex.surface.o = path.o
            vertex.surface.d = path.d
            vertex.surface.throughput = path.throughput
            if not finite(path.throughput):
                vertex.surface.direct = wp.vec3(wp.NAN, wp.NAN, wp.NAN)
                return vertex, MediaState()
            # Behind a second factor that is zero there is no derivative either.
            goes_on = not vanishes(path.throughput)
            if wp.static(differential):
                goes_on = not (vanishes(vertex.before) and vanishes(vertex.weight))
            if goes_on:
                if wp.static(has_lights):
                    u4 = sample_4d(sampler, slot + 1)
                r4 = sample_4d(sampler, slot + 2)
                reached, after = collide(scene, sampler, state, vertex, u4, r4, max_depth, rr_depth)
                return reached, after
            return vertex, MediaState()
        # ---- Interface ----
        if wp.static(null_model >= 0):
            passes_on = wp.static(differential) or not vanishes(path.throughput)
            if is_interface(scene, hit.face) and passes_on and finite(path.throughput):
                if scene.shapes[triangle_at(scene, hit.face).shape].emitter < 0:
                    crossed, after = cross(scene, sampler, state, vertex, path, hit)
                    return crossed, after
        # ---- Surface, or what lies behind all of them ----
        emission = emission_hit(scene, path, hit)
        event = NextEvent()
        scatter_sample = ScatterSample()
        unoccluded = wp.bool(False)
        goes_on = wp.bool(False)
        after = MediaState()
        if emission.on_surface == 1:
            at = interaction.at(scene, hit.face, hit.u, hit.v, path.d)
            passes = wp.bool(False)
            if wp.static(nulls):
                passes = interaction.bsdf.has_null(at.model)
            goes_on = scatters or passes
            if is_lost(scene, at.shape, at.ng, path.d, state.medium):
                count_invalid(scene, sampler)
                goes_on = False
            if goes_on:
                last = rr_depth
                if wp.static(null_model >= 0):
                    last = wp.where(at.model == null_model, NEVER, rr_depth)
                r4 = sample_4d(sampler, slot + 2)
                scatter_sample = scatter(at, path, hit.face, r4, last)
                after.path = scatter_sample.after
                after.steps = state.steps + 1
                after.crossings = state.crossings
                if scatter_sample.lobe == LOBE_NULL:
                    after.path.depth = path.depth
                    after.crossings += 1
                    if after.crossings > MOST_INTERFACES:
                        count_invalid(scene, sampler)
                        after.path.alive = 0
                elif not scatters:
                    after.path.alive = 0
                if after.path.alive == 0:
                    scatter_sample.lobe = LOBE_NONE
                    black = wp.vec3(0.0, 0.0, 0.0)
                    scatter_sample.beta = where3(scatter_sample.invalid == 1, scatter_sample.beta, black)
                after.medium = medium_towards(scene, at.shape, at.ng, path.d, after.path.d, state.medium)
                if wp.static(surface_lights):
                    if scatters and has_smooth(at.model):
                        u4 = sample_4d(sampler, slot + 1)
                        ls, light, _probability = sample_light(scene, at.x, u4)
                        event = next_event(at, ls, light)
                        if event.traces_shadow_ray == 1:
                            vertex.shadow_o = event.o
                            vertex.shadow_d = event.d
                            vertex.shadow_t = event.t_max
                            vertex.shadow_medium = medium_towards(scene, at.shape, at.ng, path.d, ls.wi, state.medium)
                            draws = max_depth < 0 or path.depth + 2 < max_depth
                            passed, first = passage(
                                scene,
                                event.o,
                                event.d,
                                event.t_max,
                                vertex.shadow_medium,
                                draws,
                                sampler,
                                state.steps,
                            )
                            unoccluded = passed.blocked == 0
                            if unoccluded:
                                vertex.shadow_hit = first
                                vertex.shadow_crossings = passed.crossings
                                vertex.transmittance = transmittance_of(passed)
                                event = through_event(at, ls, event, passed.probability, vertex.transmittance)
                            elif passed.blocked == 2:
                                count_invalid(scene, sampler)
        vertex.surface = vertex_of(path, hit, emission, unoccluded, event, goes_on, scatter_sample)
        return vertex, after

    return media_step

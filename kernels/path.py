"""The path loop: camera ray, emission, next-event estimation, scattering, Russian roulette.

At every vertex L_n = E_n + D_n + beta_n L_{n+1} [Vea97]: E_n is the emission that the incoming ray hits, D_n the
next-event estimate, and beta_n = f_s / (p q). ``path_step`` computes one vertex and the state from which the next one
follows. Depth counts as in Mitsuba's ``path``.

Derivation: ``docs/theory/interior.md#the-path-loop``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import (
    CAMERA_IRRADIANCEMETER,
    CAMERA_RADIANCEMETER,
    LOBE_NONE,
    LOBE_SMOOTH,
    PI,
    RFILTER_BOX,
)
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.notes import NOTE_VERTEX, note
from warp_psdr.kernels.property import make_property_step
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.scattering import (
    SLOTS_PER_VERTEX,
    EmissionHit,
    NextEvent,
    ScatterSample,
    make_emission_hit,
    make_light_sampler,
    make_next_event,
    make_scatter,
    make_through_event,
    samples_lights,
)
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_rays, make_lens
from warp_psdr.kernels.sensor.film import make_pixel_offset, uniform_offset
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.transmittance import MOST_CROSSINGS, make_passage, most_crossings, transmittance_of
from warp_psdr.kernels.vertex import PathConfig, PathState, PathVertex, film_position, path_from
from warp_psdr.kernels.visibility import visibility_of


@wp.func
def vertex_of(
    state: PathState,
    hit: RayHit,
    emission: EmissionHit,
    unoccluded: wp.bool,
    event: NextEvent,
    scatters: wp.bool,
    scatter_sample: ScatterSample,
) -> PathVertex:
    """What a path leaves of a vertex.

    ``unoccluded``: its shadow ray was free; ``scatters``: a direction was drawn there.
    """
    vertex = PathVertex()
    vertex.face = hit.face
    vertex.u = hit.u
    vertex.v = hit.v
    vertex.previous_face = state.left_face - 1
    vertex.o = state.o
    vertex.d = state.d
    vertex.throughput = state.throughput
    direct = emission.direct + where3(unoccluded, event.value, wp.vec3(0.0, 0.0, 0.0))
    vertex.direct = where3(scatters and scatter_sample.invalid == 1, wp.vec3(wp.NAN, wp.NAN, wp.NAN), direct)
    vertex.e_weight = emission.weight
    vertex.light = wp.where(unoccluded, event.light, -1)
    vertex.light_face = event.face
    vertex.light_u = event.u
    vertex.light_v = event.v
    vertex.light_wi = event.wi
    vertex.light_weight = event.weight
    vertex.lobe = wp.where(scatters, scatter_sample.lobe, LOBE_NONE)
    vertex.wo = scatter_sample.wo
    vertex.inv_pdf = scatter_sample.inv_pdf
    vertex.beta = where3(scatters, scatter_sample.beta, wp.vec3(0.0, 0.0, 0.0))
    return vertex


@functools.cache
def make_path_step(config: PathConfig, differential: bool, sparse: bool = False, traced: bool = False):
    """Return ``path_step(scene, sampler, state, max_depth, rr_depth) -> (PathVertex, PathState)``.

    ``differential``: keep going where a factor is exactly zero, since its derivative may not be. ``sparse``: leave out
    next-event estimates before the path meets a shape that matters (``interior/replay.py``). ``traced``: the camera's
    ray has been, ``state.seen`` is what it meets.
    """
    if config.shown:
        return make_property_step(config, traced)
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    emission_hit = make_emission_hit(config.lights, config.through)
    scatter = make_scatter(config, differential)
    has_smooth = interaction.bsdf.has_smooth
    has_lights = samples_lights(config.lights, config.surfaces.bsdfs)
    sample_light = make_light_sampler(config.lights) if has_lights else None
    next_event = make_next_event(config.surfaces, config.lights, differential) if has_lights else None
    sample_4d = make_sampler(config.sampler).sample_4d
    through = (config.through or config.points_pass) and has_lights
    passage = make_passage(config, differential) if through else None
    through_event = make_through_event(config.surfaces, config.lights) if through else None

    @wp.func
    def path_step(
        scene: Scene, sampler: Sampler, state: PathState, max_depth: wp.int32, rr_depth: wp.int32
    ) -> tuple[PathVertex, PathState]:
        # Drawn before the ray is traced: a CPU that executes out of order does both at once.
        if wp.static(config.scatter):
            if wp.static(has_lights):
                u4 = sample_4d(sampler, 1 + SLOTS_PER_VERTEX * state.depth)
            r4 = sample_4d(sampler, 2 + SLOTS_PER_VERTEX * state.depth)
        if wp.static(traced):
            hit = state.seen
            if state.depth > 0:
                hit = visibility.closest(scene, state.o, state.d, state.t_max)
        else:
            hit = visibility.seen(scene, state.o, state.d, state.t_max, state.depth)
        emission = emission_hit(scene, state, hit)
        event = NextEvent()
        scatter_sample = ScatterSample()
        unoccluded = wp.bool(False)
        scatters = wp.bool(False)
        if wp.static(config.scatter):
            scatters = emission.on_surface == 1 and (max_depth < 0 or state.depth + 1 < max_depth)
            if scatters:
                at = interaction.at(scene, hit.face, hit.u, hit.v, state.d)
                # The new direction is drawn before the shadow ray is traced: again the two overlap, and what depends on
                # the light's visibility, which is guessed badly, is short.
                scatter_sample = scatter(at, state, hit.face, r4, rr_depth)
                traces_shadow_ray = wp.bool(True)
                if wp.static(config.delta_first):
                    traces_shadow_ray = state.depth > 0
                    if state.depth == 0 and scatter_sample.lobe == LOBE_SMOOTH:
                        scatter_sample.lobe = LOBE_NONE
                        scatter_sample.beta = wp.vec3(0.0, 0.0, 0.0)
                        scatter_sample.after.alive = 0
                if wp.static(sparse):
                    scatter_sample.after.touched_requested = state.touched_requested + scene.requested_shapes[at.shape]
                    traces_shadow_ray = traces_shadow_ray and scatter_sample.after.touched_requested > 0
                if wp.static(has_lights):
                    if traces_shadow_ray and has_smooth(at.model):
                        ls, light, _probability = sample_light(scene, at.x, u4)
                        event = next_event(at, ls, light)
                        if event.traces_shadow_ray == 1:
                            if wp.static(through):
                                if wp.static(config.points_pass) and ls.delta == 0:
                                    unoccluded = not visibility.occluded(scene, event.o, event.d, event.t_max)
                                else:
                                    most = most_crossings(state.depth, max_depth)
                                    passed = passage(scene, event.o, event.d, event.t_max, most)
                                    unoccluded = passed.blocked == 0
                                    if unoccluded and passed.crossings > 0:
                                        product = transmittance_of(passed)
                                        event = through_event(at, ls, event, passed.probability, product)
                                    if passed.blocked == 2 and passed.crossings == MOST_CROSSINGS:
                                        count_invalid(scene, sampler)
                            else:
                                unoccluded = not visibility.occluded(scene, event.o, event.d, event.t_max)
        return vertex_of(state, hit, emission, unoccluded, event, scatters, scatter_sample), scatter_sample.after

    if not config.noted:
        return path_step

    @wp.func
    def noted_step(
        scene: Scene, sampler: Sampler, state: PathState, max_depth: wp.int32, rr_depth: wp.int32
    ) -> tuple[PathVertex, PathState]:
        r, after = path_step(scene, sampler, state, max_depth, rr_depth)
        note(scene, NOTE_VERTEX, r.face, r.u, r.v, r.o, r.d, r.throughput, r.direct, r.beta)
        return r, after

    return noted_step


@functools.cache
def make_path_radiance(config: PathConfig):
    """Return ``path_radiance(scene, sampler, state, max_depth, rr_depth) -> vec3``.

    It is what a path finds that goes on from the state, over its throughput up to there.
    """
    path_step = make_path_step(config, False)

    @wp.func
    def path_radiance(
        scene: Scene, sampler: Sampler, start: PathState, max_depth: wp.int32, rr_depth: wp.int32
    ) -> wp.vec3:
        state = start
        state.throughput = wp.vec3(1.0, 1.0, 1.0)
        radiance = wp.vec3(0.0, 0.0, 0.0)
        while state.alive == 1:
            vertex, state = path_step(scene, sampler, state, max_depth, rr_depth)
            radiance += wp.cw_mul(vertex.throughput, vertex.direct)
        return radiance

    return path_radiance


@functools.cache
def make_camera_starts(config: PathConfig, filter_kind: int | None = None):
    """Return ``(view, start_in)`` for many paths: ``start_in(scene, camera, view(scene, camera), px, py, sampler)``.

    The result is ``(PathState, CameraSample)``. ``filter_kind``: RFILTER_BOX draws positions uniformly in the pixel;
    None draws from the film's own filter.
    """
    sample_4d = make_sampler(config.sampler).sample_4d
    pixel_offset = uniform_offset if filter_kind == RFILTER_BOX else make_pixel_offset(config.filter)
    view, ray_in = make_camera_rays(config.camera)
    lens_point = make_lens(config.camera)

    @wp.func
    def start_in(
        scene: Scene, camera: Camera, k: wp.float32, px: wp.int32, py: wp.int32, sampler: Sampler
    ) -> tuple[PathState, CameraSample]:
        u4 = sample_4d(sampler, 0)
        sample = CameraSample()
        sample.film = film_position(camera, px, py, pixel_offset(camera, px, py, wp.vec2(u4[0], u4[1])))
        if wp.static(config.camera == CAMERA_RADIANCEMETER):
            sample.film = wp.vec2(0.5, 0.5)
        sample.lens = lens_point(wp.vec2(u4[2], u4[3]))
        ray = ray_in(scene, camera, k, sample)
        state = path_from(ray.o + ray.t_min * ray.d, ray.d, ray.t_max - ray.t_min, 0)
        if wp.static(config.camera == CAMERA_IRRADIANCEMETER):
            state.throughput = wp.vec3(PI, PI, PI)
        return state, sample

    return view, start_in


@functools.cache
def make_camera_start(config: PathConfig, filter_kind: int | None = None):
    """Return ``start(scene, camera, px, py, sampler) -> (PathState, CameraSample)``; arguments as above."""
    view, start_in = make_camera_starts(config, filter_kind)

    @wp.func
    def start(
        scene: Scene, camera: Camera, px: wp.int32, py: wp.int32, sampler: Sampler
    ) -> tuple[PathState, CameraSample]:
        state, sample = start_in(scene, camera, view(scene, camera), px, py, sampler)
        return state, sample

    return start

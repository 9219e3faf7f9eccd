"""The image by bidirectional paths: camera paths and light paths, each weighted over all ways to draw it.

A camera path finds light by hitting it and by next-event estimation, as in ``path.py``. A light path is joined to the
camera, as in ``light_path.py``. The balance heuristic over these three techniques weights every path [Vea97, section
10.2]: light paths take caustics, and camera paths take what glossy surfaces and mirrors show. Weights are detached, so
the derivatives of both kinds of paths stay as they are.

Derivation: ``docs/theory/light_tracing.md#all-cuts-of-a-path``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bidirectional_weights import (
    LEAST_COSINE,
    Cuts,
    cuts_at,
    cuts_of,
    make_emission_density,
    make_hit_weight,
    make_light_end,
)
from warp_psdr.kernels.constants import (
    CAMERA_IRRADIANCEMETER,
    LOBE_DELTA_TRANSMISSION,
    LOBE_NONE,
    LOBE_NULL,
    LOBE_SMOOTH,
    PI,
)
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.light_path import LightState, LightVertex, make_light_path
from warp_psdr.kernels.light_ray import LightRay
from warp_psdr.kernels.path import vertex_of
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.scattering import (
    SLOTS_PER_VERTEX,
    NextEvent,
    ScatterSample,
    make_emission_hit,
    make_light_sampler,
    make_next_event,
    make_scatter,
    make_through_event,
)
from warp_psdr.kernels.sensor.camera import CameraSample
from warp_psdr.kernels.sensor.projection import make_projection
from warp_psdr.kernels.structs import Camera, LightSample, Scene
from warp_psdr.kernels.transmittance import MOST_CROSSINGS, make_passage, most_crossings, transmittance_of
from warp_psdr.kernels.vertex import LightConfig, PathConfig, PathState, PathVertex, SurfaceConfig
from warp_psdr.kernels.visibility import visibility_of


@functools.cache
def make_delta_turn(surfaces: SurfaceConfig, lights: LightConfig):
    """Return ``delta_turn(at, wo, lobe) -> float32``: density of a delta lobe's direction back over that of it.

    Refraction changes the solid angle; the probability of the lobe is taken to be the same from both sides.
    """
    interaction = make_interaction(surfaces, lights)
    record = interaction.record
    relative_eta = interaction.bsdf.relative_eta

    @wp.func
    def delta_turn(at: record, wo: wp.vec3, lobe: wp.int32) -> wp.float32:
        eta = wp.float32(1.0)
        if wp.static(relative_eta is not None):
            if lobe == LOBE_DELTA_TRANSMISSION:
                eta = relative_eta(at.model, at.material, at.wi)
        return wp.abs(at.wi[2]) / (wp.max(wp.abs(wo[2]), LEAST_COSINE) * eta * eta)

    return delta_turn


@wp.struct
class CameraWalk:
    """A path from the camera, and what its last vertex leaves for the next one's ``Cuts``."""

    path: PathState
    near: wp.float32  # over a squared distance and a cosine
    far: wp.float32  # over a cosine
    lens: wp.vec2  # what ``project`` chooses the ray's origin with
    cuts: Cuts  # at that vertex


@functools.cache
def make_walk_from(kind: int):
    """Return ``walk_from(state, sample) -> CameraWalk``: the path behind a ray of a kind of camera."""

    @wp.func
    def walk_from(state: PathState, sample: CameraSample) -> CameraWalk:
        walk = CameraWalk()
        walk.path = state
        walk.lens = sample.lens
        if wp.static(kind == CAMERA_IRRADIANCEMETER):
            walk.lens = sample.film
        return walk

    return walk_from


@functools.cache
def make_ray_density(kind: int):
    """Return ``ray_density(camera, weight) -> float32``: density of the camera's rays, over the number of light paths.

    ``weight``: what a unit of area across the ray, or anything in proportion to it, counts for the film. A camera draws
    rays as it weighs them; a meter weighs them with a cosine, and draws that over pi.
    """

    @wp.func
    def ray_density(camera: Camera, weight: wp.float32) -> wp.float32:
        paths = wp.float32(camera.crop_width) * wp.float32(camera.crop_height)
        if wp.static(kind == CAMERA_IRRADIANCEMETER):
            paths *= PI
        return weight / paths

    return ray_density


@functools.cache
def make_camera_cuts(config: PathConfig):
    """Return ``(cuts_behind, walk_on, share_of_lights)``.

    ``cuts_behind(scene, camera, walk, at) -> Cuts`` of the vertex ``at`` that a path meets;
    ``walk_on(at, walk, cuts, scattered) -> CameraWalk``: what the vertex leaves for the next one;
    ``share_of_lights(scene, at, cuts, ls, light, crossed) -> float32``: weight of a next-event estimate; ``crossed``:
    probability of the null lobes that its shadow ray crosses.
    """
    interaction = make_interaction(config.surfaces, config.lights)
    record = interaction.record
    emission_density = make_emission_density(config.lights)
    project = make_projection(config.camera)[0]
    delta_turn = make_delta_turn(config.surfaces, config.lights)
    ray_density = make_ray_density(config.camera)

    @wp.func
    def cuts_behind(scene: Scene, camera: Camera, walk: CameraWalk, at: record) -> Cuts:
        cosine = wp.abs(wp.dot(at.ng, walk.path.d))
        near = walk.near * wp.length_sq(at.x - walk.path.o)
        if walk.path.depth == 0:
            # As many light paths as the image has pixels, of which the camera's film is a unit each.
            seen = project(scene, camera, at.x, walk.lens)
            near = 1.0 / wp.max(ray_density(camera, seen.per_area), 1.0e-30)
        return cuts_at(near, walk.far, cosine)

    @wp.func
    def walk_on(at: record, walk: CameraWalk, cuts: Cuts, scattered: ScatterSample) -> CameraWalk:
        after = CameraWalk()
        after.path = scattered.after
        after.lens = walk.lens
        after.cuts = cuts
        leaving = wp.abs(wp.dot(at.ng, scattered.wo))
        wo = enter_frame(at.frame, scattered.wo)
        if scattered.lobe == LOBE_SMOOTH:
            turned = at
            turned.wi = wo
            after.far = cuts_of(cuts, interaction.pdf(turned, at.wi), leaving) / scattered.after.pdf
            if wp.static(config.connections == "all"):
                after.near = 1.0 / scattered.after.pdf
        elif scattered.lobe > LOBE_SMOOTH:
            after.far = cuts_of(Cuts(0.0, cuts.far), delta_turn(at, wo, scattered.lobe), leaving)
        return after

    @wp.func
    def share_of_lights(
        scene: Scene, at: record, cuts: Cuts, ls: LightSample, light: wp.int32, crossed: wp.float32
    ) -> wp.float32:
        wo = enter_frame(at.frame, ls.wi)
        turned = at
        turned.wi = wo
        by_lights = cuts_of(cuts, interaction.pdf(turned, at.wi), wp.abs(wp.dot(at.ng, ls.wi)))
        others = by_lights * emission_density(scene, light, ls.face, ls.distance, ls.wi, ls.pdf, at.x)
        if ls.delta == 0:
            others += interaction.pdf(at, wo)
        return 1.0 / (1.0 + crossed * others / (ls.pdf * ls.probability))

    return cuts_behind, walk_on, share_of_lights


@functools.cache
def make_camera_walk(config: PathConfig, differential: bool, traced: bool):
    """Return ``camera_walk(scene, camera, sampler, walk, max_depth, rr_depth) -> (PathVertex, CameraWalk)``.

    One vertex, as ``make_path_step``'s function, whose arguments these are.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    emission_hit = make_emission_hit(config.lights, config.through)
    hit_weight = make_hit_weight(config.lights, config.through)
    scatter = make_scatter(config, differential)
    has_smooth = interaction.bsdf.has_smooth
    sample_light = make_light_sampler(config.lights)
    next_event = make_next_event(config.surfaces, config.lights, differential)
    sample_4d = make_sampler(config.sampler).sample_4d
    passage = make_passage(config, differential) if config.through else None
    through_event = make_through_event(config.surfaces, config.lights) if config.through else None
    cuts_behind, walk_on, share_of_lights = make_camera_cuts(config)

    @wp.func
    def camera_walk(
        scene: Scene, camera: Camera, sampler: Sampler, walk: CameraWalk, max_depth: wp.int32, rr_depth: wp.int32
    ) -> tuple[PathVertex, CameraWalk]:
        path = walk.path
        u4 = sample_4d(sampler, 1 + SLOTS_PER_VERTEX * path.depth)
        r4 = sample_4d(sampler, 2 + SLOTS_PER_VERTEX * path.depth)
        if wp.static(traced):
            hit = path.seen
            if path.depth > 0:
                hit = visibility.closest(scene, path.o, path.d, path.t_max)
        else:
            hit = visibility.seen(scene, path.o, path.d, path.t_max, path.depth)
        alone = path
        alone.pdf = 0.0  # the whole weight is given here
        emission = emission_hit(scene, alone, hit)
        weight = hit_weight(scene, path, hit.face, hit.t, walk.far)
        emission.weight *= weight
        emission.direct = weight * emission.direct
        event = NextEvent()
        scattered = ScatterSample()
        after = CameraWalk()
        unoccluded = wp.bool(False)
        scatters = emission.on_surface == 1 and (max_depth < 0 or path.depth + 1 < max_depth)
        if scatters:
            at = interaction.at(scene, hit.face, hit.u, hit.v, path.d)
            cuts = cuts_behind(scene, camera, walk, at)
            scattered = scatter(at, path, hit.face, r4, rr_depth)
            after = walk_on(at, walk, cuts, scattered)
            if has_smooth(at.model):
                ls, light, _probability = sample_light(scene, at.x, u4)
                whole = ls
                whole.delta = 1  # likewise
                event = next_event(at, whole, light)
                if event.traces_shadow_ray == 1:
                    crossed = wp.float32(1.0)
                    if wp.static(config.through):
                        most = most_crossings(path.depth, max_depth)
                        passed = passage(scene, event.o, event.d, event.t_max, most)
                        unoccluded = passed.blocked == 0
                        if unoccluded and passed.crossings > 0:
                            crossed = passed.probability
                            event = through_event(at, whole, event, crossed, transmittance_of(passed))
                        if passed.blocked == 2 and passed.crossings == MOST_CROSSINGS:
                            count_invalid(scene, sampler)
                    else:
                        unoccluded = not visibility.occluded(scene, event.o, event.d, event.t_max)
                    share = share_of_lights(scene, at, cuts, ls, light, crossed)
                    event.weight *= share
                    event.value = share * event.value
        return vertex_of(path, hit, emission, unoccluded, event, scatters, scattered), after

    return camera_walk


@wp.struct
class LightWalk:
    """A light path, and what its last vertex leaves for the next one's ``Cuts``, as of ``CameraWalk``."""

    alive: wp.int32
    depth: wp.int32
    path: LightState
    near: wp.float32
    far: wp.float32
    origin: wp.vec3  # from which the squared distance is measured
    by_distance: wp.int32  # 0: ``near`` is over a cosine alone
    at_light: wp.int32  # 1: nothing but null lobes since the light
    cuts: Cuts


@functools.cache
def make_light_walk(config: PathConfig, differential: bool):
    """Return ``(record of the state, start, step)``, the functions as those of ``make_light_path``.

    With ``config.connections`` what a vertex sends to the camera has its weight.
    """
    start, step = make_light_path(config, differential)
    if not config.connections:
        return LightState, start, step
    interaction = make_interaction(config.surfaces, config.lights)
    bsdf = interaction.bsdf
    light_end = make_light_end(config.lights)
    delta_turn = make_delta_turn(config.surfaces, config.lights)
    ray_density = make_ray_density(config.camera)

    @wp.func
    def start_walk(scene: Scene, sphere: wp.vec4, sampler: Sampler) -> tuple[LightRay, LightWalk]:
        ray, state = start(scene, sphere, sampler)
        end = light_end(scene, ray)
        walk = LightWalk()
        walk.path = state
        walk.alive = state.alive
        walk.near = end.near
        walk.far = end.far
        walk.origin = end.origin
        walk.by_distance = end.by_distance
        walk.at_light = 1
        return ray, walk

    @wp.func
    def weighted(scene: Scene, camera: Camera, vertex: LightVertex, cuts: Cuts, cosine: wp.float32) -> LightVertex:
        """A vertex that is joined to the camera, with its weight."""
        r = vertex
        here = interaction.at(scene, vertex.face, vertex.u, vertex.v, -vertex.to_camera)
        pdf = interaction.pdf(here, enter_frame(here.frame, -vertex.d))
        if pdf > 0.0:
            share = 1.0 / (1.0 + ray_density(camera, cuts_of(cuts, pdf, vertex.join * cosine)))
            r.join = share * vertex.join
            r.value = share * vertex.value
        return r

    @wp.func
    def step_walk(
        scene: Scene, camera: Camera, sampler: Sampler, walk: LightWalk, max_depth: wp.int32, rr_depth: wp.int32
    ) -> tuple[LightVertex, LightWalk]:
        vertex, state = step(scene, camera, sampler, walk.path, max_depth, rr_depth)
        after = LightWalk()
        after.path = state
        after.alive = state.alive
        after.depth = state.depth
        if vertex.face >= 0:
            at = interaction.at(scene, vertex.face, vertex.u, vertex.v, vertex.d)
            cosine = wp.abs(wp.dot(at.ng, vertex.d))
            near = walk.near
            if walk.by_distance == 1:
                near *= wp.length_sq(at.x - walk.origin)
            cuts = cuts_at(near, walk.far, cosine)
            after.cuts = cuts
            if vertex.joined == 1:
                vertex = weighted(scene, camera, vertex, cuts, cosine)
            wo = enter_frame(at.frame, vertex.wo)
            leaving = wp.abs(wp.dot(at.ng, vertex.wo))
            if vertex.lobe == LOBE_SMOOTH:
                turned = at
                turned.wi = wo
                pdf = interaction.pdf(turned, at.wi)  # of the direction to the light, from the camera's side
                inverse = 1.0 / wp.max(interaction.pdf(at, wo), 1.0e-30)
                if pdf > 0.0:
                    after.far = cuts_of(cuts, pdf, leaving) * inverse
                if wp.static(config.connections == "all"):
                    after.near = inverse
                    after.origin = at.x
                    after.by_distance = 1
            elif vertex.lobe != LOBE_NONE:
                after.far = cuts_of(Cuts(0.0, cuts.far), delta_turn(at, wo, vertex.lobe), leaving)
                if wp.static(config.through):
                    if vertex.lobe == LOBE_NULL and walk.at_light == 1:
                        # Next-event estimation passes it, without its probability.
                        after.near = walk.near / bsdf.probability(at.model, at.material, at.wi, LOBE_NULL)
                        after.origin = walk.origin
                        after.by_distance = walk.by_distance
                        after.at_light = 1
        return vertex, after

    return LightWalk, start_walk, step_walk

"""The path loop of ``path.py`` for as many samples as there are lanes, in step (``lanes.py``).

Each part of a vertex is a loop over all lanes. Rare events (emitters that are hit, rays that leave the scene), table
look-ups, and rays through a tree of several levels run lane by lane; the rest, which is most of the arithmetic, becomes
SIMD. Shapes without triangles are intersected after the triangles (``primitive_lanes.py``). Lanes whose path has ended
are computed too, and never read. A path has the bits that it has alone.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bvh.each import make_each
from warp_psdr.kernels.bvh.roots import make_roots
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.camera_rays import Bundle, column_of, make_trace_together, row_of
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.lanes.kept_lanes import make_kept_lanes
from warp_psdr.kernels.lanes.lanes import ROWS, Rows, make_number, stack_rows, word_of
from warp_psdr.kernels.lanes.light_lanes import make_light_lanes
from warp_psdr.kernels.lanes.model_lanes import make_model_lanes
from warp_psdr.kernels.lanes.place_lanes import PlaceLanes, make_place_lanes
from warp_psdr.kernels.lanes.primitive_lanes import make_primitive_lanes
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.path import make_camera_starts, vertex_of
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.scattering import (
    SLOTS_PER_VERTEX,
    NextEvent,
    ScatterSample,
    make_onward,
    make_scatter,
    make_through_event,
    samples_lights,
)
from warp_psdr.kernels.sensor.camera import CameraSample
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.transmittance import MOST_CROSSINGS, make_passage, most_crossings, transmittance_of
from warp_psdr.kernels.vertex import PathConfig, PathState
from warp_psdr.kernels.visibility import visibility_of_meshes

#: Rows of random numbers: for next-event estimation, for scattering.
NUMBERS = 8


@wp.struct
class LaneSample:
    """A lane's sample, and its pixel in the image."""

    sampler: Sampler
    px: wp.int32
    py: wp.int32
    number: wp.int32  # among those that are traced together


@wp.struct
class ShadowQuery:
    """A shadow ray: whether it is traced, meets what blocks it, and crosses surfaces that let light pass."""

    traces_shadow_ray: wp.int32
    blocked: wp.int32
    crosses: wp.int32


@wp.struct
class Sum:
    """What a path has gathered so far."""

    radiance: wp.vec3
    vertices: wp.int32


class LanePaths(NamedTuple):
    """Functions that trace paths side by side; all take ``Scene.rows``.

    Attributes:
        width: number of lanes.
        view: ``(scene, camera) -> float``, of which ``start`` takes the value.
        start: ``(scene, camera, view, pixels, bundle, first, touched_requested, rows)`` starts the samples of a bundle
            from the ``first``-th on, and traces their camera rays; ``touched_requested`` as in ``PathState``.
        step: ``(scene, depth, max_depth, rr_depth, rows) -> int``: one vertex of every path, behind ``depth`` others;
            the number of paths that have another one.
        trace: ``(scene, depth, rows)``, of ``step``: what the rays meet.
        scatter: ``(scene, standing, depth, max_depth, rr_depth, rows)``, of ``step``: what the paths scatter where they
            stand, ``standing`` as in ``PlaceLanes``.
        advance: ``(scattering, rows) -> int``, of ``step``: adds up what they have found, and gives them their next
            rays, if they were ``scattering``; the number of those that have one.
        gathered: ``(rows, j) -> Sum`` of the j-th path.
        camera: ``(rows, j) -> CameraSample``.
        vertex: ``(rows, j, n) -> PathVertex``, its n-th vertex; None if none are kept.
        record: ``(rows, j, n) -> RecordedVertex``, and what is kept with it; None if no such things are.
        light: ``(rows, j, n) -> KeptLight``, the one that was drawn there; None unless it is kept.
        lane_samples: ``LaneSample``, the paths' samples.
        cameras: ``CameraSample``, where they lie on the film.
        sums: ``Sum``, what they have gathered.
        states: ``PathState``, their rays.
        hits: ``RayHit``, what they meet.
        on_places: where they stand.
        end: the first row that is free; if there are fewer, none of the functions may be called.
    """

    width: int
    view: wp.Function
    start: wp.Function
    step: wp.Function
    trace: wp.Function
    scatter: wp.Function
    advance: wp.Function
    gathered: wp.Function
    camera: wp.Function
    vertex: wp.Function | None
    record: wp.Function | None
    light: wp.Function | None
    lane_samples: Rows
    cameras: Rows
    sums: Rows
    states: Rows
    hits: Rows
    on_places: PlaceLanes
    end: int


def side_by_side(config: PathConfig) -> bool:
    """Whether a scene's paths are traced so: on the CPU, unless what they meet is written down.

    Not beside light paths, which leave the camera's few surfaces. Nor in media, which paths collide in at random. Nor
    where shadow rays pass surfaces beside shapes without triangles, or to some lights alone. Properties of surfaces are
    no paths.
    """
    if config.media is not None or config.points_pass or (config.through and config.surfaces.primitives):
        return False
    alone = config.noted or config.delta_first or config.connections or config.shown
    return config.rays.backend == "wide" and not alone


@functools.cache
def make_lane_paths(
    config: PathConfig,
    differential: bool,
    sparse: bool = False,
    filter_kind: int | None = None,
    kept: int = 0,
    whole: bool = False,
    lit: bool = False,
) -> LanePaths:
    """Make the functions; arguments as those of ``make_path_step`` and ``make_camera_starts``.

    ``kept``: number of vertices that are kept of a path; none has more. ``whole``: their ``RecordedVertex``; ``lit``:
    with what was found of the lights.
    """
    width = config.rays.width
    visibility = visibility_of_meshes(config.rays)
    closest_of_each, any_of_each = make_each(width)
    enters_root = make_roots(width)
    trace_together = make_trace_together(config.rays)
    view, start_in = make_camera_starts(config, filter_kind)
    scatter, onward = make_scatter(config, differential), make_onward(config, differential)
    sample_4d = make_sampler(config.sampler).sample_4d
    has_lights = samples_lights(config.lights, config.surfaces.bsdfs)
    get_number, put_number = make_number(width)

    lane_samples, states, hits, cameras, sums = stack_rows(
        width, NUMBERS, LaneSample, PathState, RayHit, CameraSample, Sum
    )
    on_places = make_place_lanes(config, width, sums.end, states, hits)
    choices, places, emissions = on_places.choices, on_places.places, on_places.emissions
    scatter_samples, looks = stack_rows(width, emissions.end, ScatterSample, ShadowQuery)
    end, lights, models, evaluate_models = looks.end, None, None, None
    if len(config.surfaces.bsdfs) > 1:
        models = make_model_lanes(config.surfaces, config.lights, differential, width, end, places)
        end = models.values.end
    if has_lights:
        lights = make_light_lanes(
            config.surfaces, config.lights, differential, width, end, places, models.values if models else None
        )
        evaluate_models = models.make_evaluate(lights.samples) if models else None
        events = lights.events
        shadow_row = events.first + word_of(NextEvent, "o")
        end = events.end
    through = config.through and has_lights
    passage = make_passage(config, differential) if through else None
    through_event = make_through_event(config.surfaces, config.lights) if through else None
    hit_row, look_row, blocked_row = hits.first, looks.first, looks.first + word_of(ShadowQuery, "blocked")
    ray_row, alive_row = (states.first + word_of(PathState, name) for name in ("o", "alive"))
    exact = None
    if config.surfaces.primitives:
        exact = make_primitive_lanes(
            config.surfaces.primitives,
            config.rays.hidden,
            width,
            end,
            states,
            hits,
            lights.events if lights else None,
            looks,
        )
        end = exact.end
    store = make_kept_lanes(width, end, kept, whole, lit, on_places, lights, looks)

    @wp.func
    def start(
        scene: Scene,
        camera: Camera,
        k: wp.float32,
        pixels: wp.array(dtype=wp.int32),
        bundle: Bundle,
        first: wp.int32,
        touched_requested: wp.int32,
        rows: ROWS,
    ):
        count = wp.min(bundle.pixels * bundle.samples - first, width)
        i = wp.int32(first // bundle.samples)
        n = wp.int32(first % bundle.samples)
        j = wp.int32(0)
        lane_sample = LaneSample()
        while j < count:
            if n == bundle.samples:
                i += 1
                n = wp.int32(0)
            if j == 0 or n == 0:
                lane_sample.sampler = sampler_at(pixels[bundle.first + i], 0, bundle.seed)
                lane_sample.px = column_of(bundle, lane_sample.sampler)
                lane_sample.py = row_of(bundle, lane_sample.sampler)
            lane_sample.sampler.index = wp.uint32(bundle.first_sample + n)
            lane_sample.number = first + j
            lane_samples.put(rows, j, lane_sample)
            n += 1
            j += 1
        while j < width:  # the last one once more
            lane_samples.put(rows, j, lane_sample)
            j += 1
        j = wp.int32(0)
        while j < width:
            lane_sample = lane_samples.get(rows, j)
            state, sample = start_in(scene, camera, k, lane_sample.px, lane_sample.py, lane_sample.sampler)
            state.alive = wp.where(j < count, 1, 0)
            state.touched_requested = touched_requested
            states.put(rows, j, state)
            cameras.put(rows, j, sample)
            sums.put(rows, j, Sum())
            j += 1
        trace_together(scene, count, rows, ray_row, hit_row)

    @wp.func
    def draw_numbers(depth: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            sampler = lane_samples.get(rows, j).sampler
            if wp.static(has_lights):
                u4 = sample_4d(sampler, 1 + SLOTS_PER_VERTEX * depth)
                put_number(rows, 0, j, u4[0])
                put_number(rows, 1, j, u4[1])
                put_number(rows, 2, j, u4[2])
                put_number(rows, 3, j, u4[3])
            r4 = sample_4d(sampler, 2 + SLOTS_PER_VERTEX * depth)
            put_number(rows, 4, j, r4[0])
            put_number(rows, 5, j, r4[1])
            put_number(rows, 6, j, r4[2])
            put_number(rows, 7, j, r4[3])
            j += 1

    @wp.func
    def trace(scene: Scene, depth: wp.int32, rows: ROWS):
        """Closest hits; the camera's rays have been traced, but among shapes without triangles."""
        if depth > 0:
            if scene.accel.below_root > 0:
                closest_of_each(scene.accel, rows, ray_row, alive_row, hit_row)
            else:
                entering = enters_root(scene.accel, rows, ray_row, alive_row)
                j = wp.int32(0)
                while j < width:
                    state = states.get(rows, j)
                    if state.alive == 1:
                        hit = RayHit()
                        hit.t = state.t_max
                        hit.face = wp.int32(-1)
                        if (entering >> j) & 1 == 1:
                            hit = visibility.closest(scene, state.o, state.d, state.t_max)
                        hits.put(rows, j, hit)
                    j += 1
        if wp.static(exact is not None):
            exact.meet(scene, depth, rows)

    @wp.func
    def scatter_all(scene: Scene, rr_depth: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            state = states.get(rows, j)
            choice = choices.get(rows, j)
            place = places.get(rows, j)
            if wp.static(models is None):
                r4 = wp.vec4(
                    get_number(rows, 4, j), get_number(rows, 5, j), get_number(rows, 6, j), get_number(rows, 7, j)
                )
                scatter_sample = scatter(place, state, choice.face, r4, rr_depth)
            else:
                bs = models.drawn.get(rows, j)
                scatter_sample = onward(place, bs, state, choice.face, get_number(rows, 5, j), rr_depth)
            if wp.static(sparse):
                scatter_sample.after.touched_requested = state.touched_requested + scene.requested_shapes[place.shape]
            scatter_samples.put(rows, j, scatter_sample)
            j += 1

    @wp.func
    def pass_surfaces(scene: Scene, standing: wp.int32, most: wp.int32, rows: ROWS):
        """Shadow rays that meet anything, once more: through what lets light pass; each crosses as much as there is."""
        for j in range(standing):
            shadow = looks.get(rows, j)
            if shadow.traces_shadow_ray == 1 and shadow.blocked == 1:
                event = events.get(rows, j)
                passed = passage(scene, event.o, event.d, event.t_max, most)
                if passed.blocked == 0:
                    shadow.blocked = 0
                    shadow.crosses = 1
                    looks.put(rows, j, shadow)
                    transmittance = transmittance_of(passed)
                    ls = lights.samples.get(rows, j)
                    events.put(
                        rows, j, through_event(places.get(rows, j), ls, event, passed.probability, transmittance)
                    )
                elif passed.blocked == 2 and passed.crossings == MOST_CROSSINGS:
                    count_invalid(scene, lane_samples.get(rows, j).sampler)

    @wp.func
    def look(scene: Scene, rows: ROWS):
        """Shadow rays."""
        j = wp.int32(0)
        while j < width:
            traces_shadow_ray = choices.get(rows, j).on == 1
            traces_shadow_ray = traces_shadow_ray and events.get(rows, j).traces_shadow_ray == 1
            if wp.static(sparse):
                traces_shadow_ray = traces_shadow_ray and scatter_samples.get(rows, j).after.touched_requested > 0
            shadow = ShadowQuery()
            shadow.traces_shadow_ray = wp.where(traces_shadow_ray, 1, 0)
            looks.put(rows, j, shadow)
            j += 1
        if scene.accel.below_root > 0:
            any_of_each(scene.accel, rows, shadow_row, look_row, blocked_row)
        else:
            entering = enters_root(scene.accel, rows, shadow_row, look_row)
            j = wp.int32(0)
            while j < width:
                shadow = looks.get(rows, j)
                if shadow.traces_shadow_ray == 1 and (entering >> j) & 1 == 1:
                    event = events.get(rows, j)
                    if visibility.occluded(scene, event.o, event.d, event.t_max):
                        shadow.blocked = 1
                        looks.put(rows, j, shadow)
                j += 1
        if wp.static(exact is not None):
            exact.block(scene, rows)

    @wp.func
    def keep(depth: wp.int32, scattering: wp.bool, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            state = states.get(rows, j)
            hit = hits.get(rows, j)
            emission = emissions.get(rows, j)
            choice = choices.get(rows, j)
            scatter_sample = scatter_samples.get(rows, j)
            scatters = scattering and choice.on == 1
            event = NextEvent()
            unoccluded = wp.bool(False)
            if wp.static(has_lights):
                event = events.get(rows, j)
                shadow = looks.get(rows, j)
                unoccluded = scatters and shadow.traces_shadow_ray == 1 and shadow.blocked == 0
            vertex = vertex_of(state, hit, emission, unoccluded, event, scatters, scatter_sample)
            store.put(rows, j, depth, vertex)
            j += 1
        if wp.static(whole or lit):
            store.keep_rest(rows, depth)

    @wp.func
    def advance(scattering: wp.bool, rows: ROWS) -> wp.int32:
        alive = wp.int32(0)
        j = wp.int32(0)
        while j < width:
            state = states.get(rows, j)
            emission = emissions.get(rows, j)
            choice = choices.get(rows, j)
            scatter_sample = scatter_samples.get(rows, j)
            total = sums.get(rows, j)
            scatters = scattering and choice.on == 1
            direct = emission.direct
            if wp.static(has_lights):
                event = events.get(rows, j)
                shadow = looks.get(rows, j)
                unoccluded = scatters and shadow.traces_shadow_ray == 1 and shadow.blocked == 0
                direct += where3(unoccluded, event.value, wp.vec3(0.0, 0.0, 0.0))
            direct = where3(scatters and scatter_sample.invalid == 1, wp.vec3(wp.NAN, wp.NAN, wp.NAN), direct)
            # What lies in the rows of a path that has ended may be anything.
            gained = total.radiance + wp.cw_mul(state.throughput, direct)
            total.radiance = where3(state.alive == 1, gained, total.radiance)
            total.vertices += state.alive
            sums.put(rows, j, total)
            after = scatter_sample.after
            after.alive = wp.where(scatters, scatter_sample.after.alive, 0)
            states.put(rows, j, after)
            alive += after.alive
            j += 1
        return alive

    @wp.func
    def scatter_standing(
        scene: Scene, standing: wp.int32, depth: wp.int32, max_depth: wp.int32, rr_depth: wp.int32, rows: ROWS
    ):
        draw_numbers(depth, rows)
        standing_on = on_places.stand(scene, standing, rows)
        if wp.static(has_lights):
            lights.choose(scene, rows)
            lights.draw(scene, rows)
            if wp.static(models is not None):
                evaluate_models(standing_on, standing, rows)
            lights.estimate(rows)
        if wp.static(models is not None):
            models.draw(standing_on, standing, rows)
        scatter_all(scene, rr_depth, rows)
        if wp.static(has_lights):
            look(scene, rows)
            if wp.static(through):
                pass_surfaces(scene, standing, most_crossings(depth, max_depth), rows)

    @wp.func
    def step(scene: Scene, depth: wp.int32, max_depth: wp.int32, rr_depth: wp.int32, rows: ROWS) -> wp.int32:
        last = wp.static(not config.scatter) or (max_depth >= 0 and depth + 1 >= max_depth)
        trace(scene, depth, rows)
        standing = on_places.meet(scene, rows)
        scattering = standing > 0 and not last
        on_places.collect(scene, rows)
        if wp.static(config.scatter):
            if scattering:
                scatter_standing(scene, standing, depth, max_depth, rr_depth, rows)
        if wp.static(kept > 0):
            keep(depth, scattering, rows)
        return advance(scattering, rows)

    @wp.func
    def gathered(rows: ROWS, j: wp.int32) -> Sum:
        return sums.get(rows, j)

    @wp.func
    def camera_of(rows: ROWS, j: wp.int32) -> CameraSample:
        return cameras.get(rows, j)

    kept_parts = (store.vertex, store.record, store.light)
    traced = (lane_samples, cameras, sums, states, hits, on_places)
    parts = (trace, scatter_standing, advance)
    return LanePaths(width, view, start, step, *parts, gathered, camera_of, *kept_parts, *traced, store.end)

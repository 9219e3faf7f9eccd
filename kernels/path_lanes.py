"""The path loop of ``path.py`` for as many samples as there are lanes, in step (``lanes.py``).

Each part of a vertex is a loop over all lanes. Rays are traced, and what is rare (emitters that are hit, rays that
leave the scene, the search for a light) is done, lane by lane; the rest, which is most of the arithmetic, becomes SIMD.
Lanes whose path has ended are computed along and never looked at. A path has the bits that it has alone.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bvh.each import make_each
from warp_psdr.kernels.bvh.wide import RayHit, make_intersect
from warp_psdr.kernels.camera import CameraSample
from warp_psdr.kernels.camera_rays import Bundle, column_of, make_trace_together, row_of
from warp_psdr.kernels.constants import BSDF_DIFFUSE
from warp_psdr.kernels.lanes import ROWS, make_copy, make_fetch, make_number, make_record, word_of, words
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.path import make_camera_starts, vertex_of
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.scattering import (
    SLOTS_PER_VERTEX,
    Arrival,
    NextEvent,
    Onward,
    Place,
    make_arrive,
    make_light_draw,
    make_next_event,
    make_scatter,
    make_stand,
    samples_lights,
)
from warp_psdr.kernels.structs import Camera, LightSample, Scene, Triangle
from warp_psdr.kernels.vertex import PathConfig, PathState, PathVertex


@wp.struct
class Seat:
    """A lane's sample, and its pixel in the image."""

    sampler: Sampler
    px: wp.int32
    py: wp.int32


@wp.struct
class Choice:
    """What lane by lane is looked up for a vertex: its face, and the light of its next-event estimate."""

    on: wp.int32  # 1: the path stands on ``face``
    face: wp.int32
    light: wp.int32
    light_face: wp.int32


@wp.struct
class Look:
    """A shadow ray: whether it is traced, and whether it meets anything."""

    wanted: wp.int32
    blocked: wp.int32


@wp.struct
class Sum:
    """What a path has gathered so far."""

    radiance: wp.vec3
    vertices: wp.int32


class LanePaths(NamedTuple):
    """Functions that trace paths side by side; all take ``rows``, an array of ``size`` uint32.

    Attributes:
        width: number of lanes.
        size: words of the array.
        start: ``(scene, camera, pixels, bundle, met, rows)`` starts the samples of a bundle, and traces their camera
            rays; ``met`` as in ``PathState``.
        step: ``(scene, depth, max_depth, rr_depth, rows) -> int``: one vertex of every path, behind ``depth`` others;
            the number of paths that have another one.
        gathered: ``(rows, j) -> Sum`` of the j-th path.
        camera: ``(rows, j) -> CameraSample``.
        vertex: ``(rows, j, n) -> PathVertex``, its n-th vertex; None if none are kept.
    """

    width: int
    size: int
    start: wp.Function
    step: wp.Function
    gathered: wp.Function
    camera: wp.Function
    vertex: wp.Function | None


def side_by_side(config: PathConfig) -> bool:
    """Whether a scene's paths are traced so: on the CPU, unless what they meet is written down.

    Not where scattering is more than choosing between numbers: the other models branch around vectors.
    """
    return config.ray_backend == "wide" and not config.noted and config.bsdfs == (BSDF_DIFFUSE,)


@functools.cache
def make_lane_paths(
    config: PathConfig, differential: bool, sparse: bool = False, filter_kind: int | None = None, kept: int = 0
) -> LanePaths:
    """Make the functions; arguments as those of ``make_path_step`` and ``make_camera_starts``.

    ``kept``: number of vertices that are kept of a path; none has more.
    """
    width = config.ray_width
    closest_hit, any_hit = make_intersect(config.ray_backend, width)
    closest_of_each, any_of_each = make_each(width)
    trace_together = make_trace_together(config)
    view, start_in = make_camera_starts(config, filter_kind)
    arrive = make_arrive(config)
    stand = make_stand(config)
    scatter = make_scatter(config, differential)
    sample_4d = make_sampler(config.sampler).sample_4d
    has_lights = samples_lights(config)
    pick, draw = make_light_draw(config) if has_lights else (None, None)
    next_event = make_next_event(config, differential) if has_lights else None

    get_number, put_number = make_number(width)
    get_seat, put_seat = make_record(Seat, width)
    get_state, put_state = make_record(PathState, width)
    get_hit, put_hit = make_record(RayHit, width)
    get_camera, put_camera = make_record(CameraSample, width)
    get_sum, put_sum = make_record(Sum, width)
    get_arrival, put_arrival = make_record(Arrival, width)
    get_choice, put_choice = make_record(Choice, width)
    get_triangle, _put = make_record(Triangle, width)
    fetch_triangle = make_fetch(Triangle, width)
    get_place, put_place = make_record(Place, width)
    get_light, put_light = make_record(LightSample, width)
    get_event, put_event = make_record(NextEvent, width)
    get_onward, put_onward = make_record(Onward, width)
    get_look, put_look = make_record(Look, width)
    get_vertex, put_vertex = make_record(PathVertex, width)
    copy_vertex = make_copy(PathVertex, width)
    records = (Seat, PathState, RayHit, CameraSample, Sum, Arrival, Choice, Triangle, Place, Onward)
    records += (LightSample, NextEvent, Look) if has_lights else ()
    first_row = {}
    row = 8  # random numbers: next-event estimation, scattering
    for record in records:
        first_row[record] = row
        row += words(record)
    seat_row = first_row[Seat]
    state_row, hit_row, camera_row, sum_row = (first_row[r] for r in (PathState, RayHit, CameraSample, Sum))
    arrival_row, choice_row, triangle_row = (first_row[r] for r in (Arrival, Choice, Triangle))
    place_row, onward_row = (first_row[r] for r in (Place, Onward))
    light_row, event_row, look_row = (first_row.get(r, 0) for r in (LightSample, NextEvent, Look))
    ray_row, alive_row = (state_row + word_of(PathState, name) for name in ("o", "alive"))
    shadow_row, blocked_row = event_row + word_of(NextEvent, "o"), look_row + word_of(Look, "blocked")
    face_row, light_face_row = (choice_row + word_of(Choice, name) for name in ("face", "light_face"))
    vertex_row, vertex_words = row, words(PathVertex)

    @wp.func
    def start(
        scene: Scene,
        camera: Camera,
        pixels: wp.array(dtype=wp.int32),
        bundle: Bundle,
        met: wp.int32,
        rows: ROWS,
    ):
        o = wp.zeros(shape=(wp.static(width),), dtype=wp.vec3)
        d = wp.zeros(shape=(wp.static(width),), dtype=wp.vec3)
        t_max = wp.zeros(shape=(wp.static(width),), dtype=wp.float32)
        seen = wp.zeros(shape=(wp.static(width),), dtype=RayHit)
        count = bundle.pixels * bundle.samples
        j = wp.int32(0)
        for i in range(bundle.pixels):
            seat = Seat()
            seat.sampler = sampler_at(pixels[bundle.first + i], 0, bundle.seed)
            seat.px = column_of(bundle, seat.sampler)
            seat.py = row_of(bundle, seat.sampler)
            for n in range(bundle.samples):
                seat.sampler.index = wp.uint32(bundle.first_sample + n)
                put_seat(rows, seat_row, j, seat)
                j += 1
        k = view(scene, camera)
        j = wp.int32(0)
        while j < width:
            seat = get_seat(rows, seat_row, j, Seat())
            state, sample = start_in(scene, camera, k, seat.px, seat.py, seat.sampler)
            state.alive = wp.where(j < count, 1, 0)
            state.met = met
            put_state(rows, state_row, j, state)
            put_camera(rows, camera_row, j, sample)
            put_sum(rows, sum_row, j, Sum())
            j += 1
        j = wp.int32(0)
        while j < count:
            state = get_state(rows, state_row, j, PathState())
            o[j] = state.o
            d[j] = state.d
            t_max[j] = state.t_max
            j += 1
        trace_together(scene, count, o, d, t_max, seen)
        j = wp.int32(0)
        while j < count:
            put_hit(rows, hit_row, j, seen[j])
            j += 1

    @wp.func
    def draw_numbers(depth: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            sampler = get_seat(rows, seat_row, j, Seat()).sampler
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
    def meet(scene: Scene, depth: wp.int32, last: wp.bool, rows: ROWS) -> wp.int32:
        """What the rays find, one by one; the number of paths that stand on a surface."""
        one_by_one = depth > 0
        if depth > 0 and scene.accel.flat > 0:
            closest_of_each(scene.accel, rows, ray_row, alive_row, hit_row)
            one_by_one = False
        standing = wp.int32(0)
        nobody = Choice()  # a face and a light that there are: what a lane without a path is computed along with
        if wp.static(has_lights):
            first_light, first_face = pick(scene, wp.vec2(0.0, 0.0))
            nobody.light = first_light
            nobody.light_face = first_face
        j = wp.int32(0)
        while j < width:
            state = get_state(rows, state_row, j, PathState())
            arrival = Arrival()
            choice = nobody
            if state.alive == 1:
                if one_by_one:
                    put_hit(rows, hit_row, j, closest_hit(scene.accel, state.o, state.d, state.t_max))
                hit = get_hit(rows, hit_row, j, RayHit())
                arrival = arrive(scene, state, hit)
                if arrival.on == 1:
                    standing += 1
                    choice.on = 1
                    choice.face = hit.face
                    if wp.static(has_lights):
                        if not last:
                            light, face = pick(scene, wp.vec2(get_number(rows, 0, j), get_number(rows, 1, j)))
                            choice.light = light
                            choice.light_face = face
            put_arrival(rows, arrival_row, j, arrival)
            put_choice(rows, choice_row, j, choice)
            j += 1
        return standing

    @wp.func
    def stand_there(scene: Scene, rows: ROWS):
        fetch_triangle(scene.triangles, rows, face_row, triangle_row)
        j = wp.int32(0)
        while j < width:
            state = get_state(rows, state_row, j, PathState())
            hit = get_hit(rows, hit_row, j, RayHit())
            choice = get_choice(rows, choice_row, j, Choice())
            tri = get_triangle(rows, triangle_row, j, Triangle())
            put_place(rows, place_row, j, stand(scene, tri, choice.face, hit.u, hit.v, state.d))
            j += 1

    @wp.func
    def draw_lights(scene: Scene, rows: ROWS):
        if wp.static(bool(config.area)):
            fetch_triangle(scene.triangles, rows, light_face_row, triangle_row)
        j = wp.int32(0)
        while j < width:
            choice = get_choice(rows, choice_row, j, Choice())
            place = get_place(rows, place_row, j, Place())
            u = wp.vec2(get_number(rows, 2, j), get_number(rows, 3, j))
            tri = get_triangle(rows, triangle_row, j, Triangle())
            put_light(rows, light_row, j, draw(scene, choice.light, choice.light_face, tri, place.x, u))
            j += 1

    @wp.func
    def estimate(rows: ROWS):
        j = wp.int32(0)
        while j < width:
            choice = get_choice(rows, choice_row, j, Choice())
            place = get_place(rows, place_row, j, Place())
            ls = get_light(rows, light_row, j, LightSample())
            put_event(rows, event_row, j, next_event(place, ls, choice.light))
            j += 1

    @wp.func
    def scatter_all(scene: Scene, rr_depth: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            state = get_state(rows, state_row, j, PathState())
            choice = get_choice(rows, choice_row, j, Choice())
            place = get_place(rows, place_row, j, Place())
            r4 = wp.vec4(get_number(rows, 4, j), get_number(rows, 5, j), get_number(rows, 6, j), get_number(rows, 7, j))
            onward = scatter(place, state, choice.face, r4, rr_depth)
            if wp.static(sparse):
                onward.after.met = state.met + scene.matters[place.shape]
            put_onward(rows, onward_row, j, onward)
            j += 1

    @wp.func
    def look_at_lights(scene: Scene, rows: ROWS):
        """Shadow rays."""
        j = wp.int32(0)
        while j < width:
            wanted = get_choice(rows, choice_row, j, Choice()).on == 1
            wanted = wanted and get_event(rows, event_row, j, NextEvent()).wanted == 1
            if wp.static(sparse):
                wanted = wanted and get_onward(rows, onward_row, j, Onward()).after.met > 0
            look = Look()
            look.wanted = wp.where(wanted, 1, 0)
            put_look(rows, look_row, j, look)
            j += 1
        if scene.accel.flat > 0:
            any_of_each(scene.accel, rows, shadow_row, look_row, blocked_row)
        else:
            j = wp.int32(0)
            while j < width:
                look = get_look(rows, look_row, j, Look())
                if look.wanted == 1:
                    event = get_event(rows, event_row, j, NextEvent())
                    if any_hit(scene.accel, event.o, event.d, event.t_max):
                        look.blocked = 1
                        put_look(rows, look_row, j, look)
                j += 1

    @wp.func
    def keep(depth: wp.int32, scattering: wp.bool, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            state = get_state(rows, state_row, j, PathState())
            hit = get_hit(rows, hit_row, j, RayHit())
            arrival = get_arrival(rows, arrival_row, j, Arrival())
            choice = get_choice(rows, choice_row, j, Choice())
            onward = get_onward(rows, onward_row, j, Onward())
            on = scattering and choice.on == 1
            event = NextEvent()
            lit = wp.bool(False)
            if wp.static(has_lights):
                event = get_event(rows, event_row, j, NextEvent())
                look = get_look(rows, look_row, j, Look())
                lit = on and look.wanted == 1 and look.blocked == 0
            vertex = vertex_of(state, hit, arrival, lit, event, on, onward)
            put_vertex(rows, vertex_row, j, vertex)
            j += 1
        # Written at once to where it stays, it might overlap what is read, for all that the compiler knows.
        copy_vertex(rows, vertex_row, vertex_row + (depth + 1) * vertex_words)

    @wp.func
    def advance(scattering: wp.bool, rows: ROWS) -> wp.int32:
        alive = wp.int32(0)
        j = wp.int32(0)
        while j < width:
            state = get_state(rows, state_row, j, PathState())
            arrival = get_arrival(rows, arrival_row, j, Arrival())
            choice = get_choice(rows, choice_row, j, Choice())
            onward = get_onward(rows, onward_row, j, Onward())
            total = get_sum(rows, sum_row, j, Sum())
            on = scattering and choice.on == 1
            direct = arrival.direct
            if wp.static(has_lights):
                event = get_event(rows, event_row, j, NextEvent())
                look = get_look(rows, look_row, j, Look())
                lit = on and look.wanted == 1 and look.blocked == 0
                direct += where3(lit, event.value, wp.vec3(0.0, 0.0, 0.0))
            direct = where3(on and onward.broken == 1, wp.vec3(wp.NAN, wp.NAN, wp.NAN), direct)
            # What lies in the rows of a path that has ended may be anything.
            gained = total.radiance + wp.cw_mul(state.throughput, direct)
            total.radiance = where3(state.alive == 1, gained, total.radiance)
            total.vertices += state.alive
            put_sum(rows, sum_row, j, total)
            after = onward.after
            after.alive = wp.where(on, onward.after.alive, 0)
            put_state(rows, state_row, j, after)
            alive += after.alive
            j += 1
        return alive

    @wp.func
    def step(scene: Scene, depth: wp.int32, max_depth: wp.int32, rr_depth: wp.int32, rows: ROWS) -> wp.int32:
        last = wp.static(not config.scatter) or (max_depth >= 0 and depth + 1 >= max_depth)
        if wp.static(config.scatter):
            if not last:
                draw_numbers(depth, rows)
        scattering = meet(scene, depth, last, rows) > 0 and not last
        if wp.static(config.scatter):
            if scattering:
                stand_there(scene, rows)
                if wp.static(has_lights):
                    draw_lights(scene, rows)
                    estimate(rows)
                scatter_all(scene, rr_depth, rows)
                if wp.static(has_lights):
                    look_at_lights(scene, rows)
        if wp.static(kept > 0):
            keep(depth, scattering, rows)
        return advance(scattering, rows)

    @wp.func
    def gathered(rows: ROWS, j: wp.int32) -> Sum:
        return get_sum(rows, sum_row, j, Sum())

    @wp.func
    def camera_of(rows: ROWS, j: wp.int32) -> CameraSample:
        return get_camera(rows, camera_row, j, CameraSample())

    @wp.func
    def vertex_at(rows: ROWS, j: wp.int32, n: wp.int32) -> PathVertex:
        return get_vertex(rows, vertex_row + (n + 1) * vertex_words, j, PathVertex())

    size = (row + (kept + 1 if kept else 0) * vertex_words) * width
    return LanePaths(width, size, start, step, gathered, camera_of, vertex_at if kept else None)

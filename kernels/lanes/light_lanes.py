"""Next-event estimates for all lanes in step (``path_lanes.py``): their lights.

Binary search in cumulative probabilities finds a light, the triangle of an area light, and the cell of an image
environment, as by ``find_interval``. Each step is a loop over all lanes, and an entry costs a gather. Searches that
have ended continue without moving. Guides shorten the searches in an image environment.
"""

from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.constants import EMITTER_AREA, EMITTER_ENVMAP, ONE_MINUS_EPSILON
from warp_psdr.kernels.distribution import bucket_of
from warp_psdr.kernels.emitter.env_cells import column_buckets, column_guide, row_buckets
from warp_psdr.kernels.emitter.envmap import draw_in_cell
from warp_psdr.kernels.generated import make_select
from warp_psdr.kernels.lanes.lanes import ROWS, Rows, make_fetch, make_number, stack_rows, word_of, words
from warp_psdr.kernels.reading import emitter_at, load_float, texture_record
from warp_psdr.kernels.scattering import NextEvent, make_estimate, make_light_draw, make_next_event
from warp_psdr.kernels.structs import Emitter, LightSample, Scene, Triangle
from warp_psdr.kernels.vertex import LightConfig, SurfaceConfig


@wp.struct
class Search:
    """A search among ``length`` entries from ``first + low`` on of an array."""

    first: wp.int32
    low: wp.int32
    length: wp.int32
    u: wp.float32


@wp.struct
class Chosen:
    """The light of an estimate."""

    light: wp.int32
    face: wp.int32  # -1: it has no triangles
    row: wp.int32  # of the cell, if it is an image environment
    column: wp.int32


@wp.func
def guided(cdf: wp.array(dtype=wp.float32), bucket: wp.int32, s: Search) -> Search:
    """Narrow a search to the entries of a bucket, see ``kernels/distribution.py``."""
    r = s
    r.low = wp.int32(load_float(cdf, bucket))
    r.length = wp.int32(load_float(cdf, bucket + 1)) - r.low + 1
    return r


class LightLanes(NamedTuple):
    """What ``make_light_lanes`` makes.

    Attributes:
        choose: ``(scene, rows)`` chooses lights by the random numbers in the rows 0 and 1.
        draw: ``(scene, rows)`` draws points on them by those in the rows 2 and 3.
        estimate: ``(rows)`` computes the estimates.
        triangles: the records of the area lights' triangles.
        samples: the points, ``LightSample``.
        events: the estimates, ``NextEvent``.
    """

    choose: wp.Function
    draw: wp.Function
    estimate: wp.Function
    triangles: Rows
    samples: Rows
    events: Rows


def make_light_lanes(
    surfaces: SurfaceConfig,
    lights: LightConfig,
    differential: bool,
    width: int,
    first: int,
    places: Rows,
    values: Rows | None,
) -> LightLanes:
    """Make the functions.

    Args:
        surfaces: what the surfaces need.
        lights: what the lights need.
        differential: as for ``make_path_step``.
        width: number of lanes.
        first: the first row that they may take; the last one is the last of ``events``.
        places: where the paths stand, interactions.
        values: of the scattering functions towards the lights, ``ScatteringValue``; None: there is one model, and they
            are computed with the estimate.
    """
    get_number, _put_number = make_number(width)
    where_light = make_select(LightSample)
    fetch_triangle = make_fetch(Triangle, width, words(Triangle))
    sky = EMITTER_ENVMAP in lights.others
    sky_alone = sky and lights.one_light
    _pick, draw_one = make_light_draw(lights, left_out=(EMITTER_ENVMAP,))
    next_event = make_next_event(surfaces, lights, differential)
    estimate_with = make_estimate(surfaces, lights, differential)
    searches, chosen, triangles, samples, events = stack_rows(
        width, first, Search, Chosen, Triangle, LightSample, NextEvent
    )
    triangle_row, face_row = triangles.first, chosen.first + word_of(Chosen, "face")

    @wp.func
    def search(cdf: wp.array(dtype=wp.float32), rows: ROWS):
        longest = wp.int32(2)
        while longest > 1:
            longest = wp.int32(0)
            j = wp.int32(0)
            while j < width:
                s = searches.get(rows, j)
                half = s.length >> 1
                s.low = wp.where(load_float(cdf, s.first + s.low + half) <= s.u, s.low + half, s.low)
                s.length -= half
                longest = wp.max(longest, s.length)
                searches.put(rows, j, s)
                j += 1

    @wp.func
    def search_evenly(cdf: wp.array(dtype=wp.float32), entries: wp.int32, rows: ROWS):
        """``search``, all lanes among as many entries."""
        length = wp.int32(entries)
        while length > 1:
            half = length >> 1
            j = wp.int32(0)
            while j < width:
                s = searches.get(rows, j)
                s.low = wp.where(load_float(cdf, s.first + s.low + half) <= s.u, s.low + half, s.low)
                searches.put(rows, j, s)
                j += 1
            length -= half

    @wp.func
    def choose(scene: Scene, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            s = Search()
            s.u = wp.min(get_number(rows, 0, j), ONE_MINUS_EPSILON)
            searches.put(rows, j, s)
            j += 1
        if wp.static(not lights.one_light):
            search_evenly(scene.emitter_cdf, scene.emitters.shape[0], rows)
        j = wp.int32(0)
        while j < width:
            c = Chosen()
            c.light = searches.get(rows, j).low
            c.face = -1
            chosen.put(rows, j, c)
            j += 1
        if wp.static(bool(lights.area)):
            choose_faces(scene, rows)
        if wp.static(sky):
            choose_cells(scene, rows)

    @wp.func
    def emitter_of(scene: Scene, c: Chosen) -> Emitter:
        return emitter_at(scene, wp.where(wp.static(lights.one_light), 0, c.light))

    @wp.func
    def choose_faces(scene: Scene, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            emitter = emitter_of(scene, chosen.get(rows, j))
            on_area = emitter.kind == EMITTER_AREA
            s = Search()
            s.first = wp.where(on_area, emitter.cdf_offset, 0)
            s.length = wp.where(on_area, emitter.face_count, 1)
            s.u = wp.min(get_number(rows, 1, j), ONE_MINUS_EPSILON)
            searches.put(rows, j, s)
            j += 1
        search(scene.face_cdf, rows)
        j = wp.int32(0)
        while j < width:
            c = chosen.get(rows, j)
            emitter = emitter_of(scene, c)
            c.face = wp.where(emitter.kind == EMITTER_AREA, emitter.first_face + searches.get(rows, j).low, -1)
            chosen.put(rows, j, c)
            j += 1

    @wp.func
    def choose_cells(scene: Scene, rows: ROWS):
        texture = texture_record(scene, emitter_at(scene, scene.environment).texture)
        buckets = row_buckets(scene, texture)
        j = wp.int32(0)
        while j < width:
            s = Search()
            s.u = wp.min(get_number(rows, 3, j), ONE_MINUS_EPSILON)
            searches.put(rows, j, guided(scene.env_marginal, texture.height + 1 + bucket_of(buckets, s.u), s))
            j += 1
        search(scene.env_marginal, rows)
        buckets = column_buckets(scene, texture)
        j = wp.int32(0)
        while j < width:
            c = chosen.get(rows, j)
            c.row = searches.get(rows, j).low
            chosen.put(rows, j, c)
            s = Search()
            s.first = c.row * (texture.width + 1)
            s.u = wp.min(get_number(rows, 2, j), ONE_MINUS_EPSILON)
            guide = column_guide(texture, buckets, c.row) + bucket_of(buckets, s.u)
            searches.put(rows, j, guided(scene.env_conditional, guide, s))
            j += 1
        search(scene.env_conditional, rows)
        j = wp.int32(0)
        while j < width:
            c = chosen.get(rows, j)
            c.column = searches.get(rows, j).low
            chosen.put(rows, j, c)
            j += 1

    @wp.func
    def draw_sky(scene: Scene, rows: ROWS):
        emitter = emitter_at(scene, scene.environment)
        texture = texture_record(scene, emitter.texture)
        j = wp.int32(0)
        while j < width:
            c = chosen.get(rows, j)
            u = wp.vec2(get_number(rows, 2, j), get_number(rows, 3, j))
            ls = draw_in_cell(scene, emitter, texture, c.row, c.column, u)
            ls.probability = emitter.probability
            if wp.static(not sky_alone):
                ls = where_light(c.light == scene.environment, ls, samples.get(rows, j))
            samples.put(rows, j, ls)
            j += 1

    @wp.func
    def draw(scene: Scene, rows: ROWS):
        if wp.static(bool(lights.area)):
            fetch_triangle(scene.triangles, rows, face_row, triangle_row)
        if wp.static(not sky_alone):
            j = wp.int32(0)
            while j < width:
                c = chosen.get(rows, j)
                u = wp.vec2(get_number(rows, 2, j), get_number(rows, 3, j))
                x = places.get(rows, j).x
                samples.put(rows, j, draw_one(scene, c.light, c.face, triangles.get(rows, j), x, u))
                j += 1
        if wp.static(sky):
            draw_sky(scene, rows)

    @wp.func
    def estimate_one(rows: ROWS):
        j = wp.int32(0)
        while j < width:
            c = chosen.get(rows, j)
            events.put(rows, j, next_event(places.get(rows, j), samples.get(rows, j), c.light))
            j += 1

    if values is None:
        return LightLanes(choose, draw, estimate_one, triangles, samples, events)

    @wp.func
    def estimate_several(rows: ROWS):
        j = wp.int32(0)
        while j < width:
            c = chosen.get(rows, j)
            found = values.get(rows, j)
            event = estimate_with(places.get(rows, j), samples.get(rows, j), c.light, found.value, found.pdf)
            events.put(rows, j, event)
            j += 1

    return LightLanes(choose, draw, estimate_several, triangles, samples, events)

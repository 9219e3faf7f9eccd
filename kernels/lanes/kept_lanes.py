"""The vertices that paths side by side (``path_lanes.py``) keep for a sweep back over them.

The vertices of one depth lie side by side, for the sweep alone: a sweep of single paths reads one after the other, and
a sweep of several paths reads rows. More of a vertex is kept than a single path keeps, because fetching and looking it
up again took as long as the arithmetic: nearly everything for the sweep of geometry (``lanes/sweep_lanes.py``), and the
light that arrived for the sweeps of materials (``lanes/material_sweep.py``) and of single paths.
"""

from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.lanes.lanes import ROWS, Rows, make_record, word_of, words
from warp_psdr.kernels.lanes.light_lanes import LightLanes
from warp_psdr.kernels.lanes.place_lanes import PlaceLanes
from warp_psdr.kernels.structs import Triangle
from warp_psdr.kernels.vertex import PathVertex


@wp.struct
class RecordedScattering:
    """Where a path scattered."""

    n: wp.vec3  # of the shading frame, on the side of the incoming ray
    side: wp.float32  # +1, or -1 on the back of a two-sided material
    length: wp.float32  # ``Surface.length``
    uv: wp.vec2
    reflectance: wp.vec3
    radiance: wp.vec3  # of the light found by next-event estimation, as ``LightSample`` has it


@wp.struct
class KeptLight:
    """What the light that was drawn sends to a vertex, and whether its shadow ray crosses surfaces: 1, or 0."""

    radiance: wp.vec3
    crosses: wp.int32


@wp.struct
class RecordedVertex:
    """A vertex and what belongs to it; ``light`` and ``stood`` may be anything where it does not scatter."""

    vertex: PathVertex
    tri: Triangle
    light: Triangle
    stood: RecordedScattering


@wp.struct
class LitVertex:
    """A vertex, and the light found by next-event estimation; its radiance is that of ``LightSample``."""

    vertex: PathVertex
    light: KeptLight


class KeptLanes(NamedTuple):
    """What ``make_kept_lanes`` makes.

    Attributes:
        put: ``(rows, j, n, vertex)`` keeps the n-th vertex of the j-th path.
        keep_rest: ``(rows, n)`` keeps what there is beside all n-th vertices, which are where the paths stand now.
        vertex: ``(rows, j, n) -> PathVertex``, one of the last that were kept; None if none are.
        record: ``(rows, j, n) -> RecordedVertex``, of the nearest n that there is; None unless all of it is kept.
        light: ``(rows, j, n) -> KeptLight``; None unless it is kept alone.
        end: the first row that is free.
    """

    put: wp.Function
    keep_rest: wp.Function
    vertex: wp.Function | None
    record: wp.Function | None
    light: wp.Function | None
    end: int


def make_kept_lanes(
    width: int,
    first: int,
    kept: int,
    whole: bool,
    lit: bool,
    on_places: PlaceLanes,
    lights: LightLanes | None,
    looks: Rows,
) -> KeptLanes:
    """Make the functions.

    Args:
        width: number of lanes.
        first: the first row that they may take.
        kept: number of vertices of a path; of longer ones, the last so many.
        whole: whether all of ``RecordedVertex`` is kept.
        lit: whether vertices and their lights are; else vertices alone.
        on_places: where the paths stand.
        lights: what next-event estimation finds there, if there are lights.
        looks: the shadow rays, ``ShadowQuery``.
    """
    size = words(RecordedVertex if whole else LitVertex if lit else PathVertex)  # the vertex comes first in all
    get_vertex, put_vertex = make_record(PathVertex, width, aside=True)
    get_kept, _put_kept = make_record(RecordedVertex, width, aside=True)
    put_tri, put_stood = (make_record(record, width, aside=True)[1] for record in (Triangle, RecordedScattering))
    tri_word, light_word, stood_word = (word_of(RecordedVertex, name) for name in ("tri", "light", "stood"))

    get_light, put_light = make_record(KeptLight, width, aside=True)
    kept_light_word = word_of(LitVertex, "light")

    @wp.func
    def row_of(n: wp.int32) -> wp.int32:
        return first + n % kept * size

    @wp.func
    def put(rows: ROWS, j: wp.int32, n: wp.int32, vertex: PathVertex):
        put_vertex(rows, row_of(n), j, vertex)

    @wp.func
    def keep_rest(rows: ROWS, n: wp.int32):
        # In loops of their own: stores in several places provably meet neither each other nor what is read.
        to = row_of(n)
        j = wp.int32(0)
        while j < width:
            put_tri(rows, to + tri_word, j, on_places.triangles.get(rows, j))
            j += 1
        if wp.static(lights is not None):
            j = wp.int32(0)
            while j < width:
                put_tri(rows, to + light_word, j, lights.triangles.get(rows, j))
                j += 1
        j = wp.int32(0)
        while j < width:
            place = on_places.places.get(rows, j)
            surface = on_places.surfaces.get(rows, j)
            stood = RecordedScattering()
            stood.n = place.frame.n
            stood.side = place.frame.side
            stood.length = surface.length
            stood.uv = surface.uv
            stood.reflectance = place.material.reflectance
            if wp.static(lights is not None):
                stood.radiance = lights.samples.get(rows, j).radiance
            put_stood(rows, to + stood_word, j, stood)
            j += 1

    @wp.func
    def keep_light(rows: ROWS, n: wp.int32):
        j = wp.int32(0)
        while j < width:
            found = KeptLight()
            found.radiance = lights.samples.get(rows, j).radiance
            found.crosses = looks.get(rows, j).crosses
            put_light(rows, row_of(n) + kept_light_word, j, found)
            j += 1

    @wp.func
    def light_at(rows: ROWS, j: wp.int32, n: wp.int32) -> KeptLight:
        return get_light(rows, row_of(n) + kept_light_word, j, KeptLight())

    @wp.func
    def vertex_at(rows: ROWS, j: wp.int32, n: wp.int32) -> PathVertex:
        return get_vertex(rows, row_of(n), j, PathVertex())

    @wp.func
    def kept_at(rows: ROWS, j: wp.int32, n: wp.int32) -> RecordedVertex:
        return get_kept(rows, first + wp.clamp(n, 0, kept - 1) * size, j, RecordedVertex())

    return KeptLanes(
        put,
        keep_rest if whole else keep_light,
        vertex_at if kept else None,
        kept_at if whole else None,
        light_at if lit else None,
        first + kept * size,
    )

"""Interactions of all lanes in step (``path_lanes.py``): points, frames and materials.

Triangles, and what of materials no texture varies (``Scene.baked``), are fetched whole and transposed
(``lanes.make_fetch``). Chains of numbers through the scene's tables, shape to material to texture to values, are
followed lane by lane, with textures of any kind. As SIMD they would need a gather for each word, which takes as long as
the loads or longer on the processors measured.
"""

from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.emitter.dispatch import ENVIRONMENTS
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.invalid import finite
from warp_psdr.kernels.lanes.lanes import ROWS, Rows, make_fetch, stack_rows, word_of, words
from warp_psdr.kernels.lanes.model_lanes import model_bit
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.primitive.affine import is_primitive
from warp_psdr.kernels.reading import shape_at, triangle_at
from warp_psdr.kernels.scattering import EmissionHit, make_emission_hit, make_sky_hit
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import Surface
from warp_psdr.kernels.vertex import PathConfig


@wp.struct
class LaneHit:
    """Where a path is. A lane without a path is computed along on face 0."""

    on: wp.int32  # 1: the path stands on ``face``
    face: wp.int32
    leaves: wp.int32  # 1: its ray has met nothing, and brings what is there
    behind: wp.int32  # 1: it arrives at the back
    u: wp.float32
    v: wp.float32


@wp.struct
class LaneMaterial:
    """What a path's surface is made of."""

    number: wp.int32  # of the scattering record
    side: wp.float32  # as in ``Frame``


def baked_words(record) -> int:
    """Number of words of an interaction, its last ones, that ``Scene.baked`` holds of each scattering record."""
    return words(record) - word_of(record, "model")


@wp.func
def corner_of(tri: Triangle) -> Triangle:
    """A record whose numbers of corners are such: those of shapes without triangles are others."""
    r = tri
    exact = is_primitive(tri)
    r.i0 = wp.where(exact, 0, tri.i0)
    r.i1 = wp.where(exact, 0, tri.i1)
    r.i2 = wp.where(exact, 0, tri.i2)
    return r


class PlaceLanes(NamedTuple):
    """What ``make_place_lanes`` makes.

    Attributes:
        see: ``(rows) -> int``: what the rays have met; the number of lanes up to the last whose path stands on a
            surface.
        fetch: ``(scene, rows)``: the triangles there.
        meet: ``(scene, rows) -> int``: both.
        collect: ``(scene, rows)``: what the rays bring.
        stand: ``(scene, standing, rows) -> int``: where the paths stand, and the bits of their models, 0 if there is
            one alone (``model_lanes.py``); ``standing`` is what ``meet`` returned.
        choices: ``LaneHit``.
        triangles: ``Triangle``, those that paths stand on.
        surfaces: ``Surface``, at the same points.
        places: interactions, the struct of ``make_interaction``.
        emissions: ``EmissionHit``.
    """

    see: wp.Function
    fetch: wp.Function
    meet: wp.Function
    collect: wp.Function
    stand: wp.Function
    choices: Rows
    triangles: Rows
    surfaces: Rows
    places: Rows
    emissions: Rows


def make_place_lanes(config: PathConfig, width: int, first: int, states: Rows, hits: Rows) -> PlaceLanes:
    """Make the functions.

    Args:
        config: as for ``make_path_step``.
        width: number of lanes.
        first: the first row that they may take; the last one is the last of ``emissions``.
        states: the paths' ``PathState``.
        hits: what their rays have met, ``RayHit``.
    """
    emission_hit, sky_hit = make_emission_hit(config.lights, config.through), make_sky_hit(config.lights)
    interaction = make_interaction(config.surfaces, config.lights)
    surface_of_any, surface_of, side_of, complete, put_together = interaction.parts
    fetch_triangle = make_fetch(Triangle, width, words(Triangle))
    tables = any(slot.table for slot in config.surfaces.material)
    fetch_baked = make_fetch(wp.uint32, width, baked_words(interaction.record))
    several = len(config.surfaces.bsdfs) > 1
    environment = any(kind in ENVIRONMENTS for kind in config.lights.others)
    choices, triangles, surfaces = stack_rows(width, first, LaneHit, Triangle, Surface)
    materials, places, emissions = stack_rows(width, surfaces.end, LaneMaterial, interaction.record, EmissionHit)
    triangle_row, face_row = triangles.first, choices.first + word_of(LaneHit, "face")
    number_row = materials.first + word_of(LaneMaterial, "number")
    baked_row = places.first + word_of(interaction.record, "model")

    @wp.func
    def see(rows: ROWS) -> wp.int32:
        standing = wp.int32(0)
        j = wp.int32(0)
        while j < width:
            state = states.get(rows, j)
            face = hits.get(rows, j).face
            choice = LaneHit()
            choice.on = wp.where(state.alive == 1 and face >= 0, 1, 0)
            choice.face = wp.where(choice.on == 1, face, 0)
            astray = state.alive == 1 and face < 0
            if wp.static(not environment):
                astray = astray and not finite(state.o + state.d)  # which ``sky_hit`` tells
            choice.leaves = wp.where(astray, 1, 0)
            choices.put(rows, j, choice)
            emissions.put(rows, j, EmissionHit())
            standing = wp.max(standing, choice.on * (j + 1))
            j += 1
        return standing

    @wp.func
    def fetch(scene: Scene, rows: ROWS):
        fetch_triangle(scene.triangles, rows, face_row, triangle_row)

    @wp.func
    def meet(scene: Scene, rows: ROWS) -> wp.int32:
        standing = see(rows)
        if standing > 0:
            fetch(scene, rows)
        return standing

    @wp.func
    def collect_sky(scene: Scene, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            emission = sky_hit(scene, states.get(rows, j))
            leaves = choices.get(rows, j).leaves == 1
            emission.weight = wp.where(leaves, emission.weight, 0.0)
            emission.direct = where3(leaves, emission.direct, wp.vec3(0.0, 0.0, 0.0))
            emissions.put(rows, j, emission)
            j += 1

    @wp.func
    def collect(scene: Scene, rows: ROWS):
        leaving = wp.int32(0)
        j = wp.int32(0)
        while j < width:
            leaving = wp.max(leaving, choices.get(rows, j).leaves)
            j += 1
        if leaving == 1:
            collect_sky(scene, rows)
        if wp.static(bool(config.lights.area)):
            j = wp.int32(0)
            while j < width:
                choice = choices.get(rows, j)
                if choice.on == 1:
                    if shape_at(scene, triangle_at(scene, choice.face).shape).emitter >= 0:
                        emissions.put(rows, j, emission_hit(scene, states.get(rows, j), hits.get(rows, j)))
                j += 1

    @wp.func
    def stand_on_primitives(scene: Scene, standing: wp.int32, rows: ROWS):
        for j in range(standing):
            choice = choices.get(rows, j)
            tri = triangles.get(rows, j)
            if choice.on == 1 and is_primitive(tri):
                hit = hits.get(rows, j)
                surface = surface_of_any(scene, tri, hit.u, hit.v)
                surfaces.put(rows, j, surface)
                choice.u = hit.u
                choice.v = hit.v
                choice.behind = wp.where(wp.dot(surface.n, -states.get(rows, j).d) < 0.0, 1, 0)
                choices.put(rows, j, choice)

    @wp.func
    def stand(scene: Scene, standing: wp.int32, rows: ROWS) -> wp.int32:
        j = wp.int32(0)
        while j < width:
            hit = hits.get(rows, j)
            choice = choices.get(rows, j)
            tri = triangles.get(rows, j)
            on = choice.on == 1
            if wp.static(bool(config.surfaces.primitives)):
                on = on and not is_primitive(tri)
                tri = corner_of(tri)
            u = wp.where(on, hit.u, 0.0)
            v = wp.where(on, hit.v, 0.0)
            surface = surface_of(scene, tri, u, v)
            surfaces.put(rows, j, surface)
            choice.u = u
            choice.v = v
            choice.behind = wp.where(wp.dot(surface.n, -states.get(rows, j).d) < 0.0, 1, 0)
            choices.put(rows, j, choice)
            j += 1
        if wp.static(bool(config.surfaces.primitives)):
            stand_on_primitives(scene, standing, rows)
        for j in range(width):  # one by one: SIMD would be gathers, which take longer
            surface = surfaces.get(rows, j)
            side, number = side_of(scene, surface, choices.get(rows, j).behind == 1)
            material = LaneMaterial()
            material.number = number
            material.side = side
            materials.put(rows, j, material)
        fetch_baked(scene.baked, rows, number_row, baked_row)
        if wp.static(complete is not None):
            looked = wp.int32(standing)
            if wp.static(tables):
                looked = wp.int32(width)  # what is computed for lanes without a vertex, too, reads entries that exist
            for j in range(looked):
                c = choices.get(rows, j)
                m = materials.get(rows, j)
                at = places.get(rows, j)
                places.put(rows, j, complete(scene, at, m.number, m.side, surfaces.get(rows, j), c.face, c.u, c.v))
        models = wp.int32(0)
        j = wp.int32(0)
        while j < width:
            side = materials.get(rows, j).side
            tri = triangles.get(rows, j)
            d = states.get(rows, j).d
            at = put_together(scene, places.get(rows, j), side, tri, surfaces.get(rows, j), d)
            places.put(rows, j, at)
            if wp.static(several):
                models = models | wp.where(choices.get(rows, j).on == 1, model_bit(at.model), 0)
            j += 1
        return models

    return PlaceLanes(see, fetch, meet, collect, stand, choices, triangles, surfaces, places, emissions)

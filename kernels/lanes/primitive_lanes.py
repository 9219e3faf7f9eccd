"""Intersection of paths side by side (``path_lanes.py``) with shapes without triangles, after the triangles.

The rays of all lanes meet each shape. An affine shape is the same for all of them, so a loop over lanes becomes SIMD.
Tubes, grids and networks are met step by step (``curve_lanes.py``, ``grid_lanes.py``), straight curves lane by lane.
Shapes come in the order of ``dispatch.make_primitive_queries``, and each ray meets them by the same functions, so hits
have the same bits.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bvh.wide import Ray
from warp_psdr.kernels.constants import (
    PRIMITIVE_BSPLINECURVE,
    PRIMITIVE_LINEARCURVE,
    PRIMITIVE_NEURALSDF,
    PRIMITIVE_SDFGRID,
    PRIMITIVE_SDFGRID_CUBIC,
)
from warp_psdr.kernels.lanes.curve_lanes import make_curve_lanes
from warp_psdr.kernels.lanes.grid_lanes import make_grid_lanes
from warp_psdr.kernels.lanes.lanes import ROWS, Rows, SteppedLanes
from warp_psdr.kernels.primitive.affine import is_primitive_at, last_primitive, make_affine_hit
from warp_psdr.kernels.primitive.dispatch import make_hit
from warp_psdr.kernels.primitive.kinds import KINDS, affine_kinds, join
from warp_psdr.kernels.reading import shape_at, triangle_at
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.vertex import PathConfig

#: Kinds that rays meet in steps -> what makes their ``SteppedLanes``, of the number of lanes and the first free row.
STEPPED = {
    PRIMITIVE_BSPLINECURVE: make_curve_lanes,
    PRIMITIVE_SDFGRID: functools.partial(make_grid_lanes, cubic=False, network=False),
    PRIMITIVE_SDFGRID_CUBIC: functools.partial(make_grid_lanes, cubic=True, network=False),
    PRIMITIVE_NEURALSDF: functools.partial(make_grid_lanes, cubic=False, network=True),
}


class PrimitiveLanes(NamedTuple):
    """What ``make_primitive_lanes`` makes.

    Attributes:
        meet: ``(scene, depth, rows)``: closest hits that are nearer than those found before.
        block: ``(scene, rows)``: shadow rays that have met nothing; None without lights.
        end: the first row that is free.
    """

    meet: wp.Function
    block: wp.Function | None
    end: int


def make_primitive_lanes(
    config: PathConfig, width: int, first: int, states: Rows, hits: Rows, events: Rows | None, looks: Rows
) -> PrimitiveLanes:
    """Make the functions.

    Args:
        config: as for ``make_path_step``; it has primitives.
        width: number of lanes.
        first: the first row that they may take.
        states: the paths' ``PathState``.
        hits: what their rays have met, ``RayHit``.
        events: next-event estimates, ``NextEvent``; None: there are no lights.
        looks: their ``ShadowQuery``.
    """
    stepped = {kind: make(width, first) for kind, make in STEPPED.items() if kind in config.primitives}
    end = max((lanes.end for lanes in stepped.values()), default=first)
    meeting = {kind: _make_meeting(kind, width, states, hits) for kind in affine_kinds(config.primitives)}
    meeting |= {kind: _make_stepped_meeting(lanes, width, states, hits) for kind, lanes in stepped.items()}
    if PRIMITIVE_LINEARCURVE in config.primitives:
        meeting[PRIMITIVE_LINEARCURVE] = _make_straight_meeting(width, states, hits)
    meet_kind = join(_either_loop, meeting)

    @wp.func
    def meet(scene: Scene, depth: wp.int32, rows: ROWS):
        k = last_primitive(scene)
        while is_primitive_at(scene, k):
            tri = triangle_at(scene, k)
            shown = wp.bool(True)
            if wp.static(config.hidden):
                shown = depth > 0 or shape_at(scene, tri.shape).emitter < 0
            if shown:
                meet_kind(scene, tri, k, rows)
            k -= 1

    if events is None:
        return PrimitiveLanes(meet, None, end)
    blocking = {kind: _make_blocking(kind, width, events, looks) for kind in affine_kinds(config.primitives)}
    blocking |= {kind: _make_stepped_blocking(lanes, width, events, looks) for kind, lanes in stepped.items()}
    if PRIMITIVE_LINEARCURVE in config.primitives:
        blocking[PRIMITIVE_LINEARCURVE] = _make_straight_blocking(width, events, looks)
    block_kind = join(_either_loop, blocking)

    @wp.func
    def block(scene: Scene, rows: ROWS):
        k = last_primitive(scene)
        while is_primitive_at(scene, k):
            block_kind(scene, triangle_at(scene, k), k, rows)
            k -= 1

    return PrimitiveLanes(meet, block, end)


def _either_loop(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def loop_of_kind(scene: Scene, tri: Triangle, k: wp.int32, rows: ROWS):
        if tri.i1 == word:
            f(scene, tri, k, rows)
        else:
            rest(scene, tri, k, rows)

    return loop_of_kind


def _make_meeting(kind: int, width: int, states: Rows, hits: Rows) -> wp.Function:
    hit_of = make_affine_hit(KINDS[kind])

    @wp.func
    def meet_affine(scene: Scene, tri: Triangle, k: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            state = states.get(rows, j)
            hit = hits.get(rows, j)
            found = hit_of(tri, state.o, state.d, hit.t)
            closer = found.face >= 0
            hit.t = wp.where(closer, found.t, hit.t)
            hit.u = wp.where(closer, found.u, hit.u)
            hit.v = wp.where(closer, found.v, hit.v)
            hit.face = wp.where(closer, k, hit.face)
            hits.put(rows, j, hit)
            j += 1

    return meet_affine


def _make_straight_meeting(width: int, states: Rows, hits: Rows) -> wp.Function:
    hit_of = make_hit((PRIMITIVE_LINEARCURVE,))

    @wp.func
    def meet_straight(scene: Scene, tri: Triangle, k: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            state = states.get(rows, j)
            if state.alive == 1:
                found = hit_of(scene, tri, state.o, state.d, hits.get(rows, j).t)
                if found.face >= 0:
                    found.face = k
                    hits.put(rows, j, found)
            j += 1

    return meet_straight


def _make_blocking(kind: int, width: int, events: Rows, looks: Rows) -> wp.Function:
    hit_of = make_affine_hit(KINDS[kind])

    @wp.func
    def block_affine(scene: Scene, tri: Triangle, k: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            event = events.get(rows, j)
            shadow = looks.get(rows, j)
            found = hit_of(tri, event.o, event.d, event.t_max)
            shadow.blocked = wp.where(found.face >= 0, 1, shadow.blocked)
            looks.put(rows, j, shadow)
            j += 1

    return block_affine


def _make_straight_blocking(width: int, events: Rows, looks: Rows) -> wp.Function:
    hit_of = make_hit((PRIMITIVE_LINEARCURVE,), shadow=True)

    @wp.func
    def block_straight(scene: Scene, tri: Triangle, k: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            shadow = looks.get(rows, j)
            if shadow.traces_shadow_ray == 1 and shadow.blocked == 0:
                event = events.get(rows, j)
                if hit_of(scene, tri, event.o, event.d, event.t_max).face >= 0:
                    shadow.blocked = 1
                    looks.put(rows, j, shadow)
            j += 1

    return block_straight


def _make_stepped_meeting(lanes: SteppedLanes, width: int, states: Rows, hits: Rows) -> wp.Function:
    @wp.func
    def meet_stepped(scene: Scene, tri: Triangle, k: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            state = states.get(rows, j)
            ray = Ray()
            ray.o = state.o
            ray.d = state.d
            ray.t_max = hits.get(rows, j).t
            lanes.take(rows, j, ray, state.alive)
            j += 1
        lanes.closest(scene, tri, rows)
        j = wp.int32(0)
        while j < width:
            found = lanes.hit(scene, tri, rows, j)
            if found.face >= 0:
                found.face = k
                hits.put(rows, j, found)
            j += 1

    return meet_stepped


def _make_stepped_blocking(lanes: SteppedLanes, width: int, events: Rows, looks: Rows) -> wp.Function:
    @wp.func
    def block_stepped(scene: Scene, tri: Triangle, k: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            event = events.get(rows, j)
            shadow = looks.get(rows, j)
            ray = Ray()
            ray.o = event.o
            ray.d = event.d
            ray.t_max = event.t_max
            lanes.take(rows, j, ray, wp.where(shadow.traces_shadow_ray == 1 and shadow.blocked == 0, 1, 0))
            j += 1
        lanes.any(scene, tri, rows)
        j = wp.int32(0)
        while j < width:
            shadow = looks.get(rows, j)
            shadow.blocked = wp.where(lanes.blocked(rows, j), 1, shadow.blocked)
            looks.put(rows, j, shadow)
            j += 1

    return block_stepped

"""Intersection of paths side by side (``path_lanes.py``) with shapes without triangles, after the triangles.

The rays of all lanes meet each shape. An affine shape is the same for all of them, so a loop over lanes becomes SIMD.
Kinds with ``Kind.make_lanes`` are met step by step (``curve_lanes.py``, ``grid_lanes.py``), the others lane by lane.
Shapes come in the order of ``dispatch.make_primitive_queries``, and each ray meets them by the same functions, so hits
have the same bits.
"""

from collections.abc import Callable
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bvh.wide import Ray
from warp_psdr.kernels.lanes.lanes import ROWS, Rows, SteppedLanes
from warp_psdr.kernels.primitive.affine import is_primitive_at, last_primitive
from warp_psdr.kernels.primitive.kind import Kind
from warp_psdr.kernels.primitive.table import join, kinds_of
from warp_psdr.kernels.reading import shape_at, triangle_at
from warp_psdr.kernels.structs import Scene, Triangle


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
    primitives: tuple[int, ...],
    hidden: bool,
    width: int,
    first: int,
    states: Rows,
    hits: Rows,
    events: Rows | None,
    looks: Rows,
) -> PrimitiveLanes:
    """Make the functions.

    Args:
        primitives: kinds of shapes without triangles.
        hidden: True: there are area lights, which the camera does not see.
        width: number of lanes.
        first: the first row that they may take.
        states: the paths' ``PathState``.
        hits: what their rays have met, ``RayHit``.
        events: next-event estimates, ``NextEvent``; None: there are no lights.
        looks: their ``ShadowQuery``.
    """
    kinds = kinds_of(primitives)
    stepped = {kind: kind.make_lanes(width, first) for kind in kinds if kind.make_lanes is not None}
    end = max((lanes.end for lanes in stepped.values()), default=first)

    def loops(all_at_once: Callable, one_by_one: Callable, in_steps: Callable, *rows: Rows) -> wp.Function | None:
        made = {}
        for kind in kinds:
            if kind in stepped:
                made[kind.number] = in_steps(stepped[kind], width, *rows)
            else:
                make = one_by_one if kind.affine is None else all_at_once
                made[kind.number] = make(kind, width, *rows)
        return join("loop_of_kind", made)

    meet_kind = loops(_make_meeting, _make_lone_meeting, _make_stepped_meeting, states, hits)

    @wp.func
    def meet(scene: Scene, depth: wp.int32, rows: ROWS):
        k = last_primitive(scene)
        while is_primitive_at(scene, k):
            tri = triangle_at(scene, k)
            shown = wp.bool(True)
            if wp.static(hidden):
                shown = depth > 0 or shape_at(scene, tri.shape).emitter < 0
            if shown:
                meet_kind(scene, tri, k, rows)
            k -= 1

    if events is None:
        return PrimitiveLanes(meet, None, end)
    block_kind = loops(_make_blocking, _make_lone_blocking, _make_stepped_blocking, events, looks)

    @wp.func
    def block(scene: Scene, rows: ROWS):
        k = last_primitive(scene)
        while is_primitive_at(scene, k):
            block_kind(scene, triangle_at(scene, k), k, rows)
            k -= 1

    return PrimitiveLanes(meet, block, end)


def _make_meeting(kind: Kind, width: int, states: Rows, hits: Rows) -> wp.Function:
    hit_of = kind.make_hit(False)

    @wp.func
    def meet_affine(scene: Scene, tri: Triangle, k: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            state = states.get(rows, j)
            hit = hits.get(rows, j)
            found = hit_of(scene, tri, state.o, state.d, hit.t)
            closer = found.face >= 0
            hit.t = wp.where(closer, found.t, hit.t)
            hit.u = wp.where(closer, found.u, hit.u)
            hit.v = wp.where(closer, found.v, hit.v)
            hit.face = wp.where(closer, k, hit.face)
            hits.put(rows, j, hit)
            j += 1

    return meet_affine


def _make_lone_meeting(kind: Kind, width: int, states: Rows, hits: Rows) -> wp.Function:
    hit_of = kind.make_hit(False)

    @wp.func
    def meet_alone(scene: Scene, tri: Triangle, k: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            state = states.get(rows, j)
            if state.alive == 1:
                found = hit_of(scene, tri, state.o, state.d, hits.get(rows, j).t)
                if found.face >= 0:
                    found.face = k
                    hits.put(rows, j, found)
            j += 1

    return meet_alone


def _make_blocking(kind: Kind, width: int, events: Rows, looks: Rows) -> wp.Function:
    hit_of = kind.make_hit(True)

    @wp.func
    def block_affine(scene: Scene, tri: Triangle, k: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            event = events.get(rows, j)
            shadow = looks.get(rows, j)
            found = hit_of(scene, tri, event.o, event.d, event.t_max)
            shadow.blocked = wp.where(found.face >= 0, 1, shadow.blocked)
            looks.put(rows, j, shadow)
            j += 1

    return block_affine


def _make_lone_blocking(kind: Kind, width: int, events: Rows, looks: Rows) -> wp.Function:
    hit_of = kind.make_hit(True)

    @wp.func
    def block_alone(scene: Scene, tri: Triangle, k: wp.int32, rows: ROWS):
        j = wp.int32(0)
        while j < width:
            shadow = looks.get(rows, j)
            if shadow.traces_shadow_ray == 1 and shadow.blocked == 0:
                event = events.get(rows, j)
                if hit_of(scene, tri, event.o, event.d, event.t_max).face >= 0:
                    shadow.blocked = 1
                    looks.put(rows, j, shadow)
            j += 1

    return block_alone


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

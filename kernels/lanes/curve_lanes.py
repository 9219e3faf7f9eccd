"""Rays of all lanes against tubes about B-splines (``primitive/curves.py``).

Each lane takes the pieces near its ray one after the other. Boxes are walked and control points fetched lane by lane.
The test of a piece, and the search for the ray's entry, round by round, are loops over all lanes. Rays that run along a
bent piece, or graze it, are followed lane by lane. Lanes that are done with their piece take the next one as soon as
they are one in ``SHARE`` of those at work. Each ray meets the same pieces in the same order as alone, by the same
functions.
"""

import warp as wp

from warp_psdr.kernels.bvh.wide import Ray, RayHit
from warp_psdr.kernels.generated import make_select
from warp_psdr.kernels.lanes.lanes import ROWS, SteppedLanes, stack_rows
from warp_psdr.kernels.primitive.curves import (
    Curves,
    bspline,
    curves_of,
    first_point,
    from_place,
    hold_tube,
    near_middle,
    near_segment,
    passes,
    piece_tree,
    point_in_world,
    spline_at,
)
from warp_psdr.kernels.primitive.curves_along import can_follow, follow_tube, must_follow
from warp_psdr.kernels.primitive.curves_search import (
    FOUND,
    GRAZES,
    SEARCHES,
    Spline,
    TubeSearch,
    search_on,
    search_tube,
    status_unfollowed,
)
from warp_psdr.kernels.primitive.curves_walk import BATCH, PIECES_AHEAD, Pieces, PieceTree
from warp_psdr.kernels.structs import Scene, Triangle

#: One in so many of the lanes at work has to wait for a piece until they are fetched (measured).
SHARE = 2
#: What a lane does.
DONE = wp.constant(0)
WAITS = wp.constant(1)
TESTS = wp.constant(2)
LOOKS = wp.constant(3)
FOLLOWS = wp.constant(4)


@wp.struct
class TubeWalk:
    """Where a lane is among the pieces that its ray comes by."""

    does: wp.int32
    item: wp.int32  # its piece, and where the ray enters its box
    after: wp.float32
    taken: wp.int32  # pieces of the batch
    segment: wp.int32
    low: wp.float32  # where the piece starts along the segment


@wp.struct
class TubeRay:
    """A ray of unit direction."""

    d: wp.vec3
    length: wp.float32  # of the direction as it was


@wp.struct
class ControlPoints:
    """Those of a segment in the world."""

    p0: wp.vec4
    p1: wp.vec4
    p2: wp.vec4
    p3: wp.vec4


@wp.struct
class TubeHit:
    """The nearest entry so far."""

    t: wp.float32  # in units of the direction's length
    beyond: wp.float32  # distance from next to the segment
    v: wp.float32
    segment: wp.int32  # -1: there is none


@wp.struct
class Pending:
    """Numbers of lanes."""

    waiting: wp.int32  # for a piece, or to be followed along one
    following: wp.int32
    all: wp.int32  # not done


def make_curve_lanes(width: int, first: int) -> SteppedLanes:
    """Make the functions for ``width`` lanes; ``first`` is the first row that they may take."""
    where_search = make_select(TubeSearch)
    rays, units, batches, walks, controls, splines, searches, entries = stack_rows(
        width, first, Ray, TubeRay, Pieces, TubeWalk, ControlPoints, Spline, TubeSearch, TubeHit
    )

    @wp.func
    def take(rows: ROWS, j: wp.int32, ray: Ray, wanted: wp.int32):
        rays.put(rows, j, ray)
        unit = TubeRay()
        unit.length = wp.length(ray.d)
        unit.d = ray.d / unit.length
        units.put(rows, j, unit)
        walk = TubeWalk()
        walk.does = wp.where(wanted == 1, WAITS, DONE)
        walk.after = -1.0
        walk.taken = wp.static(BATCH)
        walks.put(rows, j, walk)
        entry = TubeHit()
        entry.t = ray.t_max
        entry.segment = -1
        entries.put(rows, j, entry)

    @wp.func
    def fetch(scene: Scene, g: Curves, tree: PieceTree, rows: ROWS):
        """The next piece of every lane that waits for one."""
        size = 1.0 / wp.float32(g.pieces)
        j = wp.int32(0)
        while j < width:
            walk = walks.get(rows, j)
            if walk.does == WAITS:
                t = entries.get(rows, j).t
                batch = batches.get(rows, j)
                if walk.taken == wp.static(BATCH):
                    ray = rays.get(rows, j)
                    batch = PIECES_AHEAD(tree, ray.o, ray.d, t, walk.after, walk.item)
                    batches.put(rows, j, batch)
                    walk.taken = 0
                walk.does = DONE
                if walk.taken < batch.count:
                    enter = batch.enter[walk.taken]
                    if enter <= t:
                        walk.does = TESTS
                        walk.after = enter
                        walk.item = batch.items[walk.taken]
                        walk.taken += 1
                        walk.segment = walk.item / g.pieces
                        walk.low = wp.float32(walk.item - walk.segment * g.pieces) * size
                        i = first_point(scene, g, walk.segment)
                        points = ControlPoints()
                        points.p0 = point_in_world(scene, g, i)
                        points.p1 = point_in_world(scene, g, i + 1)
                        points.p2 = point_in_world(scene, g, i + 2)
                        points.p3 = point_in_world(scene, g, i + 3)
                        controls.put(rows, j, points)
                walks.put(rows, j, walk)
            j += 1

    @wp.func
    def prepare(g: Curves, rows: ROWS):
        """Test the new pieces, and start searches."""
        size = 1.0 / wp.float32(g.pieces)
        j = wp.int32(0)
        while j < width:
            walk = walks.get(rows, j)
            points = controls.get(rows, j)
            o = rays.get(rows, j).o
            unit = units.get(rows, j)
            near = near_middle(from_place(points.p1, o), from_place(points.p2, o), unit.d)
            place = o + near * unit.d
            s = bspline(
                from_place(points.p0, place),
                from_place(points.p1, place),
                from_place(points.p2, place),
                from_place(points.p3, place),
            )
            splines.put(rows, j, s)
            tests = walk.does == TESTS
            most = entries.get(rows, j).t * unit.length - near
            started = search_tube(s, unit.d, walk.low, size, -near, most)
            searches.put(rows, j, where_search(tests, started, searches.get(rows, j)))
            does = wp.where(must_follow(s, unit.d, walk.low, size), FOLLOWS, LOOKS)
            does = wp.where(passes(s, unit.d, walk.low, size), WAITS, does)
            walk.does = wp.where(tests, does, walk.does)
            walks.put(rows, j, walk)
            j += 1

    @wp.func
    def follow(g: Curves, after_hit: wp.int32, rows: ROWS):
        """Meet the pieces along which rays run, or that they graze."""
        size = 1.0 / wp.float32(g.pieces)
        j = wp.int32(0)
        while j < width:
            walk = walks.get(rows, j)
            if walk.does == FOLLOWS:
                search = searches.get(rows, j)
                s = splines.get(rows, j)
                unit = units.get(rows, j)
                walk.does = WAITS
                if can_follow(s, unit.d, walk.low, size):
                    extent = wp.max(wp.abs(rays.get(rows, j).o - search.least * unit.d))
                    at = follow_tube(s, unit.d, walk.low, size, search.least, search.most, extent)
                    if at[0] < wp.inf:
                        entry = TubeHit()
                        entry.t = (at[0] - search.least) / unit.length
                        entry.beyond = at[0]
                        entry.v = at[1]
                        entry.segment = walk.segment
                        entries.put(rows, j, entry)
                        walk.does = after_hit
                elif status_unfollowed(search) == SEARCHES:
                    search.status = SEARCHES
                    searches.put(rows, j, search)
                    walk.does = LOOKS
                walks.put(rows, j, walk)
            j += 1

    @wp.func
    def look_on(after_hit: wp.int32, rows: ROWS) -> Pending:
        """A round of every search."""
        pending = Pending()
        j = wp.int32(0)
        while j < width:
            walk = walks.get(rows, j)
            unit = units.get(rows, j)
            search = searches.get(rows, j)
            looks = walk.does == LOOKS
            on = search_on(splines.get(rows, j), unit.d, search)
            searches.put(rows, j, where_search(looks, on, search))
            found = looks and on.status == FOUND
            entry = entries.get(rows, j)
            # ``least`` is how far the ray's origin is from next to the segment.
            entry.t = wp.where(found, (on.t - search.least) / unit.length, entry.t)
            entry.beyond = wp.where(found, on.t, entry.beyond)
            entry.v = wp.where(found, on.v, entry.v)
            entry.segment = wp.where(found, walk.segment, entry.segment)
            entries.put(rows, j, entry)
            does = wp.where(on.status == GRAZES, FOLLOWS, wp.where(on.status == SEARCHES, LOOKS, WAITS))
            walk.does = wp.where(looks, wp.where(found, after_hit, does), walk.does)
            walks.put(rows, j, walk)
            pending.waiting += wp.where(walk.does == WAITS or walk.does == FOLLOWS, 1, 0)
            pending.following += wp.where(walk.does == FOLLOWS, 1, 0)
            pending.all += wp.where(walk.does == DONE, 0, 1)
            j += 1
        return pending

    @wp.func
    def enter(scene: Scene, tri: Triangle, after_hit: wp.int32, rows: ROWS):
        g = curves_of(scene, tri)
        tree = piece_tree(scene, tri)
        pending = Pending()
        pending.waiting = width
        pending.all = width
        while pending.all > 0:
            if wp.static(SHARE) * pending.waiting >= pending.all:
                if pending.following > 0:
                    follow(g, after_hit, rows)
                fetch(scene, g, tree, rows)
                prepare(g, rows)
            pending = look_on(after_hit, rows)

    @wp.func
    def closest(scene: Scene, tri: Triangle, rows: ROWS):
        enter(scene, tri, WAITS, rows)

    @wp.func
    def any_of(scene: Scene, tri: Triangle, rows: ROWS):
        enter(scene, tri, DONE, rows)

    @wp.func
    def hit(scene: Scene, tri: Triangle, rows: ROWS, j: wp.int32) -> RayHit:
        entry = entries.get(rows, j)
        r = RayHit()
        r.t = entry.t
        r.face = -1
        if entry.segment >= 0:
            g = curves_of(scene, tri)
            o = rays.get(rows, j).o
            d = units.get(rows, j).d
            s = spline_at(scene, g, entry.segment, o + near_segment(scene, g, entry.segment, o, d) * d)
            r.face = 0
            r = hold_tube(r, entry.segment, s, d, entry.beyond, entry.v)
        return r

    @wp.func
    def blocked(rows: ROWS, j: wp.int32) -> wp.bool:
        return entries.get(rows, j).segment >= 0

    return SteppedLanes(take, closest, any_of, hit, blocked, entries.end)

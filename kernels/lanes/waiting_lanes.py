"""Paths that stand on a surface and wait until there are as many as lanes (``path_lanes.py``).

Most rays of an open scene leave it. If the paths of a bundle continued in their lanes, a few of them would be shaded
while all the other lanes were computed in vain. Instead, the state that a path hands to its next vertex is appended to
a queue, word by word, and full registers of paths are shaded from its front. A queue is emptied as it is filled again:
no more is appended than has been taken.

Derivation: ``docs/theory/rays.md#paths-that-wait``.
"""

from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.bvh.simd import TYPES
from warp_psdr.kernels.bvh.wide import native
from warp_psdr.kernels.camera_rays import Bundle
from warp_psdr.kernels.lanes.lanes import QUEUE_ROOM, ROOM, ROWS, Rows, stack_rows
from warp_psdr.kernels.lanes.path_lanes import LanePaths
from warp_psdr.kernels.lanes.place_lanes import LaneHit
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.sensor.camera import CameraSample
from warp_psdr.kernels.structs import Camera, Scene

_APPEND = (
    TYPES
    + """
    const u32 mask = Simd::mask(*(const int_row*)((const int*)rows.data + waits * $W) != 0);
    typedef int any_word __attribute__((may_alias));
    any_word* to = (any_word*)rows.data + $FIRST * $W + length;
    int order[$W] __attribute__((aligned(64))) = {};  // their numbers
    int n = 0;
    for (u32 rest = mask; rest; rest &= rest - 1)
        order[n++] = __builtin_ctz(rest);
    const vi lanes = *(const vi*)order;
    const int spans[][2] = {$SPANS};
    for (const auto& span : spans)
        for (int i = 0; i < span[1]; ++i, to += $ROOM) {
            const int_row* from = (const int_row*)((const int*)rows.data + (span[0] + i) * $W);
#if $W == 16 && defined(__AVX512F__)
            const vi word = *from;
            *(int_row*)to = __builtin_ia32_compresssi512_mask(word, vi(0), mask);
#elif $W == 8 && defined(__AVX2__)
            *(int_row*)to = __builtin_ia32_permvarsi256(*from, lanes);
#else
            const vi word = *from;
            int words[$W];
            *(int_row*)words = word;
            for (int k = 0; k < $W; ++k)
                to[k] = words[order[k]];
#endif
        }
    return length + __builtin_popcount(mask);
"""
)

_TAKE = (
    TYPES
    + """
    const int* from = (const int*)rows.data + $FIRST * $W + front;
    const int spans[][2] = {$SPANS};
    for (const auto& span : spans)
        for (int i = 0; i < span[1]; ++i, from += $ROOM)
            *(int_row*)((int*)rows.data + (span[0] + i) * $W) = *(const int_row*)from;
"""
)


@wp.struct
class CameraPath:
    """What became of a sample: where it lies on the film, and the radiance that it found."""

    sample: CameraSample
    radiance: wp.vec3


@wp.struct
class Staying:
    """Whether a path waits for its next vertex to be shaded."""

    waits: wp.int32


class Queue(NamedTuple):
    """A queue of paths, or of what else is in lanes.

    Attributes:
        room: number of those that it holds.
        append: ``(rows, waits, length) -> int``: the lanes in which row ``waits`` is not 0, behind the first
            ``length`` that wait; how many wait then.
        take: ``(rows, front)``: into the lanes, those from ``front`` on; behind the last one comes anything.
    """

    room: int
    append: wp.Function
    take: wp.Function


def make_queue(width: int, records: tuple[Rows, ...]) -> Queue:
    """Make the functions.

    Args:
        width: number of lanes.
        records: what is kept of each, in lanes.
    """
    words = sum(span.end - span.first for span in records)
    # One register less, for whole ones are stored.
    registers = QUEUE_ROOM // words - 1

    def append(rows: ROWS, waits: wp.int32, length: wp.int32) -> wp.int32:
        return wp.int32(0)

    def take(rows: ROWS, front: wp.int32):
        return

    values = {
        "SPANS": ", ".join(f"{{{span.first}, {span.end - span.first}}}" for span in records),
        "ROOM": str((registers + 1) * width),
        "FIRST": str(ROOM),
    }
    sources = []
    for source in (_APPEND, _TAKE):
        for key, value in values.items():
            source = source.replace(f"${key}", value)
        sources.append(source)
    return Queue(
        registers * width,
        native("append_paths", sources[0], width, append),
        native("take_paths", sources[1], width, take),
    )


def make_trace_waiting(scatter: bool, paths: LanePaths) -> tuple[int, wp.Function]:
    """Return the number of paths that are traced together, and the function that traces them.

    ``trace_waiting(scene, camera, pixels, bundle, max_depth, rr_depth, paths_out)``: the samples of a bundle, in
    their order.

    Args:
        scatter: False: paths end at the first surface.
        paths: how its paths are traced; nothing of their vertices is kept.
    """
    width, on_places = paths.width, paths.on_places
    lane_samples, states, hits = paths.lane_samples, paths.states, paths.hits
    cameras, sums = paths.cameras, paths.sums
    choices, emissions = on_places.choices, on_places.emissions
    (staying,) = stack_rows(width, paths.end, Staying)
    queue = make_queue(width, (lane_samples, states, hits, cameras, sums, emissions))
    staying_row = staying.first

    @wp.func
    def end_or_wait(last: wp.bool, rows: ROWS):
        """Add what has arrived to the paths that end, and say which wait."""
        j = wp.int32(0)
        while j < width:
            state = states.get(rows, j)
            total = sums.get(rows, j)
            stays = Staying()
            stays.waits = wp.where(last, 0, choices.get(rows, j).on)
            ends = state.alive == 1 and stays.waits == 0
            gained = total.radiance + wp.cw_mul(state.throughput, emissions.get(rows, j).direct)
            total.radiance = where3(ends, gained, total.radiance)
            sums.put(rows, j, total)
            staying.put(rows, j, stays)
            j += 1

    @wp.func
    def take_next(scene: Scene, front: wp.int32, count: wp.int32, rows: ROWS):
        """``count`` of the paths that wait, to where they stand."""
        queue.take(rows, front)
        j = wp.int32(0)
        while j < width:
            state = states.get(rows, j)
            state.alive = wp.where(j < count, 1, 0)
            states.put(rows, j, state)
            choice = LaneHit()
            choice.on = state.alive
            choice.face = wp.where(j < count, hits.get(rows, j).face, 0)
            choices.put(rows, j, choice)
            j += 1
        on_places.fetch(scene, rows)

    @wp.func
    def trace_waiting(
        scene: Scene,
        camera: Camera,
        pixels: wp.array(dtype=wp.int32),
        bundle: Bundle,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        paths_out: wp.array(dtype=CameraPath),
    ):
        rows = scene.rows
        view = paths.view(scene, camera)
        # Those that wait for their vertex behind ``depth`` others, or for the camera's ray.
        depth = wp.int32(-1)
        waiting = wp.int32(bundle.pixels * bundle.samples)
        front = wp.int32(0)
        following = wp.int32(0)
        while front < waiting:
            count = wp.min(waiting - front, width)
            if depth < 0:
                paths.start(scene, camera, view, pixels, bundle, front, 0, rows)
            else:
                if wp.static(scatter):
                    take_next(scene, front, count, rows)
                    paths.scatter(scene, count, depth, max_depth, rr_depth, rows)
                    paths.advance(True, rows)
            paths.trace(scene, depth + 1, rows)
            on_places.see(rows)
            on_places.collect(scene, rows)
            last = wp.static(not scatter) or (max_depth >= 0 and depth + 2 >= max_depth)
            end_or_wait(last, rows)
            following = queue.append(rows, staying_row, following)
            for j in range(count):
                if staying.get(rows, j).waits == 0:
                    path = CameraPath()
                    path.sample = cameras.get(rows, j)
                    path.radiance = sums.get(rows, j).radiance
                    paths_out[lane_samples.get(rows, j).number] = path
            front += width
            if front >= waiting:
                depth += 1
                waiting = following
                front = wp.int32(0)
                following = wp.int32(0)

    return queue.room, trace_waiting

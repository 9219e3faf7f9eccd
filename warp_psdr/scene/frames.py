"""The values of a scene at several moments, and the way back to them: each rendering on a tape has its own."""

from __future__ import annotations

import contextlib
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.scene.edits import State
from warp_psdr.scene.layout import POSITIONS, SHAPE_POSE
from warp_psdr.scene.poses import Local

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Numbers that are kept together where any of them differs.
BLOCK = 1024


@contextlib.contextmanager
def held_at(scene: Scene, state: State) -> Iterator[None]:
    """Let a scene hold a state for a while, whatever arrays are bound to it, and then again what it holds now."""
    scene.settle()
    later, arrays = scene.state(), scene.bindings.suspend()
    try:
        scene.restore(state)
        yield
    finally:
        scene.restore(later)
        scene.bindings.resume(arrays)


@dataclass(frozen=True)
class Frame:
    """A moment: the blocks whose values differ from those of the first moment, and poses."""

    frames: Frames
    blocks: dict[int, np.ndarray]
    local: dict[int, Local]

    @property
    def state(self) -> State:
        """What the scene held."""
        values = self.frames.first.copy()
        for number, block in self.blocks.items():
            values[number * BLOCK : number * BLOCK + block.size] = block
        return State(values, self.local)

    @property
    def nbytes(self) -> int:
        """Bytes that it takes, beside the first moment."""
        return sum(block.nbytes for block in self.blocks.values())


class Frames:
    """The moments of a scene that a tape goes back to.

    Args:
        scene: the scene.
        tape: the tape.

    Attributes:
        first: all values at the first moment, float32.
        count: number of moments.
    """

    def __init__(self, scene: Scene, tape: wp.Tape):
        self.scene, self.tape = scene, weakref.ref(tape)
        self.first = scene.values.numpy().copy()
        self.count = 0

    def take(self) -> Frame:
        """Keep what the scene holds now."""
        self.count += 1
        held = self.scene.values.numpy()
        bits, first = held.view(np.int32), self.first.view(np.int32)
        starts = np.arange(0, held.size, BLOCK)
        differ = np.flatnonzero(np.logical_or.reduceat(bits != first, starts)) if held.size else []
        blocks = {int(i): held[i * BLOCK : (i + 1) * BLOCK].copy() for i in differ}
        return Frame(self, blocks, self.scene.poses.state())


def bytes_of_frame(scene: Scene) -> int:
    """Return the most bytes that each further frame on a tape takes, of what bound arrays change."""
    stretches = []
    for name in scene.bindings.names:
        p = scene.parameters[name]
        stretches.append((p.offset, p.size))
        if p.uses & {POSITIONS, SHAPE_POSE}:
            for shape in (scene.builder.shapes[number] for number in p.owners):
                size, places = 3 * shape.vertex_count, scene.positions + 3 * shape.first_vertex
                stretches.append((places, size))
                if shape.smooth:
                    stretches.append((shape.normal_offset + 3 * shape.first_vertex, size))
    blocks = {b for first, size in stretches for b in range(first // BLOCK, (first + size - 1) // BLOCK + 1)}
    return len(blocks) * BLOCK * wp.types.type_size_in_bytes(scene.values.dtype)


def describe(scene: Scene) -> list[tuple[str, str, str]]:
    """Return the plan's line on the memory of frames; none where no array is bound."""
    names = scene.bindings.names
    if not names:
        return []
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return [("a frame on a tape", f"{bytes_of_frame(scene) / 1e6:.3g} MB", f"bound arrays change {shown}")]


#: By the numbers of a tape and of a scene; what a tape records keeps them.
_of_tapes: weakref.WeakValueDictionary[tuple[int, int], Frames] = weakref.WeakValueDictionary()


def frames_of(tape: wp.Tape, scene: Scene) -> Frames:
    """Return the moments of a scene on a tape."""
    key = id(tape), id(scene)
    found = _of_tapes.get(key)
    if found is None or found.tape() is not tape or found.scene is not scene:
        found = _of_tapes[key] = Frames(scene, tape)
    return found

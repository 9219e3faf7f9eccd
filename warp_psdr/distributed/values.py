"""What edits of a scene have changed since a pool first saw it: the only values that a step sends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_psdr.distributed.wire import Packed, pack, unpack
from warp_psdr.scene.edits import State

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


@dataclass(frozen=True)
class Changed:
    """The values that differ.

    Attributes:
        places: the bits of which values differ, packed; None: none.
        values: those values.
        local: object-space geometry of the posed shapes that differ.
        contact_ratio: the scene's.
    """

    places: Packed | None
    values: np.ndarray
    local: dict[int, Any]
    contact_ratio: float


def changed(base: State, scene: Scene) -> Changed:
    """Return how a scene differs from a state of it."""
    values = scene.values.numpy()
    differs = _bits(base.values) != _bits(values)
    before, now = (_plain(State(values, held)) for held in (base.local, scene.poses.state()))
    local = {shape: held for shape, held in now.items() if not _equal(held, before.get(shape))}
    places = pack(np.packbits(differs)) if differs.any() else None
    return Changed(places, values[differs], local, scene.contact_ratio)


def restore(base: State, scene: Scene, change: Changed) -> None:
    """Give a scene the values that another has, which differs so from a common state."""
    values = base.values.copy()
    if change.places is not None:
        differs = np.unpackbits(unpack(change.places), count=len(values)).view(bool)
        values[differs] = change.values
    scene.contact_ratio = change.contact_ratio
    scene.restore(State(values, base.local | change.local))


def _plain(state: State) -> dict[int, Any]:
    """Return the geometry of posed shapes in arrays of NumPy."""
    _state, (_values, local) = state.__reduce__()
    return local


def _equal(held: Any, other: Any) -> bool:
    if isinstance(held, tuple):
        return isinstance(other, tuple) and all(_equal(a, b) for a, b in zip(held, other, strict=True))
    return isinstance(other, np.ndarray) and np.array_equal(_bits(held), _bits(other))


def _bits(values: np.ndarray) -> np.ndarray:
    """Return numbers as they are stored: what is not a number equals itself, and zeros have signs."""
    return values.view(np.uint32 if values.itemsize == 4 else np.uint64)

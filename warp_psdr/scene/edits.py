"""Which parameters were edited in place, by a kernel or by ``assign``: those whose checksums have changed."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psdr.scene.layout import BRIGHTNESS, MEDIUM, POSITIONS, SHAPE_GRID, Parameter
from warp_psdr.scene.poses import Local


@dataclass(frozen=True)
class State:
    """What edits of a scene change: its values, and the object-space geometry of posed shapes."""

    values: np.ndarray
    local: dict[int, Local]

    def __reduce__(self):
        """Return the state with arrays of NumPy, which other processes take."""
        local = {k: v if isinstance(v, np.ndarray) else tuple(a.numpy() for a in v) for k, v in self.local.items()}
        return State, (self.values, local)


def has_results(p: Parameter) -> bool:
    """Return whether the scene keeps or checks what follows from a parameter: triangles, places, power, media."""
    return p.placed or (p.prototype >= 0 and POSITIONS in p.uses) or bool(p.uses & BRIGHTNESS) or is_checked(p)


def is_checked(p: Parameter) -> bool:
    """Return whether a parameter belongs to a medium, or is a shape's grid."""
    return any(use.startswith(MEDIUM) or use == SHAPE_GRID for use in p.uses)


def check_media(parameters: Iterable[Parameter], values: np.ndarray) -> None:
    """Raise if a value of a medium, or of a shape's grid, is none that it can have.

    Raises:
        ValueError: With the parameter and its range.
    """
    for p in filter(is_checked, parameters):
        low, high = p.bounds
        held = values[p.offset : p.offset + p.size]
        right = np.isfinite(held) & (held >= low) & (held <= high)
        if not right.all():
            wrong = held.tolist() if p.size <= 3 else f"{held[~right][0]:g} in {int((~right).sum())} of {p.size} places"
            limits = f"finite values of at least {low:g}" if np.isinf(high) else f"values between {low:g} and {high:g}"
            limits = "finite values" if np.isinf(low) else limits
            raise ValueError(f"{p.name} is {wrong} after an edit; write {limits} (psdr.optim keeps to them)")


def differing(parameters: Iterable[Parameter], held: np.ndarray, other: np.ndarray) -> list[Parameter]:
    """Return the parameters that two arrays of a scene's values hold different values of."""
    places = ((p, slice(p.offset, p.offset + p.size)) for p in parameters)
    return [p for p, place in places if not np.array_equal(held[place], other[place])]


#: Stretches of values that lie closer to each other are one: a call costs as much as a thousand numbers.
NEAR = 1024
#: Numbers of large arrays that are looked at together.
PART = 1 << 22


class Edits:
    """Checksums (CRC-32) of arrays as the scene followed them last.

    Args:
        arrays: By name.
        values: What holds all of them, to be looked at in few long stretches first; None: they lie elsewhere.
        places: (first, stop) of each array in it.
    """

    def __init__(self, arrays: Mapping[str, wp.array], values: wp.array | None, places: Iterable[tuple[int, int]]):
        self._arrays = arrays
        self._sums = {name: checksum(array) for name, array in arrays.items()}
        self._stretches = [] if values is None else [values[first:stop] for first, stop in _merged(places)]
        self._long = self._all_stretches()

    def found(self) -> list[str]:
        """Return the names of the arrays that differ from what was followed last."""
        now = self._all_stretches()
        if self._stretches and now == self._long:
            return []
        names = [name for name, array in self._arrays.items() if checksum(array) != self._sums[name]]
        if not names:  # what has changed lies between them
            self._long = now
        return names

    def follow(self, names: Iterable[str]) -> None:
        """Take the arrays as they are now."""
        for name in names:
            if name in self._arrays:
                self._sums[name] = checksum(self._arrays[name])
                self._long = []  # those of other values

    def _all_stretches(self) -> list[int]:
        return [checksum(stretch) for stretch in self._stretches]


def _merged(ranges: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return ranges (first, stop) in order, those that lie near each other as one."""
    found: list[tuple[int, int]] = []
    for first, stop in sorted(ranges):
        if found and first - found[-1][1] <= NEAR:
            found[-1] = found[-1][0], max(found[-1][1], stop)
        else:
            found.append((first, stop))
    return found


def checksum(array: wp.array) -> int:
    """Return the CRC-32 of an array; of a large one, parts come to the host one after the other."""
    if array.size <= PART:
        return zlib.crc32(array.numpy())
    flat, found = array.flatten(), 0
    for part in _parts(array.size):
        found = zlib.crc32(flat[part].numpy(), found)
    return found


def write_parts(values: wp.array, held: np.ndarray, new: np.ndarray) -> None:
    """Write the parts of a flat array that differ in any bit; ``held``: the array on the host.

    Pages of other parts stay common to the scene and its description (``pages``).
    """
    for part in _parts(new.size):
        if not np.array_equal(held[part].view(np.int32), new[part].view(np.int32)):
            values[part].assign(new[part])


def _parts(size: int) -> Iterator[slice]:
    """Return the parts of an array."""
    return (slice(first, min(first + PART, size)) for first in range(0, size, PART))

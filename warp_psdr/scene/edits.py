"""Which parameters were edited in place, by a kernel or by ``assign``: those whose checksums have changed."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psdr.scene.layout import BRIGHTNESS, POSITIONS, Parameter


@dataclass(frozen=True)
class State:
    """What edits of a scene change: its values, and the object-space geometry of posed shapes."""

    values: np.ndarray
    local: dict[int, tuple[wp.array, wp.array]]


def has_results(p: Parameter) -> bool:
    """Return whether the scene keeps anything that follows from a parameter: triangles, places, lights' power."""
    return p.placed or (p.prototype >= 0 and POSITIONS in p.uses) or bool(p.uses & BRIGHTNESS)


class Edits:
    """Checksums (CRC-32) of arrays as the scene followed them last.

    Args:
        arrays: By name.
    """

    def __init__(self, arrays: Mapping[str, wp.array]):
        self._arrays = arrays
        self._sums = {name: checksum(array) for name, array in arrays.items()}

    def found(self) -> list[str]:
        """Return the names of the arrays that differ from what was followed last."""
        return [name for name, array in self._arrays.items() if checksum(array) != self._sums[name]]

    def follow(self, names: Iterable[str]) -> None:
        """Take the arrays as they are now."""
        for name in names:
            if name in self._arrays:
                self._sums[name] = checksum(self._arrays[name])


def checksum(array: wp.array) -> int:
    """Return the CRC-32 of an array."""
    return zlib.crc32(array.numpy())

"""Tables of materials: numbers that device code reads and that follow from a material's values.

A model declares a ``Table`` (``kernels/bsdf/model.py``); ``MAKERS`` has the function that fills it. Tables
lie among the scene's values, unnamed. Before every launch ``follow`` compares the current values with those that each
table was made from, whatever changed them. A table therefore always belongs to the values that the kernels read beside
it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import warp as wp

from warp_psdr.scene.materials.rough_transmittance import transmittance

#: Name of a table -> ``(variant, *values) -> numbers``, the values those that the declaration says it follows from.
MAKERS: dict[str, Callable[..., np.ndarray]] = {"transmittance": transmittance}


class PlacedTable(NamedTuple):
    """A material's table among the scene's values; it begins with the values that it was made from.

    Attributes:
        name: key of ``MAKERS``.
        variant: of the material's model.
        offset: flat offset of its first number.
        sources: flat offsets of the values that it follows from.
    """

    name: str
    variant: str
    offset: int
    sources: tuple[int, ...]


def follow(tables: list[PlacedTable], values: wp.array) -> None:
    """Compute those tables again that were made from other values than there are now.

    Args:
        tables: of the scene.
        values: its values, flat float32; in place.
    """
    for table in tables:
        sources = [float(values[i : i + 1].numpy()[0]) for i in table.sources]
        if values[table.offset : table.offset + len(sources)].numpy().tolist() != sources:
            numbers = MAKERS[table.name](table.variant, *sources)
            values[table.offset : table.offset + numbers.size].assign(numbers)

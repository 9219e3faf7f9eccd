"""Names of items that come and go as a shape moves: the same from step to step, and near to each other where items are.

Guiding keeps what it knows of an item by its name (``estimate/guiding/intervals.py``).
"""

from __future__ import annotations

import numpy as np

#: Bits of a coordinate of a voxel, and of an item's number below its shape's record.
COORDINATE_BITS, ITEM_BITS = 13, 42


def grid_names(items: np.ndarray, shape: dict[int, tuple[int, int]]) -> np.ndarray:
    """Return names of items of grids: voxels beside each other have near ones (Morton order).

    Args:
        items: (n, 2) records and numbers, as ``grid_points.py`` of the kernels has them.
        shape: record -> numbers of nodes along x and y.
    """
    found = np.zeros(len(items), np.int64)
    for record, (nx, ny) in shape.items():
        rows = items[:, 0] == record
        node, kind = items[rows, 1].astype(np.int64) >> 2, items[rows, 1].astype(np.int64) & 3
        code = np.zeros(len(node), np.int64)
        for axis, place in enumerate((node % nx, node // nx % ny, node // (nx * ny))):
            for bit in range(COORDINATE_BITS):
                code |= (place >> bit & 1) << (3 * bit + axis)
        found[rows] = (np.int64(record) << ITEM_BITS) | (code << 2) | kind
    return found


def curve_names(items: np.ndarray) -> np.ndarray:
    """Return names of items (n, 2) of curves: in their order along them."""
    return (items[:, 0].astype(np.int64) << ITEM_BITS) | items[:, 1]

"""What grids of signed distances and networks have in common: the zero set of a function phi in the box [0, 1]^3."""

from __future__ import annotations

import itertools
from abc import abstractmethod
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.scene.kinds.affine import placed
from warp_psdr.scene.kinds.kind import Geometry

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Corners of the box.
CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)), np.float32)


class ZeroSet(Geometry):
    """The zero set of a function in [0, 1]^3."""

    has_uv = False

    @property
    @abstractmethod
    def nodes(self) -> tuple[int, int, int]:
        """Number of the nodes along x, y and z: of a network, of the corners of its cells."""

    def corners(self, to_world: np.ndarray) -> np.ndarray:
        """Return the corners (8, 3) of its box."""
        return CORNERS

    def position(self, scene: Scene, record: np.void, u: float, v: float) -> np.ndarray:
        """Return the point (3,) that a vertex holds."""
        return placed(record, held_points(u, v))


def held_points(u, v) -> np.ndarray:
    """Return the points (..., 3) of a box that pairs of numbers hold (``kernels/primitive/sdfgrid.py``)."""
    a, b = (np.ascontiguousarray(x, np.float32).view(np.uint32) for x in (u, v))
    low = ((a >> 21) & 511) | ((a >> 31) << 9)
    high = ((b >> 21) & 511) | ((b >> 31) << 9)
    steps = np.stack([a & 0x1FFFFF, b & 0x1FFFFF, low | (high << 10)], axis=-1).astype(np.float64)
    points = (steps + 0.5) / np.array([2.0**21, 2.0**21, 2.0**20])
    return points.reshape(*np.shape(u), 3)

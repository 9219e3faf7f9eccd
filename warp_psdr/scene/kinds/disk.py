"""The exact disk (``kernels/primitive/disk.py``)."""

from __future__ import annotations

import numpy as np

from warp_psdr.kernels.primitive.disk import DISK
from warp_psdr.scene.kinds.affine import Exact, corners_of
from warp_psdr.scene.shapes import primitives


class Disk(Exact):
    """The unit disk in the plane z = 0."""

    plugin = name = "disk"
    device = DISK
    box = corners_of((-1.0, 1.0), (-1.0, 1.0), (0.0,))
    tessellate = staticmethod(primitives.disk)

    def reach(self, way: np.ndarray) -> float:
        """Return how far the circle reaches."""
        return float(np.linalg.norm(way[:2]))

    @staticmethod
    def points(u, v) -> np.ndarray:
        """Return the points (..., 3) with the coordinates x and y."""
        return np.stack([u, v, np.zeros_like(u)], axis=-1)

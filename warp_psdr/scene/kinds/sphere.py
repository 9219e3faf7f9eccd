"""The exact sphere (``kernels/primitive/sphere.py``)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels.primitive.sphere import SPHERE
from warp_psdr.scene.kinds.affine import Exact, corners_of
from warp_psdr.scene.shapes import primitives
from warp_psdr.scene.transforms import Transform

if TYPE_CHECKING:
    from warp_psdr.scene.plugins import Properties


class Sphere(Exact):
    """The unit sphere."""

    plugin = name = "sphere"
    device = SPHERE
    invertible = "give it an extent along all axes, or use a 'disk'"
    box = corners_of((-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0))
    tessellate = staticmethod(primitives.sphere)

    @classmethod
    def frame(cls, props: Properties) -> np.ndarray:
        """Return the matrix of ``center`` and ``radius``."""
        center = props.vector("center", (0.0, 0.0, 0.0))
        radius = props.number("radius", 1.0, minimum=0.0, exclusive=True)
        return Transform.translate(center).scale(radius).matrix

    def reach(self, way: np.ndarray) -> float:
        """Return the length of w."""
        return float(np.linalg.norm(way))

    @staticmethod
    def points(u, v) -> np.ndarray:
        """Return points (..., 3) by octahedral coordinates."""
        u, v = np.asarray(u, np.float64), np.asarray(v, np.float64)
        z = 1.0 - np.abs(u) - np.abs(v)
        x = np.where(z < 0.0, np.where(u < 0.0, np.abs(v) - 1.0, 1.0 - np.abs(v)), u)
        y = np.where(z < 0.0, np.where(v < 0.0, np.abs(u) - 1.0, 1.0 - np.abs(u)), v)
        q = np.stack([x, y, z], axis=-1)
        return q / np.linalg.norm(q, axis=-1, keepdims=True)

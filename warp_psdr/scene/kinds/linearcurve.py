"""Straight segments with a radius: cones between spheres (``kernels/primitive/curves.py``)."""

from __future__ import annotations

import numpy as np

from warp_psdr.kernels.primitive.curve_kinds import CONES
from warp_psdr.scene.kinds.curve import Curves


class LinearCurve(Curves):
    """Curves of which each segment is a cone between the spheres of two control points."""

    plugin = name = "linearcurve"
    device = CONES
    order, cubic = 2, False

    def legs(self, points: np.ndarray) -> np.ndarray:
        """Return the ends of the segments."""
        return np.stack([points[self.firsts], points[self.firsts + 1]])

    def ring(self, points: np.ndarray, first: int, along: float) -> tuple[np.ndarray, np.ndarray, float | None]:
        """Return a ring of the cone, or of a sphere at its ends."""
        p0, p1 = points[first : first + 2]
        axis = (p1 - p0)[:3]
        touch = np.arccos(np.clip((p0 - p1)[3] / np.linalg.norm(axis), -1.0, 1.0))
        angle = np.interp(along, [0.0, 0.25, 0.75, 1.0], [np.pi, touch, touch, 0.0])
        return p0 + np.clip(2.0 * along - 0.5, 0.0, 1.0) * (p1 - p0), axis, float(angle)

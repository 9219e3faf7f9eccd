"""The exact cylinder (``kernels/primitive/cylinder.py``)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels.primitive.cylinder import CYLINDER
from warp_psdr.scene.errors import error
from warp_psdr.scene.kinds.affine import Exact, corners_of
from warp_psdr.scene.shapes import primitives
from warp_psdr.scene.transforms import Transform

if TYPE_CHECKING:
    from warp_psdr.scene.plugins import Properties


class Cylinder(Exact):
    """The open cylinder of radius 1 about z, from z = 0 to z = 1."""

    plugin = name = "cylinder"
    device = CYLINDER
    box = corners_of((-1.0, 1.0), (-1.0, 1.0), (0.0, 1.0))
    tessellate = staticmethod(primitives.cylinder)

    @classmethod
    def frame(cls, props: Properties) -> np.ndarray:
        """Return the matrix of ``p0``, ``p1`` and ``radius``."""
        p0, p1 = props.vector("p0", (0.0, 0.0, 0.0)), props.vector("p1", (0.0, 0.0, 1.0))
        radius = props.number("radius", 1.0, minimum=0.0, exclusive=True)
        length = float(np.linalg.norm(p1 - p0))
        if length == 0.0:
            raise error(props.where, f"p0 and p1 are both {p0.tolist()}", "give the two ends of the cylinder's axis")
        frame = np.eye(4)
        frame[:3, 0], frame[:3, 1] = _tangents((p1 - p0) / length)
        frame[:3, 2] = (p1 - p0) / length
        return Transform.translate(p0).matrix @ frame @ np.diag([radius, radius, length, 1.0])

    def reach(self, way: np.ndarray) -> float:
        """Return how far the circle reaches, and half of the height."""
        return float(np.linalg.norm(way[:2]) + 0.5 * abs(way[2]))

    @staticmethod
    def points(u, v) -> np.ndarray:
        """Return the points (..., 3) by the angle around the axis and the height."""
        return np.stack([np.cos(u), np.sin(u), v], axis=-1)

    @classmethod
    def widened(cls, ratio: float) -> np.ndarray:
        """Return a scale across the axis alone."""
        return np.array([ratio, ratio, 1.0])


def _tangents(n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors that make a right-handed frame with ``n``, the same ones as in Mitsuba.

    T. Duff et al., "Building an orthonormal basis, revisited", JCGT 6(1), 2017.
    """
    sign = np.copysign(1.0, n[2])
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return (
        np.array([1.0 + sign * n[0] ** 2 * a, sign * b, -sign * n[0]]),
        np.array([b, sign + n[1] ** 2 * a, -n[1]]),
    )

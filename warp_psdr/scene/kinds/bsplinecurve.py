"""Cubic B-splines with a radius (``kernels/primitive/curves.py``)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels.primitive.curve_kinds import TUBES
from warp_psdr.scene.kinds.curve import Curves

if TYPE_CHECKING:
    from warp_psdr.scene.plugins import Properties

#: Turn of a segment's axis, radians, up to which a ray is carried safely along a piece of it.
TURN = 0.2
#: Pieces of a segment, at most, and at least: short pieces have tight boxes. Where they are shorter than wide, more of
#: them cost more than they save.
PIECES = (2, 16)
WIDE_PIECES = 4


class BSplineCurve(Curves):
    """Curves of which each segment is a cubic B-spline between four control points."""

    plugin = name = "bsplinecurve"
    device = TUBES
    order, cubic = 4, True

    def prepare(self, props: Properties, place: str) -> None:
        """Find into how many pieces segments are cut, and note those that run through themselves."""
        a = coefficients(self.points.astype(np.float64), self.firsts)
        _note_folds(props, a, place)
        self.pieces = _pieces(a)

    def legs(self, points: np.ndarray) -> np.ndarray:
        """Return the Bezier points of the pieces."""
        a, size = coefficients(points, self.firsts), 1.0 / self.pieces
        return np.stack([_bezier(a, k * size, size) for k in range(self.pieces)], axis=2).reshape(4, -1, 4)

    def ring(self, points: np.ndarray, first: int, along: float) -> tuple[np.ndarray, np.ndarray, float | None]:
        """Return the point of the spline and its slope."""
        a = coefficients(points, np.array([first]))[:, 0]
        return np.polyval(a[::-1], along), np.polyval([3 * a[3], 2 * a[2], a[1]], along)[:3], None


def coefficients(points: np.ndarray, firsts: np.ndarray) -> np.ndarray:
    """Return the coefficients of 1, v, v^2, v^3 of cubic segments, (4, S, 4)."""
    p0, p1, p2, p3 = (points[firsts + k] for k in range(4))
    return np.stack(
        [(p0 + 4.0 * p1 + p2) / 6.0, (p2 - p0) / 2.0, (p0 - 2.0 * p1 + p2) / 2.0, (p3 - p0 + 3.0 * (p1 - p2)) / 6.0]
    )


def _note_folds(props: Properties, a: np.ndarray, place: str) -> None:
    """Note segments, of the coefficients ``a``, whose radius of curvature is below their own in the middle."""
    slope = a[1] + a[2] + 0.75 * a[3]
    bend = 2.0 * a[2] + 3.0 * a[3]
    curvature = np.linalg.norm(np.cross(slope[:, :3], bend[:, :3]), axis=1)
    radius = (a[0] + 0.5 * a[1] + 0.25 * a[2] + 0.125 * a[3])[:, 3]
    tight = int((radius * curvature > np.linalg.norm(slope[:, :3], axis=1) ** 3).sum())
    if tight:
        props.context.note(f"{place}: {tight} segments bend more than their radius allows, and run through themselves")


def _bezier(a: np.ndarray, start: float, size: float) -> np.ndarray:
    """Return the Bezier points (4, S, 4) of cubics from a place on, over a size."""
    b0 = a[0] + start * (a[1] + start * (a[2] + start * a[3]))
    b1 = size * (a[1] + start * (2.0 * a[2] + 3.0 * start * a[3]))
    b2 = size**2 * (a[2] + 3.0 * start * a[3])
    b3 = size**3 * a[3]
    return np.stack([b0, b0 + b1 / 3.0, b0 + (2.0 * b1 + b2) / 3.0, b0 + b1 + b2 + b3])


def _pieces(a: np.ndarray) -> int:
    """Return into how many pieces cubic segments are cut: a power of two, by the turn between their Bezier legs."""
    legs = _bezier(a, 0.0, 1.0)
    steps = np.diff(legs[..., :3], axis=0)
    lengths = np.linalg.norm(steps, axis=2)
    turns = []
    for k in range(2):
        product = np.maximum(lengths[k] * lengths[k + 1], 1e-300)
        turns.append(np.arccos(np.clip((steps[k] * steps[k + 1]).sum(axis=1) / product, -1.0, 1.0)))
    widest = max(float(np.add(*turns).max()), 1e-9)
    radius = np.maximum(legs[..., 3].max(axis=0), 1e-300)
    slender = float(np.median(lengths.sum(axis=0) / radius))
    most = np.clip(slender, WIDE_PIECES, PIECES[1])
    return int(2 ** np.ceil(np.log2(np.clip(widest / TURN, PIECES[0], most))))

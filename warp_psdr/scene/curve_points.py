"""Points of curves on the host, in float64: the polynomials of B-splines, and what vertices hold."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels.primitive.curves import HEADER, MOST_SEGMENTS

if TYPE_CHECKING:
    from .scene import Scene


def coefficients(points: np.ndarray, firsts: np.ndarray) -> np.ndarray:
    """Return the coefficients of 1, v, v^2, v^3 of cubic segments, (4, S, 4)."""
    p0, p1, p2, p3 = (points[firsts + k] for k in range(4))
    return np.stack(
        [(p0 + 4.0 * p1 + p2) / 6.0, (p2 - p0) / 2.0, (p0 - 2.0 * p1 + p2) / 2.0, (p3 - p0 + 3.0 * (p1 - p2)) / 6.0]
    )


def world_points(scene: Scene, shape: int) -> np.ndarray:
    """Return the control points (P, 4) of curves in the device's coordinates, float64."""
    curves = scene.description.shapes[shape].curves
    assert curves is not None
    first = scene.builder.curves[shape] + HEADER + curves.points.size
    return scene.values[first : first + curves.points.size].numpy().astype(np.float64).reshape(-1, 4)


def held_curve_point(scene: Scene, shape: int, held: np.ndarray) -> np.ndarray:
    """Return the point (3,) of curves that a vertex holds (``kernels/primitive/curves.py``).

    Args:
        scene: the scene.
        shape: the number of the curves.
        held: (3,) place along the segment, turns around it, and its number, as fractions.
    """
    curves = scene.description.shapes[shape].curves
    assert curves is not None
    points = world_points(scene, shape)
    k, along, angle = curves.firsts[int(held[2] * MOST_SEGMENTS)], float(held[0]), None
    if curves.cubic:
        a = coefficients(points, np.array([k]))[:, 0]
        c, axis = np.polyval(a[::-1], along), np.polyval([3 * a[3], 2 * a[2], a[1]], along)[:3]
    else:
        p0, p1 = points[k : k + 2]
        axis = (p1 - p0)[:3]
        touch = np.arccos(np.clip((p0 - p1)[3] / np.linalg.norm(axis), -1.0, 1.0))
        angle = np.interp(along, [0.0, 0.25, 0.75, 1.0], [np.pi, touch, touch, 0.0])
        c = p0 + np.clip(2.0 * along - 0.5, 0.0, 1.0) * (p1 - p0)
    axis = axis / np.linalg.norm(axis)
    up = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
    up = up / np.linalg.norm(up) if up @ up > 1.0e-12 else np.array([0.0, 1.0, 0.0])
    turn = 2.0 * np.pi * held[1]
    e = np.cos(turn) * np.cross(up, axis) + np.sin(turn) * up
    return c[:3] + c[3] * (e if angle is None else np.sin(angle) * e + np.cos(angle) * axis)

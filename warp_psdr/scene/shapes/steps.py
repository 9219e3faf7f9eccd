"""Scenes of mixed scales: shapes that are small for their world, and vast triangles that touch them.

``kernels/step.py`` has the steps themselves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from warp_psdr.kernels.boundary.local_form import START_BEHIND, START_BEHIND_LEAST
from warp_psdr.kernels.step import RAY_EPSILON, RESOLVED, TOUCH

#: Shapes below this many ray epsilons make the scene one of mixed scales; above it a single step costs the derivatives
#: of silhouettes 0.1 %.
MIXED = 300.0
#: A shape touches what is nearer than this fraction of its own largest coordinate: rounding of either's vertices.
NEAR = 1.0e-5


class Steps(NamedTuple):
    """Steps of a scene, world units.

    Attributes:
        scene: the least step of all at edges; 0: the scene has one scale.
        shapes: (S,) the step at the edges of each shape; zeros where the scene has one scale.
        behind: (S,) how deep another shape may enter this one and still be taken to touch it.
        far: (S,) the largest coordinate that roundings go by: the shape's own, or that of the whole scene if it has one
            scale.
    """

    scene: float
    shapes: np.ndarray
    behind: np.ndarray
    far: np.ndarray


class Boxes(NamedTuple):
    """Boxes around the shapes of a scene.

    Attributes:
        low, high: (S, 3) float64, world units; a shape without vertices has infinity and minus infinity.
        size: (S,) lengths of their diagonals; 0 without vertices.
    """

    low: np.ndarray
    high: np.ndarray
    size: np.ndarray


def measure(points: np.ndarray, spans: list[tuple[int, int]]) -> Boxes:
    """Return the boxes of shapes; not finite where a vertex is not.

    Args:
        points: (N, 3) of all vertices.
        spans: (first vertex, number of vertices) of each shape.
    """
    low, high = np.full((len(spans), 3), np.inf), np.full((len(spans), 3), -np.inf)
    for i, (first, count) in enumerate(spans):
        if count:
            own = points[first : first + count]
            low[i], high[i] = own.min(axis=0), own.max(axis=0)
    size = np.zeros(len(spans))
    some = [i for i, (_first, count) in enumerate(spans) if count]
    size[some] = np.linalg.norm(high[some] - low[some], axis=1)
    return Boxes(low, high, size)


def second_width(points: np.ndarray) -> float:
    """Return how wide points lie across the direction in which they reach farthest: 0 on a line. (N, 3), N > 0."""
    centered = points.astype(np.float64) - points.mean(axis=0, dtype=np.float64)
    axes = np.linalg.eigh(centered.T @ centered)[1]
    return float(np.sort(np.ptp(centered @ axes, axis=0))[1])


def find_steps(
    points: np.ndarray, triangles: np.ndarray, first_face: list[int], boxes: Boxes, ray_epsilon: float
) -> Steps:
    """Return the steps.

    At a shape's edges, whatever lies there may be off its place by roundings of its own coordinates. What may lie there
    is every triangle whose box meets the shape's.

    Args:
        points: (N, 3) of all vertices.
        triangles: (F, 3) their numbers, shape by shape.
        first_face: first triangle of each shape.
        boxes: around the shapes.
        ray_epsilon: the scene's.
    """
    low, high, size = boxes
    count = len(size)
    extent = ray_epsilon / RAY_EPSILON
    one = Steps(0.0, np.zeros(count), np.full(count, START_BEHIND * ray_epsilon), np.full(count, extent))
    if not size[size > 0.0].min(initial=np.inf) < MIXED * ray_epsilon:
        return one
    some = np.flatnonzero(np.isfinite(low[:, 0]))
    far = np.zeros(count)
    far[some] = np.maximum(np.abs(low[some]), np.abs(high[some])).max(axis=1)
    reach, margin = far.copy(), NEAR * far
    last = [*first_face[1:], len(triangles)]
    for i in some:
        near = (low <= high[i] + margin[i]).all(axis=1) & (high >= low[i] - margin[i]).all(axis=1) & (far > far[i])
        for j in np.flatnonzero(near):
            p = points[triangles[first_face[j] : last[j]]]
            met = (p.min(axis=1) <= high[i] + margin[i]).all(axis=1) & (p.max(axis=1) >= low[i] - margin[i]).all(axis=1)
            reach[i] = max(reach[i], float(np.abs(p[met]).max(initial=0.0)))
    step = np.zeros(count)
    step[some] = RAY_EPSILON * np.minimum(far[some], size[some])
    step = np.maximum(step, np.maximum(RESOLVED * far, TOUCH * reach))
    least = TOUCH * extent
    return Steps(least, step, np.maximum(START_BEHIND * (step - least), START_BEHIND_LEAST * step), far)

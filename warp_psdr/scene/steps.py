"""Scenes of mixed scales: which shapes are small for their world, and what vast triangles touch them.

See ``kernels/step.py`` for the steps themselves.
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


def find_steps(
    points: np.ndarray, triangles: np.ndarray, spans: list[tuple[int, int, int]], ray_epsilon: float
) -> Steps:
    """Return the steps.

    At a shape's edges, whatever lies there may be off its place by roundings of its own coordinates. What may lie there
    is every triangle whose box meets the shape's.

    Args:
        points: (N, 3) of all vertices.
        triangles: (F, 3) their numbers, shape by shape.
        spans: (first vertex, number of vertices, first triangle) of each shape.
        ray_epsilon: the scene's.
    """
    count = len(spans)
    extent = ray_epsilon / RAY_EPSILON
    one = Steps(0.0, np.zeros(count), np.full(count, START_BEHIND * ray_epsilon), np.full(count, extent))
    some = [i for i in range(count) if spans[i][1]]
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for i in some:
        own = points[spans[i][0] : spans[i][0] + spans[i][1]]
        low[i], high[i] = own.min(axis=0), own.max(axis=0)
    size = np.linalg.norm(high[some] - low[some], axis=1)
    if not size[size > 0.0].min(initial=np.inf) < MIXED * ray_epsilon:
        return one
    far = np.zeros(count)
    far[some] = np.maximum(np.abs(low[some]), np.abs(high[some])).max(axis=1)
    reach, margin = far.copy(), NEAR * far
    last = [span[2] for span in spans[1:]] + [len(triangles)]
    for i in some:
        near = (low <= high[i] + margin[i]).all(axis=1) & (high >= low[i] - margin[i]).all(axis=1) & (far > far[i])
        for j in np.flatnonzero(near):
            p = points[triangles[spans[j][2] : last[j]]]
            met = (p.min(axis=1) <= high[i] + margin[i]).all(axis=1) & (p.max(axis=1) >= low[i] - margin[i]).all(axis=1)
            reach[i] = max(reach[i], float(np.abs(p[met]).max(initial=0.0)))
    step = np.zeros(count)
    step[some] = RAY_EPSILON * np.minimum(far[some], size)
    step = np.maximum(step, np.maximum(RESOLVED * far, TOUCH * reach))
    least = TOUCH * extent
    return Steps(least, step, np.maximum(START_BEHIND * (step - least), START_BEHIND_LEAST * step), far)

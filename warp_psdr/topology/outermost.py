"""Edges that no segment between two path vertices, or a vertex and a light, touches: those of the scene's convex hull.

A segment that touches an edge has its ends on both sides of it. If the directions across an edge to everything else lie
within less than half a turn, no two of them are opposite: at the border of a floor, or of a lamp above all else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.topology.edges import scene_adjacency
from warp_psdr.topology.kinds.grid_silhouettes import light_eyes
from warp_psdr.topology.unchanged import kept

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Angle by which half a turn is missed, at least; and distance, over the scene's size, up to which a point lies on the
#: line through an edge.
LEAST_ANGLE, ON_LINE = 1.0e-3, 1.0e-6
#: Most pairs of an edge and a point, some 20 ms: where there are more, no edge is found.
MOST = 1 << 18


def outermost_edges(scene: Scene) -> np.ndarray:
    """Return which edges of ``scene_adjacency`` no segment passes, a mask (E,); kept until a value changes."""
    return kept(scene, "outermost edges", lambda: _find(scene))


def _find(scene: Scene) -> np.ndarray:
    edges, eyes = scene_adjacency(scene), light_eyes(scene)
    found = np.zeros(len(edges.length), bool)
    # Shapes without triangles lie within the boxes whose corners are among the points.
    if eyes is None or any(e.distant for e in eyes) or len(found) * len(scene.points) > MOST:
        return found
    points = np.concatenate([scene.points.astype(np.float64), *(e.corners for e in eyes)])
    least = ON_LINE * float(np.ptp(points, axis=0).max(initial=0.0))
    for number, (a, b) in enumerate(edges.points.astype(np.float64)):
        # Two axes across the edge.
        across = np.linalg.svd((b - a)[None])[2][1:]
        seen = (points - a) @ across.T
        seen = seen[np.linalg.norm(seen, axis=1) > least]
        turns = np.sort(np.arctan2(seen[:, 1], seen[:, 0]))
        gaps = np.diff(turns, append=turns[:1] + 2.0 * np.pi)
        found[number] = gaps.max(initial=0.0) > np.pi + LEAST_ANGLE
    return found

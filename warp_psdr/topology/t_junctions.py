"""T-junctions: sides of triangles that are cut where a vertex of the same shape lies on them.

If one triangle's side ac meets two sides ab and bc of others, no pair of vertices matches. All three would count as
open edges, and where the surface folds, its silhouette would be estimated twice. With ac cut at b every piece has its
counterpart, and is shared, or open, as the surface is. The piece ends in a vertex of the other side: b is taken to move
with both. (If b moves away from ac, the surface gapes on one of the two sides: an image has no derivative there.)

Only open sides are cut, since the others have their counterpart, and only at ends of open sides.
"""

from __future__ import annotations

import numpy as np


def cut_sides(
    points: np.ndarray,
    group: np.ndarray,
    shape: np.ndarray,
    sides: np.ndarray,
    face: np.ndarray,
    tolerances: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the sides of all triangles, those with a vertex in their middle in pieces, and the triangles of each.

    Args:
        points: (N, 3) vertex positions.
        group: (N,) number of every vertex's position.
        shape: (N,) shape of every vertex.
        sides: (S, 2) vertices where sides start and end.
        face: (S,) their triangles.
        tolerances: (S,) largest distance of a vertex from a side that it lies on, world units.
    """
    from scipy.spatial import cKDTree

    key = np.sort(group[sides], axis=1).astype(np.int64)
    _, inverse, count = np.unique(key[:, 0] * len(points) + key[:, 1], return_inverse=True, return_counts=True)
    open_sides = np.flatnonzero(count[inverse.reshape(-1)] == 1)
    if not len(open_sides):
        return sides, face
    vertices = np.unique(sides[open_sides])
    start, end = (points[sides[open_sides, i]] for i in (0, 1))
    length = np.linalg.norm(end - start, axis=1)
    tolerance = tolerances[open_sides]
    # The ball around a side's middle that just excludes its own ends.
    radius = np.maximum(0.5 * length - tolerance, 0.0)
    tree = cKDTree(points[vertices])
    near = tree.query_ball_point(0.5 * (start + end), radius, return_length=True)
    some = np.flatnonzero(near > 0)
    if not len(some):
        return sides, face
    found = tree.query_ball_point(0.5 * (start + end)[some], radius[some])
    row = np.repeat(some, [len(f) for f in found])
    vertex = vertices[np.concatenate([np.asarray(f, np.int64) for f in found])]
    along = (end - start)[row] / length[row, None]
    offset = points[vertex] - start[row]
    at = (offset * along).sum(axis=1)
    on = np.linalg.norm(offset - at[:, None] * along, axis=1) <= tolerance[row]
    on &= (
        (at > tolerance[row])
        & (at < length[row] - tolerance[row])
        & (shape[vertex] == shape[sides[open_sides[row], 0]])
    )
    row, vertex, at = row[on], vertex[on], at[on]
    order = np.lexsort((vertex, at, row))
    row, vertex = row[order], vertex[order]
    first = np.ones(len(row), bool)  # of several vertices at one position
    first[1:] = (row[1:] != row[:-1]) | (group[vertex[1:]] != group[vertex[:-1]])
    row, vertex = row[first], vertex[first]
    if not len(row):
        return sides, face
    # Every cut side becomes a chain: its start, the vertices on it, its end.
    cut, pieces = np.unique(row, return_counts=True)
    before = np.insert(vertex, np.append(0, np.cumsum(pieces)[:-1]), sides[open_sides[cut], 0])
    after = np.insert(vertex, np.cumsum(pieces), sides[open_sides[cut], 1])
    keep = np.ones(len(sides), bool)
    keep[open_sides[cut]] = False
    chains = np.stack([before, after], axis=1)
    return np.concatenate([sides[keep], chains]), np.concatenate(
        [face[keep], np.repeat(face[open_sides[cut]], pieces + 1)]
    )

"""Vertices at the same position count as one: found, and updated after they have moved."""

from __future__ import annotations

import numpy as np

#: Direction along which vertices are put in order: no two axes, planes or diagonals of models are perpendicular to it.
DIRECTION = np.array([0.5403023058681398, 0.7071067811865476, 0.4559422718932519])
#: Candidate pairs a vertex up to which a mesh that has moved is looked through; beyond, it is welded anew.
PAIRS_A_VERTEX = 16


def components(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return for each of ``count`` things the number of its group: the pairs (a, b), numbers of things, join groups."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    return connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count)), directed=False)[1]


def weld(points: np.ndarray, tolerance: float) -> np.ndarray:
    """Return for every point the number of the group of points that share its position.

    Args:
        points: (N, 3).
        tolerance: world units; groups are closed under it.
    """
    from scipy.spatial import cKDTree

    # Exact copies first, which keeps the neighbour search small.
    unique, group = np.unique(points, axis=0, return_inverse=True)
    group = group.reshape(-1)
    pairs = cKDTree(unique).query_pairs(tolerance, output_type="ndarray")
    if not len(pairs):
        return group
    return components(len(unique), *pairs.T)[group]


def weld_shapes(points: np.ndarray, shape: np.ndarray, tolerances: np.ndarray) -> np.ndarray:
    """Weld the vertices of every shape by a tolerance of its own, and those of different shapes by the least of them.

    Args:
        points: (N, 3).
        shape: (N,) shape of every point.
        tolerances: (S,) world units.

    Returns:
        (N,) number of every point's group.
    """
    groups = np.empty(len(points), np.int64)
    used = 0
    for i in np.unique(shape):
        own = np.flatnonzero(shape == i)
        groups[own] = used + weld(points[own], float(tolerances[i]))
        used = int(groups[own].max()) + 1
    across = weld(points, float(tolerances[np.unique(shape)].min(initial=np.inf)))
    # A group of either kind joins its points.
    n = len(points)
    row = np.concatenate([np.arange(n), np.arange(n)])
    column = np.concatenate([n + groups, n + used + across])
    size = n + used + (int(across.max()) + 1 if n else 0)
    return components(size, row, column)[:n]


def still_welded(points: np.ndarray, group: np.ndarray, tolerance: float) -> bool:
    """Return whether welding points anew would certainly give the same groups.

    If every point lies within the tolerance of the first one of its group, and the first ones of different groups lie
    more than three tolerances apart, then points of different groups are more than one tolerance apart: no group splits
    and no two join. False may also mean that this is not certain.

    Args:
        points: (N, 3) where the points are now.
        group: (N,) as of ``weld``.
        tolerance: world units.
    """
    if not len(points):
        return True
    _numbers, first = np.unique(group, return_index=True)
    away = points - points[first][group]
    if not (np.abs(away).max() <= tolerance and ((away * away).sum(axis=1) <= tolerance * tolerance).all()):
        return False
    # Points that are as near as that are so along any direction: neighbours in its order.
    apart = 3.0 * tolerance
    along = points[first] @ DIRECTION
    order = np.argsort(along)
    along, x = along[order], points[first][order]
    left, step = PAIRS_A_VERTEX * len(points), 1
    while True:
        near = np.flatnonzero(along[step:] - along[:-step] <= apart)
        if not len(near):
            return True
        between = x[near + step] - x[near]
        left -= len(near)
        if left < 0 or not ((between * between).sum(axis=1) > apart * apart).all():
            return False
        step += 1

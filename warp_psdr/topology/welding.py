"""Vertices at the same position count as one: found, and updated after they have moved."""

from __future__ import annotations

import numpy as np

#: Direction along which vertices are put in order: no two axes, planes or diagonals of models are perpendicular to it.
DIRECTION = np.array([0.5403023058681398, 0.7071067811865476, 0.4559422718932519])
#: Candidate pairs a vertex up to which a mesh that has moved is looked through; beyond, it is welded anew.
PAIRS_A_VERTEX = 16
#: Pairs a point that are near each other along a line up to which all are looked through; beyond, a tree is faster.
PAIRS_A_POINT = 4


def components(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return for each of ``count`` things the number of its group: the pairs (a, b), numbers of things, join groups."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    return connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count)), directed=False)[1]


def stable_order(keys: np.ndarray, count: int) -> np.ndarray:
    """Return ``numpy.argsort(keys, kind="stable")`` of integers in [0, count), which are counted rather than sorted."""
    from scipy.sparse import coo_matrix

    if not len(keys):
        return np.zeros(0, np.int32)
    place = np.arange(len(keys), dtype=np.int32)
    entries = (np.ones(len(keys), np.int8), (keys.astype(np.int32), place))
    return coo_matrix(entries, shape=(count, len(keys))).tocsr().indices


def weld(points: np.ndarray, tolerance: float, order: np.ndarray | None = None) -> np.ndarray:
    """Return for every point the number of the group of points that share its position.

    Args:
        points: (N, 3).
        tolerance: world units; groups are closed under it.
        order: (N,) numbers of the points in the order of their coordinates, as they may lie; None: it is found.
    """
    # Exact copies first, which keeps the neighbour search small.
    if order is None or not _in_order(points.take(order, axis=0)):
        order = np.lexsort(points.T[::-1])
    x, y, z = (np.ascontiguousarray(column) for column in points.take(order, axis=0).T)
    new = np.ones(len(points), bool)
    new[1:] = (x[1:] != x[:-1]) | (y[1:] != y[:-1]) | (z[1:] != z[:-1])
    group = np.empty(len(points), np.int64)
    group[order] = np.cumsum(new) - 1
    unique = np.stack([x[new], y[new], z[new]], axis=1)
    a, b = _near_pairs(unique, tolerance)
    return components(len(unique), a, b)[group] if len(a) else group


def _in_order(points: np.ndarray) -> bool:
    """Return whether points come in the order of their coordinates."""
    (a, b, c), (d, e, f) = points[:-1].T, points[1:].T
    return bool(((a < d) | ((a == d) & ((b < e) | ((b == e) & (c <= f))))).all())


def _near_pairs(points: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs (a, b) of points that are no farther apart than a tolerance."""
    from scipy.spatial import cKDTree

    order, along = _in_line(points)
    # How many points follow each one that are as near as that along the line.
    follow = np.searchsorted(along, along + tolerance, side="right") - np.arange(1, len(points) + 1)
    if follow.sum() > PAIRS_A_POINT * len(points):
        found = cKDTree(points).query_pairs(tolerance, output_type="ndarray")
        return found[:, 0], found[:, 1]
    row = np.repeat(np.arange(len(points)), follow)
    # The first that follows each point, the second one, and so on.
    step = np.arange(1, len(row) + 1) - np.repeat(np.cumsum(follow) - follow, follow)
    a, b = order[row], order[row + step]
    between = points.take(b, axis=0) - points.take(a, axis=0)
    near = (between * between).sum(axis=1) <= tolerance * tolerance
    return a[near], b[near]


def _in_line(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the order of points along ``DIRECTION``, and in that order how far along they lie."""
    along = points @ DIRECTION
    order = np.argsort(along)
    return order, along[order]


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
    first = np.empty(int(group.max()) + 1, np.int64)
    first[group[::-1]] = np.arange(len(points) - 1, -1, -1)
    others = np.flatnonzero(first.take(group) != np.arange(len(points)))
    away = points.take(others, axis=0) - points.take(first.take(group.take(others)), axis=0)
    if not ((away * away).sum(axis=1) <= tolerance * tolerance).all():
        return False
    # Points that are as near as that are so along any direction: neighbours in its order.
    apart = 3.0 * tolerance
    order, along = _in_line(points.take(first, axis=0))
    if not np.isfinite(along).all():
        return False
    x = points.take(first.take(order), axis=0)
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

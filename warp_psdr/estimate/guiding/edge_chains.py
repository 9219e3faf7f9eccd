"""The order of edges along the first coordinate of the cube: neighbours in the order are neighbours in space.

Edges are joined to chains greedily [YLB*22, section 4.1]. Two edges that meet at a vertex continue each other if each
is the straightest continuation of the other and they meet at ``LOCAL`` degrees at least. A chain ends after ``MOST``
edges, and from ``FREE`` edges on where it has turned by more than 180 - ``GLOBAL`` degrees. The chains are sorted along
a Morton curve.
"""

from __future__ import annotations

import numpy as np

#: Angles in degrees and lengths in edges of [YLB*22].
LOCAL, GLOBAL, FREE, MOST = 170.0, 175.0, 5, 20
#: Edges around one vertex that are compared with each other; the fans at the poles of a sphere are no continuations.
FAN = 16


def chain_order(points: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the order of edges, and which of them run against their chain.

    Args:
        points: (N, 3) vertices.
        ends: (E, 2) vertex numbers.

    Returns:
        Edge numbers (E,), and a mask (E,) in the *new* order: the edge's second end comes first.
    """
    points = np.asarray(points, np.float64)
    count = len(ends)
    along = points[ends[:, 1]] - points[ends[:, 0]]
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None]
    partner = _partners(ends, along)
    chains = _walk(partner.tolist(), along.tolist(), count)
    flat = np.array([half for chain in chains for half in chain], np.int64)
    length = np.array([len(chain) for chain in chains])
    start = np.append(0, np.cumsum(length))[:-1]
    middle = points[ends[flat[start + length // 2] // 2]].mean(axis=1)
    rank = np.argsort(morton(middle), kind="stable")
    offset = np.append(0, np.cumsum(length[rank]))[:-1]
    take = np.repeat(start[rank] - offset, length[rank]) + np.arange(count)
    return flat[take] // 2, flat[take] % 2 == 1


def morton(x: np.ndarray) -> np.ndarray:
    """Return Morton codes (uint64) of points (N, 3), 20 bits an axis of their bounding cube."""
    low = x.min(axis=0)
    extent = max(float((x.max(axis=0) - low).max()), 1e-300)
    cells = np.minimum((x - low) * ((1 << 20) / extent), (1 << 20) - 1).astype(np.uint64)
    code = np.zeros(len(x), np.uint64)
    for bit in range(20):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code


def _partners(ends: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return for every half-edge (2 e: leaving its first end, 2 e + 1: its second) what continues it backwards; -1."""
    vertex = ends.reshape(-1)
    away = np.stack([along, -along], axis=1).reshape(-1, 3)
    order = np.argsort(vertex, kind="stable")
    v, d = vertex[order], away[order]
    best = np.full(len(v), np.cos(np.radians(LOCAL)))
    found = np.full(len(v), -1, np.int64)
    for step in range(1, FAN):
        same = np.flatnonzero(v[step:] == v[:-step])
        if not len(same):
            break
        cosine = (d[same] * d[same + step]).sum(axis=1)
        for a, b in ((same, same + step), (same + step, same)):
            better = cosine < best[a]
            best[a[better]], found[a[better]] = cosine[better], b[better]
    mutual = (found >= 0) & (found[np.maximum(found, 0)] == np.arange(len(found)))
    partner = np.full(len(v), -1, np.int64)
    partner[order[mutual]] = order[found[mutual]]
    return partner


def _walk(partner: list[int], along: list[list[float]], count: int) -> list[list[int]]:
    """Return chains of half-edges, each entered where it begins."""
    least = np.cos(np.radians(180.0 - GLOBAL))
    seen = bytearray(count)
    # Open ends first, so that every path is walked from one of its ends; then what closes on itself.
    starts = [h for h in range(2 * count) if partner[h] < 0] + list(range(0, 2 * count, 2))
    chains = []
    for half in starts:
        chain: list[int] = []
        at = half
        x = y = z = 0.0
        while at >= 0 and not seen[at >> 1]:
            a, b, c = along[at >> 1]
            if at & 1:
                a, b, c = -a, -b, -c
            if len(chain) >= MOST or (len(chain) > FREE and a * x + b * y + c * z < least):
                chains.append(chain)
                chain = []
            if not chain:
                x, y, z = a, b, c
            seen[at >> 1] = 1
            chain.append(at)
            at = partner[at ^ 1]
        if chain:
            chains.append(chain)
    return chains

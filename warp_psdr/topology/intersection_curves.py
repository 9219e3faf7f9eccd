"""Curves along which surfaces run through each other: segments between pairs of triangles.

A segment is the common part of two triangles A and B: on the line of their planes each covers an interval, and the
segment is where the intervals overlap. Surfaces that merely touch are in contact and handled with the edges. A corner
therefore counts as below a plane only if it is so by more than the rounding of the vertices. Two shapes that touch
(``topology/contacts.py``), or a mesh that touches itself, are in contact everywhere if they nowhere reach deeper into
each other than the boundary term's rays start off an edge.

An edge of A may lie in the plane of B, as the equator of a ball that is half sunk into a floor. Then the triangle below
that plane stands for the crossing, if the one on the other side of the edge lies above. (If A turns there, the curve
has a kink in its motion: its derivative is that towards this triangle.)
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import columns, workers
from warp_psdr.device import launch_shards
from warp_psdr.kernels.boundary.pairs import make_pair_kernels
from warp_psdr.kernels.step import TOUCH
from warp_psdr.topology.contacts import contacts
from warp_psdr.topology.edges import WELD, Adjacency, scene_adjacency, while_welded

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Height above a plane, as a fraction of the scene's extent, that still lies in it: rounding of float32 vertices.
IN_PLANE = 2.0 * WELD
#: Room for candidates at first, a shard of few triangles; one of many has room for as many as it has triangles. Beyond
#: it all of them are looked for again.
ROOM = 8192


def scene_curves(scene: Scene) -> Adjacency:
    """Return the curves of intersection of a scene as edges of two faces; kept until a vertex moves.

    ``ends`` and ``twins`` are -1: a curve has no vertices.
    """
    edges = scene_adjacency(scene)
    kept = getattr(scene, "_curves", None)
    if kept is not None and kept[0] is edges:
        return kept[1]
    points = scene.points
    pairs = _candidates(scene, edges)
    far = scene.steps.far[scene.builder.face_shape[pairs]]
    tolerance = np.maximum(IN_PLANE * far.min(axis=1, initial=np.inf), TOUCH * far.max(axis=1, initial=0.0))
    found = _segments(points.astype(np.float64), scene.builder.indices, edges, pairs, tolerance)
    found = _deep(scene, *found)
    scene._curves = (edges, found)  # type: ignore[attr-defined]
    return found


def moving_curves(scene: Scene, curves: Adjacency, shapes: set[int]) -> np.ndarray:
    """Return a mask of the curves on a shape that moves."""
    moves = np.isin(scene.builder.face_shape, sorted(shapes))
    return moves[curves.faces.reshape(-1, 2)].any(axis=1)


def _candidates(scene: Scene, edges: Adjacency) -> np.ndarray:
    """Return pairs of triangles (P, 2) that may intersect, in ascending order."""
    count = scene.face_count
    if not count:
        return np.zeros((0, 2), np.int64)
    accelerator, device = scene.accelerator, scene.device
    kernel, _touching = make_pair_kernels(accelerator.width)
    inputs = [
        accelerator.data,
        scene.vertices,
        scene.indices.reshape((count, 3)).view(wp.vec3i),
        _corner_groups(scene, edges),
        IN_PLANE * float(scene.steps.far[np.unique(scene.builder.face_shape)].min()),
    ]
    items = accelerator.packets or count
    dealt = workers.even_chunks(items) if device.is_cpu else [[]]
    room = max(ROOM, count // len(dealt))
    while True:
        found = wp.zeros(len(dealt), dtype=wp.int32, device=device)
        pairs = wp.empty((len(dealt), room), dtype=wp.vec2i, device=device)
        launch_shards(
            kernel,
            items,
            partial(_arguments, inputs, [found, pairs]),
            shards=len(dealt),
            device=device,
            chunks=dealt,
        )
        n = found.numpy()
        if n.max() <= room:
            break
        room = int(n.max())
    rows = np.concatenate([row[:k] for row, k in zip(pairs.numpy(), n, strict=True)]).astype(np.int64)
    return rows[np.lexsort((rows[:, 1], rows[:, 0]))]


def _corner_groups(scene: Scene, edges: Adjacency) -> wp.array:
    """Return the numbers of the positions of all triangles' corners."""

    def find() -> wp.array:
        numbers = edges.group.astype(np.int32).take(scene.builder.indices, axis=0)
        return wp.array(numbers, dtype=wp.vec3i, device=scene.device)

    return while_welded(scene, edges, "corner groups", find)


def _arguments(inputs: list, outputs: list, first: int, _count: int, shard: int) -> tuple[list, list]:
    return [*inputs, first, shard], outputs


def _heights(points: np.ndarray, triangles: np.ndarray, plane: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Heights (P, 3) of the corners of triangles ``of`` above the planes of triangles ``plane``."""

    def heights(rows: slice) -> tuple[np.ndarray]:
        a, b, c = (columns.of(points.take(corner, axis=0)) for corner in triangles.take(plane[rows], axis=0).T)
        n = columns.cross(b - a, c - a)
        n /= np.maximum(columns.length(n), 1e-300)
        x = (columns.of(points.take(corner, axis=0)) for corner in triangles.take(of[rows], axis=0).T)
        return (np.stack([columns.dot(corner - a, n) for corner in x]),)

    return np.ascontiguousarray(columns.in_chunks(heights, len(plane))[0].T)


def _interval(points, triangles, face, heights, origin, along) -> tuple[np.ndarray, np.ndarray]:
    """Interval of the line origin + s along that triangles cover; ``heights`` of their corners, 0: in the plane."""
    below = heights < 0.0
    lone = np.where(below.sum(axis=1) == 1, below.argmax(axis=1), (~below).argmax(axis=1))
    rows = np.arange(len(face))
    p = points[triangles[face]]
    ends = []
    for step in (1, 2):
        other = (lone + step) % 3
        h, g = heights[rows, lone], heights[rows, other]
        at = (h / (h - g))[:, None]
        x = (1.0 - at) * p[rows, lone] + at * p[rows, other]
        ends.append(((x - origin) * along).sum(axis=1))
    return np.minimum(*ends), np.maximum(*ends)


def _segments(points: np.ndarray, triangles: np.ndarray, edges: Adjacency, pairs: np.ndarray, tolerance: np.ndarray):
    """Return (segments (N, 2, 3), pairs of faces (N, 2), depths (N,)) of what truly intersects."""
    a, b = pairs[:, 0], pairs[:, 1]
    use = np.ones(len(pairs), bool)
    heights, depth = [], np.full(len(pairs), np.inf)
    for plane, of in ((b, a), (a, b)):
        h = _heights(points, triangles, plane, of)
        h[np.abs(h) <= tolerance[:, None]] = 0.0
        above = h.max(axis=1)
        grazing = (above == 0.0) & ((h == 0.0).sum(axis=1) == 2)
        above[grazing] = _beyond(points, triangles, edges, plane[grazing], of[grazing], h[grazing])
        use &= above > tolerance
        depth = np.minimum(depth, np.minimum(above, -h.min(axis=1)))
        heights.append(h)
    a, b, depth = a[use], b[use], depth[use]
    h_a, h_b = heights[0][use], heights[1][use]
    na = np.cross(points[triangles[a, 1]] - points[triangles[a, 0]], points[triangles[a, 2]] - points[triangles[a, 0]])
    nb = np.cross(points[triangles[b, 1]] - points[triangles[b, 0]], points[triangles[b, 2]] - points[triangles[b, 0]])
    along = np.cross(na, nb)
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None]
    # Any point on the line of both planes, near the triangles: where an edge of A meets the plane of B.
    below = h_a < 0.0
    rows = np.arange(len(a))
    i, j = below.argmax(axis=1), (~below).argmax(axis=1)
    at = (h_a[rows, i] / (h_a[rows, i] - h_a[rows, j]))[:, None]
    origin = (1.0 - at) * points[triangles[a, i]] + at * points[triangles[a, j]]
    low_a, high_a = _interval(points, triangles, a, h_a, origin, along)
    low_b, high_b = _interval(points, triangles, b, h_b, origin, along)
    low, high = np.maximum(low_a, low_b), np.minimum(high_a, high_b)
    hit = high - low > tolerance[use]
    ends = origin[:, None] + np.stack([low, high], axis=1)[..., None] * along[:, None]
    return ends[hit], np.stack([a, b], axis=1)[hit], depth[hit]


def _beyond(points, triangles, edges: Adjacency, plane, of, heights) -> np.ndarray:
    """Height of the triangle behind the edge that lies in the plane; 0 where there is not exactly one."""
    result = np.zeros(len(of))
    if not len(of):
        return result
    size = int(edges.group.max()) + 1
    # Edges come in the order of the groups of their ends, the lower one first.
    key = edges.group.take(edges.ends[:, 0]) * size + edges.group.take(edges.ends[:, 1])
    corner = np.argmax(heights != 0.0, axis=1)
    rows = np.arange(len(of))
    ends = np.stack([triangles[of, (corner + 1) % 3], triangles[of, (corner + 2) % 3]], axis=1)
    wanted = np.sort(edges.group[ends], axis=1) @ [size, 1]
    edge = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
    two = (key[edge] == wanted) & (edges.count[edge] == 2)
    first = edges.first[:-1][edge]
    other = np.where(
        edges.faces[first] == of, edges.faces[np.minimum(first + 1, len(edges.faces) - 1)], edges.faces[first]
    )
    h = _heights(points, triangles, plane, other)
    result[two] = h[rows, np.abs(h).argmax(axis=1)][two]
    return result


def _deep(scene: Scene, ends: np.ndarray, pairs: np.ndarray, depth: np.ndarray) -> Adjacency:
    """Leave out pairs of shapes that are in contact; return the rest as edges."""
    shapes = np.sort(scene.builder.face_shape[pairs], axis=1) if len(pairs) else np.zeros((0, 2), int)
    _pairs, number = np.unique(shapes, axis=0, return_inverse=True)
    number = number.reshape(-1)
    deepest = np.zeros(len(_pairs))
    np.maximum.at(deepest, number, depth)
    touch = scene.steps.behind[_pairs].max(axis=1, initial=0.0)
    shallow = deepest <= touch
    if shallow.any():
        # Large ones at a small angle need not be: their curve is as long as others.
        in_contact = {tuple(pair) for pair in np.sort(contacts(scene).shapes, axis=1).tolist()}
        shallow &= np.array([a == b or (a, b) in in_contact for a, b in _pairs.tolist()])
    keep = ~shallow[number]
    ends, pairs = ends[keep], pairs[keep]
    n = len(pairs)
    none = np.full((n, 2), -1, np.int32)
    return Adjacency(
        ends=none,
        twins=none,
        faces=pairs.reshape(-1).astype(np.int32),
        first=2 * np.arange(n + 1, dtype=np.int32),
        wedge=np.full(n, np.pi),
        length=np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) if n else np.zeros(0),
        points=ends.reshape(n, 2, 3),
        group=np.zeros(0, np.int64),
    )

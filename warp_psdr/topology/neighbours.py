"""The triangles across the sides of a triangle, for walks over a mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels.boundary.guiding.projective import Neighbours
from warp_psdr.topology.edges import scene_adjacency, sides_of

if TYPE_CHECKING:
    from warp_psdr.kernels.boundary.local_form import Edges
    from warp_psdr.scene.scene import Scene


def neighbours(scene: Scene, edges: Edges) -> Neighbours:
    """Return the neighbours of every triangle, on position-welded vertices, flat edges included.

    Args:
        scene: the scene.
        edges: the candidate edges that the walk may end at.
    """
    faces, numbers = neighbour_tables(scene, edges.ends.numpy())
    record = Neighbours()
    record.faces = wp.array(faces, dtype=wp.int32, device=scene.device)
    record.edges = wp.array(numbers, dtype=wp.int32, device=scene.device)
    return record


def neighbour_tables(scene: Scene, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (neighbouring triangles, numbers of the candidate edges), each (faces, 3), -1 where there is none.

    Args:
        scene: the scene.
        ends: (n, 2) vertices of the candidate edges, as in ``Edges.ends``.
    """
    adjacency = scene_adjacency(scene)
    kept = _rows(adjacency.ends, ends, scene.vertex_count)
    count = np.repeat(adjacency.count, adjacency.count)
    edge = np.repeat(np.arange(len(adjacency.length)), adjacency.count)
    slot = np.arange(len(edge))
    other = np.where(slot == adjacency.first[edge], slot + 1, adjacency.first[edge])
    opposite = np.where(count == 2, adjacency.faces[np.where(count == 2, other, slot)], -1)
    side = sides_of(scene, adjacency)
    faces = np.full((scene.face_count, 3), -1, np.int32)
    numbers = np.full((scene.face_count, 3), -1, np.int32)
    faces[adjacency.faces, side] = opposite
    numbers[adjacency.faces, side] = kept[edge]
    return faces, numbers


def _rows(all_ends: np.ndarray, ends: np.ndarray, vertices: int) -> np.ndarray:
    """Return for every edge of the scene its row in ``ends``, -1 if it is not there."""

    def key(pairs: np.ndarray) -> np.ndarray:
        return pairs.min(axis=1).astype(np.int64) * vertices + pairs.max(axis=1)

    order = np.argsort(key(ends))
    sorted_keys = key(ends)[order]
    at = np.minimum(np.searchsorted(sorted_keys, key(all_ends)), len(order) - 1)
    return np.where(sorted_keys[at] == key(all_ends), order[at], -1).astype(np.int32)

"""Which edges can be a silhouette between two path vertices: the candidate set of the secondary boundary."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.topology.contacts import along_sides
from warp_psdr.topology.edges import moving_edges, scene_adjacency, sides_of, upload
from warp_psdr.topology.outermost import outermost_edges
from warp_psdr.topology.unchanged import kept

if TYPE_CHECKING:
    from warp_psdr.kernels.boundary.local_form import Edges
    from warp_psdr.scene.scene import Scene
    from warp_psdr.topology.edges import Adjacency

#: Share of the samples that goes to edges of moving shapes alone; the others are for edges between moving end points.
MOVING_SHARE = 0.5


def secondary_edges(scene: Scene, shapes: set[int]) -> Edges | None:
    """Return the edges that can be a silhouette for some path vertex, drawn by length times wedge; None: no edges.

    Args:
        scene: the scene.
        shapes: the shapes that move.
    """

    def find() -> Edges | None:
        keep, p = secondary_candidates(scene, shapes)
        if not len(keep):
            return None
        found = upload(scene, scene_adjacency(scene), keep, p, np.zeros(len(keep)), np.ones(len(keep)))
        set_beside(scene, found, scene_adjacency(scene), keep)
        return found

    return kept(scene, ("secondary_edges", frozenset(shapes)), find)


def secondary_candidates(scene: Scene, shapes: set[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the edges that can be a silhouette, and their probabilities.

    Beside shapes without triangles those that no segment passes are left out.
    """
    edges = scene_adjacency(scene)
    weight = edges.length * edges.wedge
    if scene.builder.primitives:
        weight = np.where(outermost_edges(scene), 0.0, weight)
    keep = np.flatnonzero(weight > 0.0)
    if not len(keep):
        return keep, np.zeros(0)
    p = weight[keep] / weight[keep].sum()
    of_moving = np.where(moving_edges(scene, edges, shapes)[keep], p, 0.0)
    if of_moving.sum() > 0.0:
        p = (1.0 - MOVING_SHARE) * p + MOVING_SHARE * of_moving / of_moving.sum()
    return keep, p


def set_beside(scene: Scene, found: Edges, edges: Adjacency, numbers: np.ndarray) -> None:
    """Tell uploaded edges, ``numbers`` of a list, which of them run along each other on different shapes."""
    pairs = _beside(scene, edges)
    place = np.full(len(edges.length), -1, np.int32)
    place[numbers] = np.arange(len(numbers), dtype=np.int32)
    pairs = place[pairs]
    pairs = pairs[(pairs >= 0).all(axis=1)]
    beside, first = np.zeros(1, np.int32), np.zeros(1, np.int32)
    if len(pairs):
        pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
        beside = np.ascontiguousarray(pairs[:, 1])
        first = np.searchsorted(pairs[:, 0], np.arange(len(numbers) + 1)).astype(np.int32)
    found.beside = wp.array(beside, dtype=wp.int32, device=scene.device)
    found.beside_first = wp.array(first, dtype=wp.int32, device=scene.device)


def _beside(scene: Scene, edges: Adjacency) -> np.ndarray:
    """Return the pairs of edges of different shapes that touch along more than a point, both ways around, (P, 2)."""
    touching = along_sides(scene)
    if not len(touching):
        return np.zeros((0, 2), np.int64)
    # Of a triangle's side there are several edges where it is cut (``t_junctions``).
    key = 3 * edges.faces.astype(np.int64) + sides_of(scene, edges)
    order = np.argsort(key, kind="stable")
    number = np.repeat(np.arange(len(edges.length)), edges.count)[order]
    low, high = (np.searchsorted(key[order], touching, side) for side in ("left", "right"))
    pairs = [
        (a, b)
        for (la, lb), (ha, hb) in zip(low.tolist(), high.tolist(), strict=True)
        for a in number[la:ha].tolist()
        for b in number[lb:hb].tolist()
        if a != b
    ]
    found = np.array(pairs, np.int64).reshape(-1, 2)
    return np.unique(np.concatenate([found, found[:, ::-1]]), axis=0)

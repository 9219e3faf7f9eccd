"""Edges in the order of guided sampling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.estimate.guiding.edge_chains import chain_order
from warp_psdr.topology.edges import scene_adjacency, upload
from warp_psdr.topology.secondary_edges import set_beside

if TYPE_CHECKING:
    from warp_psdr.kernels.boundary.local_form import Edges
    from warp_psdr.scene.scene import Scene


def ordered_edges(
    scene: Scene, keep: np.ndarray, p: np.ndarray, facing: Callable[[Edges], np.ndarray]
) -> tuple[Edges, np.ndarray, np.ndarray, np.ndarray]:
    """Return edges in the order of guided sampling, how far they face the lights, their numbers, and which are turned.

    The order is that of chains (``edge_chains.py``). Edges that are a silhouette for no light stand apart from the
    others, which would be hard to find next to them. Edges that run against their chain are turned around.

    Args:
        scene: the scene.
        keep: numbers of edges.
        p: their probabilities.
        facing: edges -> (E,) measure that is 0 where an edge is a silhouette for no light.
    """
    edges = scene_adjacency(scene)
    points = scene.points
    order, turned = chain_order(points, edges.ends[keep])
    ends, twins, corners = edges.ends.copy(), edges.twins.copy(), edges.points.copy()
    for array in (ends, twins, corners):
        array[keep[order[turned]]] = array[keep[order[turned]], ::-1]
    edges = replace(edges, ends=ends, twins=twins, points=corners)
    low, high = np.zeros(len(keep)), np.ones(len(keep))
    share = facing(upload(scene, edges, keep[order], p[order], low, high))
    apart = np.argsort(share > 0.0, kind="stable")
    order, turned = order[apart], turned[apart]
    found = upload(scene, edges, keep[order], p[order], low, high)
    set_beside(scene, found, scene_adjacency(scene), keep[order])
    return found, share[apart], keep[order], turned


def follow(scene: Scene, found: Edges, numbers: np.ndarray, turned: np.ndarray) -> None:
    """Let ordered edges start and end where they do now, beside which others run now."""
    edges = scene_adjacency(scene)
    points = edges.points[numbers]
    points[turned] = points[turned, ::-1]
    found.points = wp.array(np.ascontiguousarray(points, dtype=np.float32), dtype=wp.vec3, device=scene.device)
    set_beside(scene, found, edges, numbers)

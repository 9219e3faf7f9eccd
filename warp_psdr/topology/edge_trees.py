"""Hierarchies over the edges of a scene, for choosing silhouettes as seen from a point [LADL18, section 5]."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels.boundary.edge_sampling.edge_tree import EdgeNode, EdgeTrees

if TYPE_CHECKING:
    from warp_psdr.kernels.boundary.local_form import Edges
    from warp_psdr.scene.scene import Scene

#: Extent of a box of unit normals that counts as much as the whole scene's when a node is split.
NORMAL_EXTENT = 2.0
#: Least length times angle of an edge, as a share of the mean: float32 weights of sums stay positive.
MIN_WEIGHT = 1.0e-6


def edge_trees(scene: Scene, edges: Edges) -> EdgeTrees:
    """Return the trees over a set of edges.

    Args:
        scene: the scene.
        edges: as of ``secondary_edges.secondary_edges``.
    """
    points = scene.points.copy()  # on the CPU it is a view of what moves
    cdf, ends, faces, first = (a.numpy() for a in (edges.cdf, edges.ends, edges.faces, edges.first))
    kept = getattr(scene, "_edge_trees", None)
    key = (points, cdf, ends)
    if kept is not None and all(np.array_equal(a, b) for a, b in zip(kept[0], key, strict=True)):
        return kept[1]
    nodes, boost = build(points.astype(np.float64), scene.builder.indices, cdf, ends, faces, first)
    record = EdgeTrees()
    record.nodes = wp.array(nodes, dtype=EdgeNode, device=scene.device)
    record.boost = wp.array(boost, dtype=wp.float32, device=scene.device)
    scene._edge_trees = (key, record)  # type: ignore[attr-defined]
    return record


def build(
    points: np.ndarray, triangles: np.ndarray, cdf: np.ndarray, ends: np.ndarray, faces: np.ndarray, first: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Build both trees under one root.

    Args:
        points: (N, 3) vertex positions.
        triangles: (M, 3) vertex numbers.
        cdf: (E + 1,) cumulative selection probabilities.
        ends: (E, 2) vertices of the edges.
        faces: triangles at all edges, flat.
        first: (E + 1,) where an edge's triangles start.

    Returns:
        Nodes, a structured array with the fields of ``EdgeNode``, and (E,) factors: the selection probability over
        length times (pi - dihedral angle), one on average.
    """
    p = points[ends]
    along = p[:, 1] - p[:, 0]
    length = np.linalg.norm(along, axis=1)
    tangent = along / np.maximum(length, 1e-300)[:, None]
    second = np.minimum(first[:-1] + 1, len(faces) - 1)
    normals = np.stack(
        [
            np.cross(tangent, _across(points, triangles, faces[first[:-1]], p, tangent)),
            -np.cross(tangent, _across(points, triangles, faces[second], p, tangent)),
        ],
        axis=1,
    )
    # Turned as the first face's own normal, so that neighbours agree.
    corners = points[triangles[faces[first[:-1]]]]
    own = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals[(normals[:, 0] * own).sum(axis=1) < 0.0] *= -1.0
    paired = np.diff(first) == 2
    angle = np.arctan2(
        np.linalg.norm(np.cross(normals[:, 0], normals[:, 1]), axis=1), (normals[:, 0] * normals[:, 1]).sum(axis=1)
    )
    weight = length * np.where(paired, angle, np.pi)
    weight = np.maximum(weight, MIN_WEIGHT * weight.mean())
    probability = np.diff(cdf.astype(np.float64))
    boost = probability / weight * weight.sum()
    if not (~paired).any() or not paired.any():
        return _tree(p, normals, probability, np.arange(len(p)), bool(paired.any()), 0), boost.astype(np.float32)
    flat, solid = np.flatnonzero(~paired), np.flatnonzero(paired)
    left = _tree(p, normals, probability, flat, False, 1)
    right = _tree(p, normals, probability, solid, True, 1 + len(left))
    root = np.zeros(1, EdgeNode.numpy_dtype())
    root["left"], root["right"] = 1, 1 + len(left)
    return np.concatenate([root, left, right]), boost.astype(np.float32)


def _across(points, triangles, face, ends, tangent) -> np.ndarray:
    """Unit direction from an edge into a face, perpendicular to the edge."""
    into = points[triangles[face]].mean(axis=1) - ends[:, 0]
    into -= (into * tangent).sum(axis=1)[:, None] * tangent
    return into / np.maximum(np.linalg.norm(into, axis=1), 1e-300)[:, None]


def _tree(
    ends: np.ndarray, normals: np.ndarray, weight: np.ndarray, items: np.ndarray, planes: bool, offset: int
) -> np.ndarray:
    """Build one binary tree level by level, all nodes of a level at once; every leaf is one edge.

    Args:
        ends: (E, 2, 3).
        normals: (E, 2, 3) of the two faces.
        weight: (E,).
        items: which edges.
        planes: bound the faces' planes and split by them too (6-D); otherwise any plane is possible (3-D).
        offset: number of the first node.
    """
    count = len(items)
    nodes = np.zeros(2 * count - 1, EdgeNode.numpy_dtype())
    middle = ends.mean(axis=1)
    box_low, box_high = ends.min(axis=1), ends.max(axis=1)
    n_low, n_high = normals.min(axis=1), normals.max(axis=1)
    heights = np.einsum("ifk,ik->if", normals, middle)
    features = middle / max(float(np.ptp(middle[items], axis=0).max()), 1e-300)
    if planes:
        features = np.concatenate([features, normals.mean(axis=1) / NORMAL_EXTENT], axis=1)
    order = items.copy()
    numbers, sizes, used = np.zeros(1, int), np.array([count]), 1
    while len(order):
        start = np.append(0, np.cumsum(sizes)[:-1])
        segment = np.repeat(np.arange(len(sizes)), sizes)
        low = np.minimum.reduceat(box_low[order], start)
        high = np.maximum.reduceat(box_high[order], start)
        center = (0.5 * (low + high)).astype(np.float32).astype(np.float64)
        nodes["center"][numbers] = center
        # Rounded outwards.
        half = (0.5 * (high - low) + 1e-6 * (np.abs(center) + high - low)).astype(np.float32)
        nodes["half"][numbers] = half
        nodes["weight"][numbers] = np.add.reduceat(weight[order], start)
        if planes:
            low = np.minimum.reduceat(n_low[order], start)
            high = np.maximum.reduceat(n_high[order], start)
            nodes["n_center"][numbers] = 0.5 * (low + high)
            # Rounded outwards, which is all that lets the test of planes err on the side of keeping a node.
            nodes["n_half"][numbers] = 0.5 * (high - low) + 1e-6
            d = heights[order] - np.einsum("ifk,ik->if", normals[order], center[segment])
            nodes["d_low"][numbers] = np.minimum.reduceat(np.minimum(d[:, 0], d[:, 1]), start)
            nodes["d_high"][numbers] = np.maximum.reduceat(np.maximum(d[:, 0], d[:, 1]), start)
        else:
            nodes["n_half"][numbers] = 1.0
        leaf = sizes == 1
        nodes["left"][numbers[leaf]] = -1 - order[start[leaf]]
        # Split the rest at the median along their longest side.
        split = np.flatnonzero(~leaf)
        keep = ~leaf[segment]
        order, segment = order[keep], (np.cumsum(~leaf) - 1)[segment[keep]]
        if not len(order):
            break
        f = features[order]
        begin = np.append(0, np.cumsum(sizes[split])[:-1])
        axis = np.argmax(np.maximum.reduceat(f, begin) - np.minimum.reduceat(f, begin), axis=1)
        order = order[np.lexsort((f[np.arange(len(f)), axis[segment]], segment))]
        children = used + np.arange(2 * len(split))
        used += len(children)
        nodes["left"][numbers[split]] = offset + children[0::2]
        nodes["right"][numbers[split]] = offset + children[1::2]
        lower = sizes[split] // 2
        sizes = np.stack([lower, sizes[split] - lower], axis=1).reshape(-1)
        numbers = children
    return nodes

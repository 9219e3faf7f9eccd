"""Edges that more than two triangles of several shapes share, as where a box stands on a floor that is cut along it.

Such an edge moves as a curve of intersection of two surfaces does (``kernels/boundary/local_form.py``): of one shape
and of another. The two triangles whose planes are steepest to each other stand for them, since the others of a shape
lie in the plane of the contact, or go on in the same plane.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene
    from warp_psdr.topology.edges import Adjacency

#: Sine of the angle between two triangles up to which a surface goes on from one to the other in its plane.
FLAT = 1e-4
#: Triangles at an edge among which the two are looked for.
MOST = 8


def put_first(
    order: np.ndarray, first: np.ndarray, face: np.ndarray, shape: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Put two triangles of different shapes first at every edge that more than two triangles of several shapes share.

    Args:
        order: (S,) numbers of sides, edge by edge.
        first: (E + 1,) where an edge's sides start.
        face: triangles of the sides, by number.
        shape: shapes of the triangles.
        normals: (3, triangles) of any length.

    Returns:
        ``order`` as it shall be, and a mask (E,) of the edges whose first two triangles are of different shapes.
    """
    count = np.diff(first)
    shared = np.zeros(len(count), bool)
    many = np.flatnonzero(count > 2)
    if not len(many):
        return order, shared
    slots = np.minimum(np.arange(MOST), count[many, None] - 1)
    sides = order[first[many, None] + slots]
    of = shape[face[sides]]
    several = (of != of[:, :1]).any(axis=1)
    many, slots, sides, of = many[several], slots[several], sides[several], of[several]
    if not len(many):
        return order, shared
    n = np.stack([component[face[sides]] for component in normals], axis=2).astype(np.float64)
    n /= np.maximum(np.linalg.norm(n, axis=2, keepdims=True), 1e-300)
    rows = np.arange(len(many))
    best, pair = np.full(len(many), -1.0), np.zeros((len(many), 2), np.int64)
    for i in range(MOST):
        for j in range(i + 1, MOST):
            steep = np.where(of[:, i] != of[:, j], np.linalg.norm(np.cross(n[:, i], n[:, j]), axis=1), -1.0)
            better = steep > best + 1e-6
            best[better], pair[better] = steep[better], (i, j)
    order = order.copy()
    for place in range(2):
        # The second of a pair stands behind the first, so that the first exchange does not move it.
        here, there = first[many] + place, first[many] + slots[rows, pair[:, place]]
        order[here], order[there] = order[there], order[here]
    shared[many] = True
    return order, shared


def goes_on(scene: Scene, edges: Adjacency, numbers: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether a triangle's own shape goes on in its plane beyond an edge.

    Args:
        scene: the scene.
        edges: its edges.
        numbers: (N,) or (N, k) numbers of edges; below 0: none.
        faces: triangles at them, of a shape that broadcasts.
    """
    found = np.zeros(numbers.shape, bool)
    rows = np.flatnonzero((numbers >= 0) & (edges.count[numbers] > 1))
    if not len(rows):
        return found
    e, face = numbers.reshape(-1)[rows], np.broadcast_to(faces, numbers.shape).reshape(-1)[rows]
    others = edges.faces[edges.first[e][:, None] + np.minimum(np.arange(MOST), edges.count[e][:, None] - 1)]
    shape = scene.builder.face_shape
    own = (shape[others] == shape[face][:, None]) & (others != face[:, None])
    corners = (scene.points[scene.builder.indices[f]].astype(np.float64) for f in (face[:, None], others))
    n, m = (np.cross(p[:, :, 1] - p[:, :, 0], p[:, :, 2] - p[:, :, 0]) for p in corners)
    sine = np.linalg.norm(np.cross(n, m), axis=2)
    flat = sine <= FLAT * np.linalg.norm(n, axis=2) * np.linalg.norm(m, axis=2)
    found.reshape(-1)[rows] = (own & flat).any(axis=1)
    return found

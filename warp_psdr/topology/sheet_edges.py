"""Edges at which what a thin sheet lets through may jump: creases, and seams of texture coordinates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.scene.shapes.shading import normals_at_vertices
from warp_psdr.topology.edges import scene_adjacency
from warp_psdr.topology.unchanged import kept

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Difference of two normals, by component, up to which they are one.
ONE_NORMAL = 1e-4


def creases_and_seams(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return which meshes have edges at which their normal jumps, and which have seams of texture coordinates, (S,)."""
    return kept(scene, "creases and seams", lambda: _creases_and_seams(scene))


def _creases_and_seams(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    edges, shapes = scene_adjacency(scene), scene.builder.shapes
    of = scene.builder.face_shape[edges.faces[edges.first[:-1]]]
    seams = (edges.count == 2) & (edges.ends != edges.twins).any(axis=1)
    normals = normals_at_vertices(scene)
    jumps = np.array([shape.smooth == 0 for shape in shapes])[of]
    jumps[seams] |= (np.abs(normals[edges.ends[seams]] - normals[edges.twins[seams]]) > ONE_NORMAL).any(axis=(1, 2))
    creases = (edges.count == 2) & (edges.wedge > 0.0) & jumps
    numbers = np.arange(len(shapes))
    return np.isin(numbers, of[creases]), np.isin(numbers, of[seams])

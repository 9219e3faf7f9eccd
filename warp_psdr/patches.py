"""Smooth patches of a scene's surfaces and how far each spreads: the lengths over which light between them varies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.edges import cross, joined_faces, scene_adjacency

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Angle (radians) between two triangles from which their edge ends a patch. Coarse spheres and cylinders have less.
CREASE = 0.8
#: Cosine between a patch's plane and its triangles down to which it is a sheet over that plane, and not wrapped around.
SHEET = 0.5


def patch_radii(scene: Scene) -> wp.array:
    """Return the radius of the patch of every triangle, (F,) float32 world units; kept until a vertex moves."""
    edges = scene_adjacency(scene)
    kept = getattr(scene, "_patch_radii", None)
    if kept is None or kept[0] is not edges:
        joins = (edges.count == 2) & (edges.wedge < CREASE)
        patch = joined_faces(scene.face_count, edges, joins)
        radii = spreads(scene.points, scene.builder.indices, patch)[patch]
        kept = (edges, wp.array(radii, dtype=wp.float32, device=scene.device))
        scene._patch_radii = kept  # type: ignore[attr-defined]
    return kept[1]


def spreads(points: np.ndarray, triangles: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """Return three standard deviations of the points of every patch, along the narrowest of its principal axes.

    A sheet has no thickness to go by and counts along the narrower of the other two. What is wrapped around has: what
    is thin, even with rounded edges, is as narrow as it is thin. So a sphere of radius r has sqrt(3) r, a square of
    side 2 a has sqrt(3) a, and the rim of a disk of height 2 h has sqrt(3) h.

    Args:
        points: (N, 3) vertex positions, world units.
        triangles: (F, 3) vertex numbers.
        patch: (F,) patch of every triangle, from 0.

    Returns:
        (P,) float64, world units; 0: a patch without area.
    """
    if not len(patch):
        return np.zeros(0)
    count = int(patch.max()) + 1
    p = points[triangles].astype(np.float64)
    normal = 0.5 * cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    area = np.sqrt((normal * normal).sum(axis=1))

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(patch, values, count)

    whole = np.maximum(total(area), 1e-300)
    mean = np.stack([total(area * p[:, :, i].mean(axis=1)) for i in range(3)], axis=1) / whole[:, None]
    p -= mean[patch][:, None]
    middle = p.sum(axis=1)
    moments = np.empty((count, 3, 3))
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        # Of a triangle with corners v, the integral of x_i x_j is its area / 12 (sum of v_i v_j + (sum v)_i (sum v)_j).
        of_triangle = area / 12.0 * ((p[:, :, i] * p[:, :, j]).sum(axis=1) + middle[:, i] * middle[:, j])
        moments[:, i, j] = moments[:, j, i] = total(of_triangle) / whole
    variances, axes = np.linalg.eigh(moments)  # ascending
    along = np.abs((normal * axes[patch, :, 0]).sum(axis=1))
    steep = total((along < SHEET * area).astype(np.float64)) > 0.0
    return 3.0 * np.sqrt(np.maximum(np.where(steep, variances[:, 0], variances[:, 1]), 0.0))

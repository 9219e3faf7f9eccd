"""Scenes without occlusion: shapes that see nothing but the sky, and rooms that are seen as a whole."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.topology.edges import area_normals, scene_adjacency

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Height over the largest coordinate up to which a vertex lies in the plane of a triangle: some roundings.
IN_PLANE = 2.0e-6
#: Triangles that are compared with all vertices at a time.
CHUNK = 64


def sees_others(scene: Scene, shape: int, both: bool) -> bool:
    """Return whether a ray that leaves a shape's front, or ``both`` sides, may meet a surface; kept until one moves."""
    points = scene.points
    kept: tuple[np.ndarray, dict[tuple[int, bool], bool]] | None = getattr(scene, "_outlooks", None)
    if kept is None or not np.array_equal(kept[0], points):
        kept = (points.copy(), {})
        scene._outlooks = kept  # type: ignore[attr-defined]
    if (shape, both) not in kept[1]:
        b = scene.builder
        triangles = b.indices[b.face_shape == shape]
        turned = -1.0 if scene.description.shapes[shape].flip_normals else 1.0
        kept[1][shape, both] = has_in_front(points.astype(np.float64), triangles, turned, both)
    return kept[1][shape, both]


def is_room_around(scene: Scene, origin: np.ndarray) -> bool:
    """Return whether the scene is one closed convex surface around a point, all of which is seen from within.

    Args:
        scene: a loaded scene.
        origin: (3,) the point, as ``scene.points`` are.
    """
    points, triangles = scene.points.astype(np.float64), scene.builder.indices
    if not len(triangles) or not (scene_adjacency(scene).count == 2).all():
        return False
    normal = area_normals(points, triangles)
    inwards = np.sign((normal * (origin - points[triangles[:, 0]])).sum(axis=1))
    if not inwards.all():
        return False
    # Turned outwards, no triangle has a vertex in front of it.
    return not has_in_front(points, triangles, -inwards[:, None], False)


def has_in_front(points: np.ndarray, triangles: np.ndarray, turned: float | np.ndarray, both: bool) -> bool:
    """Return whether any point lies in front of any triangle.

    Args:
        points: (N, 3) positions.
        triangles: (F, 3) their numbers.
        turned: 1, or -1 where normals are flipped; (F, 1) for each triangle.
        both: whether behind counts, too.
    """
    normal = turned * area_normals(points, triangles)
    length = np.linalg.norm(normal, axis=1)
    solid = length > 0.0
    normal, corner = normal[solid] / length[solid, None], points[triangles[solid, 0]]
    least = IN_PLANE * max(np.abs(points).max(initial=0.0), 1e-300)
    offset = (normal * corner).sum(axis=1)
    for first in range(0, len(normal), CHUNK):
        rows = slice(first, first + CHUNK)
        along = normal[rows] @ points.T
        if (along.max(axis=1, initial=-np.inf) > offset[rows] + least).any():
            return True
        if both and (along.min(axis=1, initial=np.inf) < offset[rows] - least).any():
            return True
    return False

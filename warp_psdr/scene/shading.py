"""Whether a scene's interpolated normals differ from those of its triangles."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warp_psdr.kernels import structs
    from warp_psdr.scene.scene import Scene

#: Difference of a unit vertex normal and its triangle's that is rounding, float32.
ROUNDED = 1.0e-6
#: Triangles with interpolated normals that are looked through for ones that differ.
FEW = 10_000


def vertex_normals(scene: Scene) -> Iterator[tuple[structs.Shape, np.ndarray]]:
    """Yield every shape with interpolated normals and the normals at its vertices, (vertices, 3), float32."""
    values = scene.values.numpy()
    for s in scene.builder.shapes:
        if s.smooth == 1:
            first = s.normal_offset + 3 * s.first_vertex
            yield s, values[first : first + 3 * s.vertex_count].reshape(-1, 3)


def normals_at_corners(scene: Scene) -> Iterator[tuple[structs.Shape, np.ndarray, np.ndarray]]:
    """Yield every shape with interpolated normals, the unit normals of its triangles and the normals at their corners.

    Of shapes (faces, 3) and (faces, 3, 3).
    """
    points = scene.points.astype(np.float64)
    for s, normals in vertex_normals(scene):
        faces = scene.builder.indices[s.first_face : s.first_face + s.face_count]
        p = points[faces]
        normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
        yield s, normal, normals.astype(np.float64)[faces - s.first_vertex]


def shades_flat(scene: Scene) -> bool:
    """Whether all interpolated normals are those of their triangles but for roundings, as rectangles and cubes have it.

    False for scenes with many triangles that have such normals: these are not looked through.
    """
    if sum(s.face_count for s in scene.builder.shapes if s.smooth == 1) > FEW:
        return False
    for _shape, normal, at in normals_at_corners(scene):
        unit = at / np.maximum(np.linalg.norm(at, axis=-1, keepdims=True), 1e-300)
        if not (np.abs(unit - normal[:, None]) <= ROUNDED).all():
            return False
    return True

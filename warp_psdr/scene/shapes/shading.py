"""Whether a scene's interpolated normals differ from those of its triangles."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr import columns

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


def normals_at_vertices(scene: Scene) -> np.ndarray:
    """Return the normals at all vertices, (V, 3) float32; zero where none are interpolated."""
    found = np.zeros((scene.vertex_count, 3), np.float32)
    for s, own in vertex_normals(scene):
        found[s.first_vertex : s.first_vertex + s.vertex_count] = own
    return found


def normals_at_corners(scene: Scene) -> Iterator[tuple[slice, np.ndarray, list[np.ndarray]]]:
    """Yield the triangles with interpolated normals, in stretches of one shape: which triangles, and their normals.

    The normals are by component, (3, faces): the triangles' own, of unit length, and those at their three corners.
    """
    points = columns.of(scene.points)
    for s, normals in vertex_normals(scene):
        at = columns.of(normals)
        end = s.first_face + s.face_count
        for first in range(s.first_face, end, columns.CHUNK):
            rows = slice(first, min(first + columns.CHUNK, end))
            corners = scene.builder.indices[rows].T
            a, b, c = (columns.take(points, corner) for corner in corners)
            normal = columns.cross(b - a, c - a)
            normal /= np.maximum(columns.length(normal), 1e-300)
            yield rows, normal, [columns.take(at, corner - s.first_vertex) for corner in corners]


def shades_flat(scene: Scene) -> bool:
    """Whether all interpolated normals are those of their triangles but for roundings, as rectangles and cubes have it.

    False for scenes with many triangles that have such normals: these are not looked through.
    """
    if sum(s.face_count for s in scene.builder.shapes if s.smooth == 1) > FEW:
        return False
    for _rows, normal, at in normals_at_corners(scene):
        for corner in at:
            unit = corner / np.maximum(columns.length(corner), 1e-300)
            if not (np.abs(unit - normal) <= ROUNDED).all():
                return False
    return True

"""Whether a scene's interpolated normals say anything that its triangles do not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Difference of a unit vertex normal and its triangle's that is rounding, float32.
ROUNDED = 1.0e-6
#: Triangles with interpolated normals that are looked through for ones that differ.
FEW = 10_000


def shades_flat(scene: Scene) -> bool:
    """Whether all interpolated normals are those of their triangles but for roundings, as rectangles and cubes have it.

    False for scenes with many triangles that have such normals: these are not looked through.
    """
    shapes = [s for s in scene.builder.shapes if s.smooth == 1]
    if sum(s.face_count for s in shapes) > FEW:
        return False
    values, points = scene.values.numpy().astype(np.float64), scene.points.astype(np.float64)
    for s in shapes:
        faces = scene.builder.indices[s.first_face : s.first_face + s.face_count]
        p = points[faces]
        normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        first = s.normal_offset + 3 * s.first_vertex
        at = values[first : first + 3 * s.vertex_count].reshape(-1, 3)[faces - s.first_vertex]
        normal, at = (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300) for v in (normal, at))
        if not (np.abs(at - normal[:, None]) <= ROUNDED).all():
            return False
    return True

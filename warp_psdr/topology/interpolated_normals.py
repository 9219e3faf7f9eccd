"""Triangles whose interpolated normals differ from their own, and the density by which they are drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.scene.light_sampling import cumulative
from warp_psdr.scene.shading import normals_at_corners, vertex_normals
from warp_psdr.topology.camera_view import camera_view
from warp_psdr.topology.edges import COPLANAR
from warp_psdr.topology.film_edges import scatters

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Weight of triangles whose corners all face the camera, or all turn away, against those with both: between such
#: corners an interpolated normal can still turn away and back.
TERMINATOR_FLOOR = 0.01


def bend(scene: Scene) -> np.ndarray:
    """Return for every triangle the largest sine between its normal and the interpolated ones at its corners.

    Kept as long as the vertices and the normals stay.
    """
    now = [scene.points, *(normals for _, normals in vertex_normals(scene))]
    kept = getattr(scene, "_bend", None)
    if kept is not None and all(map(np.array_equal, kept[0], now)):
        return kept[1]
    sines = np.zeros(scene.face_count)
    for s, normal, at in normals_at_corners(scene):
        rows = slice(s.first_face, s.first_face + s.face_count)
        sines[rows] = np.linalg.norm(np.cross(at, normal[:, None]), axis=2).max(axis=1)
    scene._bend = ([array.copy() for array in now], sines)  # type: ignore[attr-defined]
    return sines


def interpolated_faces(scene: Scene) -> np.ndarray:
    """Return a mask of the triangles whose interpolated normals differ from their face normal."""
    return bend(scene) > COPLANAR


def interpolated_choice(scene: Scene) -> tuple[wp.array, wp.array, float] | None:
    """Return cumulative probabilities and numbers of the bent triangles, by area and bend; None: there are none.

    The third result is the mean of their bend (a sine).
    """
    sines = bend(scene)
    faces = np.flatnonzero(sines > COPLANAR)
    if not len(faces):
        return None
    points = scene.points
    p = points[scene.builder.indices[faces]].astype(np.float64)
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    cdf = wp.array(cumulative(area * sines[faces]), dtype=wp.float32, device=scene.device)
    mean = float((area * sines[faces]).sum() / area.sum())
    return cdf, wp.array(faces.astype(np.int32), dtype=wp.int32, device=scene.device), mean


def terminator_faces(
    scene: Scene, sensor: int, shapes: set[int], *, camera_moves: bool
) -> tuple[wp.array, wp.array] | None:
    """Return cumulative probabilities and numbers of the triangles that a terminator can cross; None: there are none.

    Args:
        scene: the scene.
        sensor: which camera.
        shapes: the shapes that move.
        camera_moves: a parameter of the camera is differentiated.
    """
    values = scene.values.numpy().astype(np.float64)
    points = scene.points.astype(np.float64)
    view = camera_view(scene, sensor)
    interpolated = interpolated_faces(scene)
    more = np.asarray(scatters(scene).any(axis=1))
    numbers, weights = [], []
    for i, s in enumerate(scene.builder.shapes):
        # What mirrors and glass reflect where n . v is small goes into their own triangle: black on both sides.
        if s.smooth == 0 or not more[i] or not (camera_moves or i in shapes):
            continue
        vertices = slice(s.first_vertex, s.first_vertex + s.vertex_count)
        first = s.normal_offset + 3 * s.first_vertex
        normals = values[first : first + 3 * s.vertex_count].reshape(-1, 3)
        facing = (normals * view.towards(points[vertices])).sum(axis=1)
        spread = view.spread(normals)
        faces = scene.builder.indices[s.first_face : s.first_face + s.face_count]
        least, most = (q[faces - s.first_vertex] for q in (facing - spread, facing + spread))
        crossed = (least.min(axis=1) <= 0.0) & (most.max(axis=1) >= 0.0)
        p = points[faces]
        size = np.linalg.norm(p - p[:, [1, 2, 0]], axis=2).max(axis=1)
        size /= np.linalg.norm(view.towards(p.mean(axis=1)), axis=1)
        numbers.append(s.first_face + np.arange(s.face_count))
        weights.append(np.where(crossed, size, TERMINATOR_FLOOR * size))
    faces = np.concatenate([np.zeros(0, np.int32), *numbers]).astype(np.int32)
    weight = np.concatenate([np.zeros(0), *weights])[interpolated[faces]]
    faces = faces[interpolated[faces]]
    if not len(faces):
        return None
    cdf = wp.array(cumulative(weight), dtype=wp.float32, device=scene.device)
    return cdf, wp.array(faces, dtype=wp.int32, device=scene.device)

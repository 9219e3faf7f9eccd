"""Triangles whose interpolated normals differ from their own, and the density by which they are drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import columns
from warp_psdr.scene.lights.light_sampling import cumulative
from warp_psdr.scene.shapes.shading import normals_at_corners, vertex_normals
from warp_psdr.topology.camera_view import CameraView, camera_view
from warp_psdr.topology.edges import COPLANAR, normal_columns
from warp_psdr.topology.film_edges import scatters
from warp_psdr.topology.unchanged import kept

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
    before = getattr(scene, "_bend", None)
    if before is not None and all(map(np.array_equal, before[0], now)):
        return before[1]
    sines = np.zeros(scene.face_count)
    for rows, normal, at in normals_at_corners(scene):
        a, b, c = (columns.length(columns.cross(corner, normal)) for corner in at)
        sines[rows] = np.maximum(np.maximum(a, b), c)
    scene._bend = ([array.copy() for array in now], sines)  # type: ignore[attr-defined]
    return sines


def interpolated_faces(scene: Scene) -> np.ndarray:
    """Return a mask of the triangles whose interpolated normals differ from their face normal."""
    return bend(scene) > COPLANAR


def interpolated_choice(scene: Scene) -> tuple[wp.array, wp.array, float] | None:
    """Return cumulative probabilities and numbers of the bent triangles, by area and bend; None: there are none.

    The third result is the mean of their bend (a sine).
    """
    return kept(scene, "interpolated_choice", lambda: _interpolated_choice(scene))


def _interpolated_choice(scene: Scene) -> tuple[wp.array, wp.array, float] | None:
    sines = bend(scene)
    faces = np.flatnonzero(sines > COPLANAR)
    if not len(faces):
        return None
    area = columns.length(normal_columns(scene.points, scene.builder.indices.take(faces, axis=0)))
    weight = area * sines[faces]
    cdf = wp.array(cumulative(weight), dtype=wp.float32, device=scene.device)
    mean = float(weight.sum() / area.sum())
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
    key = ("terminator_faces", sensor, frozenset(shapes), camera_moves)
    return kept(scene, key, lambda: _terminator_faces(scene, sensor, shapes, camera_moves))


def _terminator_faces(
    scene: Scene, sensor: int, shapes: set[int], camera_moves: bool
) -> tuple[wp.array, wp.array] | None:
    values = scene.values.numpy()
    points = columns.of(scene.points)
    view = camera_view(scene, sensor)
    interpolated = interpolated_faces(scene)
    more = np.asarray(scatters(scene).any(axis=1))
    numbers, weights = [], []
    for i, s in enumerate(scene.builder.shapes):
        # What mirrors and glass reflect where n . v is small goes into their own triangle: black on both sides.
        if s.smooth == 0 or not more[i] or not (camera_moves or i in shapes):
            continue
        own = points[:, s.first_vertex : s.first_vertex + s.vertex_count]
        first = s.normal_offset + 3 * s.first_vertex
        normals = columns.of(values[first : first + 3 * s.vertex_count].reshape(-1, 3))
        faces = scene.builder.indices[s.first_face : s.first_face + s.face_count] - s.first_vertex
        numbers.append(s.first_face + np.arange(s.face_count))
        weights.append(_terminator_weights(view, own, normals, faces))
    faces = np.concatenate([np.zeros(0, np.int32), *numbers]).astype(np.int32)
    weight = np.concatenate([np.zeros(0), *weights])[interpolated[faces]]
    faces = faces[interpolated[faces]]
    if not len(faces):
        return None
    cdf = wp.array(cumulative(weight), dtype=wp.float32, device=scene.device)
    return cdf, wp.array(faces, dtype=wp.int32, device=scene.device)


def _terminator_weights(view: CameraView, points: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the sizes of triangles as the camera sees them, less where no terminator can cross them.

    Args:
        view: the camera's.
        points: (3, V) vertices.
        normals: (3, V) interpolated normals at them.
        faces: (F, 3) numbers of the triangles' vertices.
    """
    facing = columns.dot(normals, view.towards(points.T).T)
    spread = view.spread(normals.T)
    least, most = facing - spread, facing + spread

    def weigh(rows: slice) -> tuple[np.ndarray]:
        corners = faces[rows].T
        low = np.minimum.reduce([least.take(corner) for corner in corners])
        high = np.maximum.reduce([most.take(corner) for corner in corners])
        a, b, c = (columns.take(points, corner) for corner in corners)
        size = np.maximum.reduce([columns.length(a - b), columns.length(b - c), columns.length(c - a)])
        size /= columns.length(view.towards(((a + b + c) / 3.0).T).T)
        return (np.where((low <= 0.0) & (high >= 0.0), size, TERMINATOR_FLOOR * size),)

    return columns.in_chunks(weigh, len(faces))[0]

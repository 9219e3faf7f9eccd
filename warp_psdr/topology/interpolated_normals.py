"""Triangles whose interpolated normals differ from their own, and the density by which they are drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import columns
from warp_psdr.device import launch_on_host
from warp_psdr.kernels.boundary.shading_normals.bent_faces import face_bends, terminator_weights
from warp_psdr.scene.lights.light_sampling import cumulative
from warp_psdr.scene.shapes.shading import normals_at_vertices, vertex_normals
from warp_psdr.topology.camera_view import camera_view
from warp_psdr.topology.edges import COPLANAR, scene_normals
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
    inputs = [scene.points, scene.builder.indices, normals_at_vertices(scene)]
    (sines,) = launch_on_host(face_bends, scene.face_count, inputs, [wp.float64])
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
    area = columns.length(scene_normals(scene)).take(faces)
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
    b = scene.builder
    moves = np.full(len(b.shapes), camera_moves)
    moves[sorted(shapes)] = True
    # What mirrors and glass reflect where n . v is small goes into their own triangle: black on both sides.
    used = moves & np.any(scatters(scene), axis=1) & np.array([s.smooth != 0 for s in b.shapes], bool)
    faces = np.flatnonzero(interpolated_faces(scene) & used[b.face_shape]).astype(np.int32)
    if not len(faces):
        return None
    view = camera_view(scene, sensor).record()
    inputs = [view, scene.points, b.indices.take(faces, axis=0), normals_at_vertices(scene), TERMINATOR_FLOOR]
    (weight,) = launch_on_host(terminator_weights, len(faces), inputs, [wp.float64])
    cdf = wp.array(cumulative(weight), dtype=wp.float32, device=scene.device)
    return cdf, wp.array(faces, dtype=wp.int32, device=scene.device)

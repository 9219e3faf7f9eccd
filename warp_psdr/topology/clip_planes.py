"""Surfaces that a camera's clip planes cut in sight of the film: moving borders without an edge."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.topology.camera_view import camera_view

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene
    from warp_psdr.topology.camera_view import CameraView

#: The cut is looked at from this fraction of the plane's distance inside of it, where rounding does not clip it away.
INSIDE = 1.0e-6


def require_uncut(scene: Scene, sensor: int, shapes: set[int], *, camera_moves: bool) -> None:
    """Raise if a clip plane cuts what moves in sight of the film.

    Args:
        scene: the scene.
        sensor: which camera.
        shapes: the shapes that move.
        camera_moves: a parameter of the camera is differentiated: everything moves.

    Raises:
        ValueError: the derivative of that border is in no term.
    """
    points, view = scene.points, camera_view(scene, sensor)
    moving = [s for i, s in enumerate(scene.builder.shapes) if camera_moves or i in shapes]
    depths = [view.depth(points[s.first_vertex : s.first_vertex + s.vertex_count]) for s in moving]
    near, far = _planes(view)
    if all(near < depth.min(initial=far) and depth.max(initial=near) < far for depth in depths):
        return  # as nearly always, and quickly found
    of = scene.builder.face_shape
    faces = np.flatnonzero(np.isin(of, sorted(shapes)) | camera_moves)
    cut = visible_cuts(view, points[scene.builder.indices[faces]].astype(np.float64))
    if cut.any():
        path = scene.description.shapes[of[faces[cut.argmax()]]].path
        raise ValueError(
            f"a clip plane of sensor {sensor} cuts {path!r} where the film shows it, and the derivative of that border "
            "is not estimated; change near_clip or far_clip, move the camera, or say PathIntegrator(boundary=None) to "
            "get the interior term alone"
        )


def visible_cuts(view: CameraView, corners: np.ndarray) -> np.ndarray:
    """Return a mask of the triangles that the near or the far plane cuts along a line that the film can see.

    Args:
        view: the camera.
        corners: (M, 3, 3) corners of triangles, in the coordinates of ``view``.
    """
    depth = view.depth(corners)
    found = np.zeros(len(corners), bool)
    for plane in _planes(view):
        front = depth > plane
        rows = np.flatnonzero(front.any(axis=1) & ~front.all(axis=1))
        # The corner that is alone on its side comes first: both sides from it cross the plane.
        alone = np.where(front[rows].sum(axis=1) == 1, front[rows].argmax(axis=1), front[rows].argmin(axis=1))
        order = (alone[:, None] + np.arange(3)) % 3
        p, z = (np.take_along_axis(a[rows], o, 1) for a, o in ((corners, order[:, :, None]), (depth, order)))
        share = (plane - z[:, :1]) / (z[:, 1:] - z[:, :1])
        ends = p[:, :1] + share[:, :, None] * (p[:, 1:] - p[:, :1])
        found[rows] |= view.clip(ends)[2] > 0.0
    return found


def _planes(view: CameraView) -> tuple[float, float]:
    """Return the depths at which cuts are looked for."""
    near, far = view.clip_depths()
    return near * (1.0 + INSIDE), far * (1.0 - INSIDE)

"""Shapes without triangles against the rest of a scene: what runs through them, and clip planes that cut them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.topology.camera_view import camera_view

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Distance, over the size of a shape, to which what touches it counts as outside, or inside.
TOUCHING = 1.0e-4
#: Points of an ellipsoid that are looked at first, and steps from the best of them.
POINTS, STEPS = 512, 64


def pose(scene: Scene, shape: int) -> tuple[np.ndarray, np.ndarray]:
    """Return A (3, 3) and b (3,) of a shape, in the device's coordinates."""
    offset = scene.pose_offsets(shape)[0]
    matrix = scene.values.numpy()[offset : offset + 16].reshape(4, 4).astype(np.float64)
    return matrix[:3, :3], matrix[:3, 3]


def pierced(scene: Scene, shapes: frozenset[int] | None) -> tuple[int, int] | None:
    """Return an exact shape and one that runs through its surface, one of them among ``shapes`` (None: any).

    Triangles are tested exactly; of another ellipsoid the nearest and the farthest point are searched for.
    """
    exact, b = scene.builder.primitives, scene.builder
    corners = scene.points[b.indices].astype(np.float64)
    for i in exact:
        linear, center = pose(scene, i)
        inverse = np.linalg.inv(linear)
        local = (corners - center) @ inverse.T
        near = (local.min(axis=1, initial=np.inf) < 1.0).all(axis=1) & (local.max(axis=1, initial=-np.inf) > -1.0).all(
            axis=1
        )
        near &= np.linalg.norm(local, axis=2).max(axis=1, initial=0.0) > 1.0 + TOUCHING
        if shapes is not None and i not in shapes:
            near &= np.isin(b.face_shape, sorted(shapes))
        rows = np.flatnonzero(near)
        hit = rows[least_distance(local[rows]) < 1.0 - TOUCHING]
        if len(hit):
            return i, int(b.face_shape[hit[0]])
        for j in exact:
            if j > i and (shapes is None or i in shapes or j in shapes):
                other, place = pose(scene, j)
                low, high = _extent(inverse @ other, inverse @ (place - center))
                if low < 1.0 - TOUCHING and high > 1.0 + TOUCHING:
                    return i, j
    return None


def least_distance(corners: np.ndarray) -> np.ndarray:
    """Return the distances (M,) of triangles (M, 3, 3) from the origin."""
    found = np.full(len(corners), np.inf)
    for k in range(3):
        p, q = corners[:, k], corners[:, (k + 1) % 3]
        way = q - p
        t = np.clip(-(p * way).sum(axis=1) / np.maximum((way * way).sum(axis=1), 1e-300), 0.0, 1.0)
        found = np.minimum(found, np.linalg.norm(p + t[:, None] * way, axis=1))
    p, q, r = corners[:, 0], corners[:, 1], corners[:, 2]
    n = np.cross(q - p, r - p)
    squared = np.maximum((n * n).sum(axis=1), 1e-300)
    foot = ((p * n).sum(axis=1) / squared)[:, None] * n
    inside = np.ones(len(corners), bool)
    for a, b in ((p, q), (q, r), (r, p)):
        inside &= (np.cross(b - a, foot - a) * n).sum(axis=1) >= 0.0
    return np.where(inside, np.minimum(found, np.linalg.norm(foot, axis=1)), found)


def _extent(linear: np.ndarray, center: np.ndarray) -> tuple[float, float]:
    """Return the least and the largest distance of points M q + c of an ellipsoid, |q| = 1, from the origin."""
    k = np.arange(POINTS) + 0.5
    z, phi = 1.0 - 2.0 * k / POINTS, np.pi * (1.0 + np.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z * z)
    q = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    size = np.linalg.norm(linear, 2) ** 2
    ends = []
    for sign in (-1.0, 1.0):
        distance = np.linalg.norm(q @ linear.T + center, axis=1)
        best = q[np.argmax(sign * distance)]
        for _ in range(STEPS):  # up or down the slope of half the squared distance, back onto the sphere
            best = best + sign * (linear.T @ (linear @ best + center)) / size
            best = best / np.linalg.norm(best)
        ends.append(float(np.linalg.norm(linear @ best + center)))
    return ends[0], ends[1]


def require_uncut(scene: Scene, sensor: int, shapes: frozenset[int] | None) -> None:
    """Raise if a clip plane of a camera cuts an exact shape that moves against it (None: all do).

    Raises:
        ValueError: the derivative of that border is in no term.
    """
    view = camera_view(scene, sensor)
    axis = np.linalg.inv(view.pose[:3, :3])[2]
    size = float(np.linalg.norm(view.pose[:3, 2]))
    near, far = view.camera.near, view.camera.far
    near, far = (near / size, far / size) if view.finite else (near, near + (far - near) / size)
    for i in scene.builder.primitives:
        if shapes is not None and i not in shapes:
            continue
        linear, center = pose(scene, i)
        middle, half = float(axis @ (center - view.pose[:3, 3])), float(np.linalg.norm(axis @ linear))
        for plane in (near, far):
            if middle - half < plane < middle + half:
                raise ValueError(
                    f"a clip plane of sensor {sensor} cuts the exact shape {scene.description.shapes[i].path!r}, and "
                    "the derivative of that border is not estimated; change near_clip or far_clip, move the camera, or "
                    "say PathIntegrator(boundary=None) to get the interior term alone"
                )

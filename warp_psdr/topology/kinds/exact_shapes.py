"""Shapes without triangles against the rest of a scene: what runs through them, and clip planes that cut them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.scene.kinds.affine import Exact
from warp_psdr.scene.shapes.primitives import cylinder, disk, sphere
from warp_psdr.topology.camera_view import camera_view

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Distance, over the size of a shape, to which what touches it counts as outside, or inside.
TOUCHING = 1.0e-4
#: Segments of a disk or cylinder that keeps to it within ``TOUCHING``.
SEGMENTS = 256
#: The same of a sphere that stands for one beside grids and curves: within a thousandth of its radius.
COARSE = 128
#: Points of an ellipsoid that are looked at first, and steps from the best of them.
POINTS, STEPS = 512, 64


def pose(scene: Scene, shape: int) -> tuple[np.ndarray, np.ndarray]:
    """Return A (3, 3) and b (3,) of a shape, in the device's coordinates."""
    offset = scene.poses.offsets(shape)[0]
    matrix = scene.values.numpy()[offset : offset + 16].reshape(4, 4).astype(np.float64)
    return matrix[:3, :3], matrix[:3, 3]


def rim_points(end: float, count: int, widened: float = 1.0) -> np.ndarray:
    """Return points (count, 3) of a rim of a disk or a cylinder, in the shape's own coordinates."""
    phi = 2.0 * np.pi * np.arange(count) / count
    return np.stack([widened * np.cos(phi), widened * np.sin(phi), np.full(count, float(end))], axis=1)


def crossed_faces(scene: Scene, shape: int, shapes: frozenset[int] | None) -> np.ndarray:
    """Return the numbers of the triangles that run through an exact shape, one of both among ``shapes`` (None: any).

    What touches a sphere does not run through it; what touches a disk or a cylinder is counted.
    """
    linear, center = pose(scene, shape)
    corners = scene.points[scene.builder.indices].astype(np.float64)
    rows = np.arange(len(corners))
    if shapes is not None and shape not in shapes:
        rows = np.flatnonzero(np.isin(scene.builder.face_shape, sorted(shapes)))
    crosses = CROSSED[scene.geometry(shape).name]
    return rows[crosses((corners[rows] - center) @ np.linalg.inv(linear).T)]


def exact_shapes(scene: Scene) -> list[int]:
    """Return the numbers of the shapes that are exact."""
    return [i for i in scene.builder.primitives if scene.geometry(i).is_material]


def crossable_shapes(scene: Scene) -> list[int]:
    """Return those whose curves of intersection are known."""
    return [i for i in exact_shapes(scene) if scene.geometry(i).name in CROSSED]


def reaching(scene: Scene, shapes: frozenset[int] | None) -> tuple[int, int] | None:
    """Return an exact shape without known curves of intersection, and another shape that may run through it.

    One of them is in ``shapes`` (None: any). Triangles may if they reach into the box around the shape.
    """
    others = sorted(set(exact_shapes(scene)) - set(crossable_shapes(scene)))
    corners, owners = with_exact_shapes(scene) if others else (np.zeros((0, 3, 3)), np.zeros(0, np.int64))
    for i in others:
        linear, center = pose(scene, i)
        box = scene.geometry(i).corners(np.eye(4)).astype(np.float64)
        low, high = box.min(axis=0) - TOUCHING, box.max(axis=0) + TOUCHING
        asked = owners != i if shapes is None or i in shapes else np.isin(owners, sorted(shapes - {i}))
        local = (corners[asked] - center) @ np.linalg.inv(linear).T
        near = ((local.min(axis=1, initial=np.inf) < high) & (local.max(axis=1, initial=-np.inf) > low)).all(axis=1)
        n = np.cross(local[:, 1] - local[:, 0], local[:, 2] - local[:, 0])
        least, most = (
            (n * (np.where(n > 0.0, *ends) - local[:, 0])).sum(axis=1) for ends in ((low, high), (high, low))
        )
        near &= (least <= 0.0) & (most >= 0.0)
        if near.any():
            return i, int(owners[asked][near.argmax()])
    return None


def runs_through(scene: Scene, i: int, j: int) -> bool:
    """Return whether an exact shape runs through another one, or may touch it.

    Of an ellipsoid the nearest and the farthest point are searched for, disks and cylinders are tested as triangles
    that keep to them within ``TOUCHING``. What touches a sphere is none that runs through it; what touches a disk or a
    cylinder counts as one.
    """
    kinds = [scene.geometry(k).name for k in (i, j)]
    if kinds[1] == "sphere" and kinds[0] != "sphere":
        i, j, kinds = j, i, kinds[::-1]
    linear, center = pose(scene, i)
    inverse = np.linalg.inv(linear)
    other, place = pose(scene, j)
    if kinds[1] != "sphere":
        return len(CROSSED[kinds[0]]((TRIANGLES[kinds[1]] @ other.T + place - center) @ inverse.T)) > 0
    low, high = _extent(inverse @ other, inverse @ (place - center))
    return low < 1.0 - TOUCHING and high > 1.0 + TOUCHING


def _cross_sphere(local: np.ndarray) -> np.ndarray:
    """Return the numbers of the triangles (M, 3, 3) that run through the unit sphere."""
    near = (local.min(axis=1, initial=np.inf) < 1.0).all(axis=1) & (local.max(axis=1, initial=-np.inf) > -1.0).all(
        axis=1
    )
    near &= np.linalg.norm(local, axis=2).max(axis=1, initial=0.0) > 1.0 + TOUCHING
    rows = np.flatnonzero(near)
    return rows[least_distance(local[rows]) < 1.0 - TOUCHING]


def _cross_disk(local: np.ndarray) -> np.ndarray:
    """Return the numbers of the triangles (M, 3, 3) that come within ``TOUCHING`` of the unit disk."""
    rows, nearest, _farthest = _across(local, -TOUCHING, TOUCHING)
    return rows[nearest < 1.0 + TOUCHING]


def _cross_cylinder(local: np.ndarray) -> np.ndarray:
    """Return the numbers of the triangles (M, 3, 3) that come within ``TOUCHING`` of the open unit cylinder."""
    rows, nearest, farthest = _across(local, -TOUCHING, 1.0 + TOUCHING)
    return rows[(nearest < 1.0 + TOUCHING) & (farthest > 1.0 - TOUCHING)]


#: Kind -> the triangles that run through it.
CROSSED = {"sphere": _cross_sphere, "disk": _cross_disk, "cylinder": _cross_cylinder}
#: Disks and cylinders as triangles, in their own coordinates.
TRIANGLES = {
    kind: made.vertices[made.faces]
    for kind, made in (("disk", disk(SEGMENTS)), ("cylinder", cylinder(SEGMENTS)), ("sphere", sphere(COARSE)))
}


def with_exact_shapes(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles (M, 3, 3) of a scene and those that stand for its exact shapes, and their shapes (M,)."""
    corners, owners = [scene.points[scene.builder.indices].astype(np.float64)], [scene.builder.face_shape]
    for i in exact_shapes(scene):
        linear, center = pose(scene, i)
        corners.append(_triangles(scene, i) @ linear.T + center)
        owners.append(np.full(len(corners[-1]), i))
    return np.concatenate(corners), np.concatenate(owners)


def _triangles(scene: Scene, shape: int) -> np.ndarray:
    """Return the triangles (M, 3, 3) that stand for an exact shape, in its own coordinates."""
    geometry = scene.geometry(shape)
    if geometry.name in TRIANGLES:
        return TRIANGLES[geometry.name]
    assert isinstance(geometry, Exact)
    made = geometry.tessellate(SEGMENTS)
    return made.vertices[made.faces]


def _across(local: np.ndarray, low: float, high: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which triangles (M, 3, 3) have a part with z in [low, high], and its least and largest distance from z.

    The part is bounded by parts of the sides, and by where the triangle crosses the two planes.
    """
    least, most = local.min(axis=1, initial=np.inf), local.max(axis=1, initial=-np.inf)
    rows = (least < [1.0 + TOUCHING, 1.0 + TOUCHING, high]).all(axis=1)
    rows = np.flatnonzero(rows & (most > [-1.0 - TOUCHING, -1.0 - TOUCHING, low]).all(axis=1))
    p = local[rows]
    q = np.roll(p, -1, axis=1)
    rise = q[..., 2] - p[..., 2]
    level = rise == 0.0
    ends = [(plane - p[..., 2]) / np.where(level, 1.0, rise) for plane in (low, high)]
    inside = (p[..., 2] >= low) & (p[..., 2] <= high)
    first = np.where(level, np.where(inside, 0.0, 2.0), np.minimum(*ends).clip(0.0, None))
    last = np.where(level, np.where(inside, 1.0, -1.0), np.maximum(*ends).clip(None, 1.0))
    some = first <= last
    a, b = (p[..., :2] + t[..., None] * (q - p)[..., :2] for t in (first, last))
    nearest = np.where(some, _segment_distance(a, b), np.inf).min(axis=1, initial=np.inf)
    farthest = np.where(some, np.maximum(np.linalg.norm(a, axis=2), np.linalg.norm(b, axis=2)), 0.0)
    for t in ends:
        crossed = ~level & (t >= 0.0) & (t <= 1.0)
        order = np.argsort(~crossed, axis=1, kind="stable")[:, :2]
        points = np.take_along_axis(p[..., :2] + t[..., None] * (q - p)[..., :2], order[..., None], axis=1)
        both = crossed.sum(axis=1) >= 2
        nearest = np.where(both, np.minimum(nearest, _segment_distance(points[:, 0], points[:, 1])), nearest)
    # The z axis itself may run through the part.
    n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    turns = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    covers = ((turns > 0.0).all(axis=1) | (turns < 0.0).all(axis=1)) & (n[:, 2] != 0.0)
    height = (n * p[:, 0]).sum(axis=1) / np.where(covers, n[:, 2], 1.0)
    nearest = np.where(covers & (height >= low) & (height <= high), 0.0, nearest)
    return rows, nearest, farthest.max(axis=1, initial=0.0)


def _segment_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the distances (...) of segments from a to b (..., D) from the origin."""
    way = b - a
    t = np.clip(-(a * way).sum(axis=-1) / np.maximum((way * way).sum(axis=-1), 1e-300), 0.0, 1.0)
    return np.linalg.norm(a + t[..., None] * way, axis=-1)


def least_distance(corners: np.ndarray) -> np.ndarray:
    """Return the distances (M,) of triangles (M, 3, 3) from the origin."""
    found = np.full(len(corners), np.inf)
    for k in range(3):
        found = np.minimum(found, _segment_distance(corners[:, k], corners[:, (k + 1) % 3]))
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
    for i in exact_shapes(scene):
        if shapes is not None and i not in shapes:
            continue
        geometry = scene.geometry(i)
        assert isinstance(geometry, Exact)
        linear, center = pose(scene, i)
        way = axis @ linear
        middle = float(view.depth(center) + way @ (0.5 * (geometry.box.min(axis=0) + geometry.box.max(axis=0))))
        reach = geometry.reach(way)
        for plane in view.clip_depths():
            if middle - reach < plane < middle + reach:
                raise ValueError(
                    f"a clip plane of sensor {sensor} cuts the exact shape {scene.description.shapes[i].path!r}, and "
                    "the derivative of that border is not estimated; change near_clip or far_clip, move the camera, or "
                    "say PathIntegrator(boundary=None) to get the interior term alone"
                )

"""Curves with a radius against the rest of a scene: what runs through them, and clip planes that cut them.

A segment is looked at as cones between spheres along its axis; those at the ends of curves count as well, so that what
comes closer to an open end than its radius counts as what runs through it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.device import launch
from warp_psdr.kernels.primitive.curves_overlap import FINER, TOUCHING, find_overlaps
from warp_psdr.scene.curve_points import coefficients, world_points
from warp_psdr.scene.sdfgrid import is_passed
from warp_psdr.topology.camera_view import camera_view
from warp_psdr.topology.exact_shapes import least_distance, pose, with_exact_shapes
from warp_psdr.topology.grid_silhouettes import grid_shapes, grid_values, is_smooth_grid
from warp_psdr.topology.tubes import curve_shapes

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Boxes that are compared with others at once.
CHUNK = 512


def pierced_tubes(scene: Scene, shapes: frozenset[int] | None) -> tuple[int, int] | None:
    """Return curves and a shape that runs through them, one of them among ``shapes`` (None: any)."""
    corners, owners = with_exact_shapes(scene)
    found = curve_shapes(scene)
    for number, i in enumerate(found):
        rows = np.arange(len(corners))
        if shapes is not None and i not in shapes:
            rows = rows[np.isin(owners, sorted(shapes))]
        low, high = _bounds(scene, i)
        rows = rows[((corners[rows].min(axis=1) < high) & (corners[rows].max(axis=1) > low)).all(axis=1)]
        grids = [j for j in grid_shapes(scene) if shapes is None or i in shapes or j in shapes]
        cones = _cones(scene, i) if len(rows) or grids else np.zeros((0, 2, 4))
        for own, theirs in _near(cones, corners[rows].min(axis=1), corners[rows].max(axis=1)):
            hit = _depth_of_triangles(cones[own], corners[rows[theirs]]) > TOUCHING
            if hit.any():
                return i, int(owners[rows[theirs[hit.argmax()]]])
        for j in grids:
            if _meets_grid(scene, cones, j):
                return i, j
        for j in found[number:]:
            if (shapes is None or i in shapes or j in shapes) and _overlap(scene, i, j):
                return i, j
    return None


def _overlap(scene: Scene, shape: int, other: int) -> bool:
    """Whether curves of a shape run through those of another, or through each other."""
    curves = scene.description.shapes[shape].curves
    assert curves is not None
    records = [scene.face_count + scene.builder.primitives.index(i) for i in (shape, other)]
    found = wp.zeros(1, dtype=wp.int32, device=scene.device)
    launch(find_overlaps, len(curves.firsts), [scene.data(), *records], [found], device=scene.device)
    return bool(found.numpy()[0])


def _bounds(scene: Scene, shape: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (3,) of a box around the tubes of a shape."""
    points = world_points(scene, shape)
    return (points[:, :3] - points[:, 3:]).min(axis=0), (points[:, :3] + points[:, 3:]).max(axis=0)


def _cones(scene: Scene, shape: int) -> np.ndarray:
    """Return cones (N, 2, 4) along curves."""
    curves = scene.description.shapes[shape].curves
    assert curves is not None
    points = world_points(scene, shape)
    count = FINER * curves.pieces if curves.cubic else 1
    if curves.cubic:
        a = coefficients(points, curves.firsts)
        v = np.linspace(0.0, 1.0, count + 1)[:, None, None]
        places = np.moveaxis(a[0] + v * (a[1] + v * (a[2] + v * a[3])), 0, 1)
    else:
        places = np.stack([points[curves.firsts], points[curves.firsts + 1]], axis=1)
    return np.stack([places[:, :-1], places[:, 1:]], axis=2).reshape(-1, 2, 4)


def _boxes(cones: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    radius = cones[..., 3:]
    return (cones[..., :3] - radius).min(axis=1), (cones[..., :3] + radius).max(axis=1)


def _near(cones: np.ndarray, low: np.ndarray, high: np.ndarray):
    """Yield pairs (own, theirs) of numbers of cones and of boxes that overlap theirs, chunk by chunk."""
    least, most = _boxes(cones)
    order = np.argsort(least[:, 0], kind="stable")
    for start in range(0, len(order), CHUNK):
        own = order[start : start + CHUNK]
        theirs = np.flatnonzero((low < most[own].max(axis=0)).all(axis=1) & (high > least[own].min(axis=0)).all(axis=1))
        over = (low[theirs] < most[own, None]).all(axis=2) & (high[theirs] > least[own, None]).all(axis=2)
        a, b = np.nonzero(over)
        if len(a):
            yield own[a], theirs[b]


def _meets_grid(scene: Scene, cones: np.ndarray, grid: int) -> bool:
    """Whether cones come so near to the middle of a voxel that a grid's surface passes that they may enter it."""
    values = grid_values(scene, grid)
    linear, origin = pose(scene, grid)
    edges = linear / (np.array(values.shape[::-1]) - 1.0)
    middles = (np.argwhere(is_passed(values, is_smooth_grid(scene, grid)))[:, ::-1] + 0.5) @ edges.T + origin
    reach = 0.5 * np.linalg.norm(edges, axis=0).sum()
    for own, theirs in _near(cones, middles - reach, middles + reach):
        axis = cones[own, 1, :3] - cones[own, 0, :3]
        way = middles[theirs] - cones[own, 0, :3]
        v = np.clip((way * axis).sum(1) / np.maximum((axis * axis).sum(1), 1e-300), 0.0, 1.0)
        if (np.linalg.norm(way - v[:, None] * axis, axis=1) < _radius(cones[own], v) + reach).any():
            return True
    return False


def _radius(cones: np.ndarray, v: np.ndarray) -> np.ndarray:
    return (1.0 - v) * cones[:, 0, 3] + v * cones[:, 1, 3]


def _closest(p: np.ndarray, d: np.ndarray, q: np.ndarray, e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the places (N,), 0 to 1, at which the segments p + s d and q + t e are next to each other."""
    r = p - q
    a, b, c = (d * d).sum(1), (d * e).sum(1), (e * e).sum(1)
    f, g = (d * r).sum(1), (e * r).sum(1)
    tiny = 1e-300
    s = np.clip((b * g - c * f) / np.maximum(a * c - b * b, 1e-12 * a * c + tiny), 0.0, 1.0)
    t = np.clip((b * s + g) / np.maximum(c, tiny), 0.0, 1.0)
    return np.clip((b * t - f) / np.maximum(a, tiny), 0.0, 1.0), t


def _depth_of_triangles(cones: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return how deep triangles (N, 3, 3) run into cones (N, 2, 4), over the radius."""
    p, d = cones[:, 0, :3], cones[:, 1, :3] - cones[:, 0, :3]
    deepest = np.full(len(cones), -np.inf)

    def meet(apart: np.ndarray, v: np.ndarray) -> None:
        radius = _radius(cones, v)
        np.maximum(deepest, 1.0 - apart / np.maximum(radius, 1e-300), out=deepest)

    for k in range(3):
        q, e = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        s, t = _closest(p, d, q, e)
        meet(np.linalg.norm(p + s[:, None] * d - q - t[:, None] * e, axis=1), s)
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    fall = (n * d).sum(1)
    crossing = np.clip(((corners[:, 0] - p) * n).sum(1) / np.where(fall == 0.0, 1.0, fall), 0.0, 1.0)
    for v in (np.zeros(len(cones)), crossing, np.ones(len(cones))):
        meet(least_distance(corners - (p + v[:, None] * d)[:, None]), v)
    return deepest


def require_uncut_tubes(scene: Scene, sensor: int, shapes: list[int]) -> None:
    """Raise if a clip plane of a camera cuts curves.

    Raises:
        ValueError: the derivative of that border is in no term.
    """
    view = camera_view(scene, sensor)
    axis = np.linalg.inv(view.pose[:3, :3])[2]
    for i in shapes:
        cones = _cones(scene, i)
        depth = view.depth(cones[..., :3])
        reach = cones[..., 3] * np.linalg.norm(axis)
        for plane in view.clip_depths():
            if (((depth - reach).min(axis=1) < plane) & ((depth + reach).max(axis=1) > plane)).any():
                raise ValueError(
                    f"a clip plane of sensor {sensor} cuts the curves {scene.description.shapes[i].path!r}, and the "
                    "derivative of that border is not estimated; change near_clip or far_clip, move the camera, or say "
                    "PathIntegrator(boundary=None) to get the interior term alone"
                )

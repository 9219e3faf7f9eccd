"""Curves with a radius against the rest of a scene: what runs through them, and clip planes that cut them.

A segment is approximated by cones between spheres along its axis. The spheres at the ends of curves count as well, so
anything closer to an open end than its radius counts as running through it. Meshes may run through curves
(``tube_crossings.py``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.device import launch
from warp_psdr.kernels.primitive.curves_overlap import FINER, find_overlaps, find_pierced
from warp_psdr.scene.kinds.bsplinecurve import coefficients
from warp_psdr.scene.kinds.curve import Curves, world_points
from warp_psdr.scene.kinds.sdfgrid import is_passed
from warp_psdr.topology.camera_view import CameraView, camera_view
from warp_psdr.topology.kinds.exact_shapes import pose, with_exact_shapes
from warp_psdr.topology.kinds.grid_silhouettes import grid_shapes, grid_values, is_smooth_grid
from warp_psdr.topology.kinds.tube_items import curve_shapes, follows
from warp_psdr.topology.unchanged import kept

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Boxes that are compared with others at once.
CHUNK = 512
#: Pairs of a triangle and a segment, or of cones, for which there is room at first.
ROOM = 4096


def pierced_tubes(scene: Scene, shapes: frozenset[int] | None) -> tuple[int, int] | None:
    """Return curves and a shape, neither mesh nor curves, that runs through them, one among ``shapes`` (None: any)."""
    corners, owners = (found[scene.face_count :] for found in with_exact_shapes(scene))
    for i in curve_shapes(scene):
        rows = np.arange(len(corners))
        if shapes is not None and i not in shapes:
            rows = rows[np.isin(owners, sorted(shapes))]
        pierced = pierced_segments(scene, i, corners[rows])
        if len(pierced):
            return i, int(owners[rows[pierced[-1, 0]]])
        grids = [j for j in grid_shapes(scene) if shapes is None or i in shapes or j in shapes]
        cones = cones_along(scene, i) if grids else np.zeros((0, 2, 4))
        for j in grids:
            if _meets_grid(scene, cones, j):
                return i, j
    return None


def pierced_segments(scene: Scene, shape: int, corners: np.ndarray, nearly: bool = False) -> np.ndarray:
    """Return (P, 2), sorted: which of the triangles (M, 3, 3) run through which segments of curves.

    ``nearly``: all that may, those that only touch included.
    """
    points = world_points(scene, shape)
    low, high = (points[:, :3] - points[:, 3:]).min(axis=0), (points[:, :3] + points[:, 3:]).max(axis=0)
    near = np.flatnonzero(((corners.min(axis=1) < high) & (corners.max(axis=1) > low)).all(axis=1))
    if not len(near):
        return np.zeros((0, 2), np.int64)
    record = scene.face_count + scene.builder.primitives.index(shape)
    triangles = wp.array(corners[near].astype(np.float32), dtype=wp.vec3, device=scene.device)
    count, room = wp.zeros(1, dtype=wp.int32, device=scene.device), ROOM
    while True:
        count.zero_()
        pairs = wp.zeros(room, dtype=wp.vec2i, device=scene.device)
        arguments = [scene.data(), record, triangles, int(nearly)]
        launch(find_pierced, len(near), arguments, [count, pairs], device=scene.device)
        needed = int(count.numpy()[0])
        if needed <= room:
            break
        room = needed
    found = np.unique(pairs.numpy()[:needed], axis=0).astype(np.int64)
    return np.stack([near[found[:, 0]], found[:, 1]], axis=1)


def overlapping(scene: Scene, shape: int, other: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where two shapes of curves, or one, run through each other; a row is a pair of cones.

    Straight segments that are joined do not count: their cones meet in a crease (``tube_items.py``).

    Returns:
        segments (N, 2), spheres (N, 4) around what cones have in common, and (N, 2): the length of the first one's axis
        in there, and the smaller radius.
    """
    curves = scene.geometry(shape)
    assert isinstance(curves, Curves)
    records = [scene.face_count + scene.builder.primitives.index(i) for i in (shape, other)]
    count, room = wp.zeros(1, dtype=wp.int32, device=scene.device), ROOM
    while True:
        count.zero_()
        out = [wp.zeros(room, dtype=t, device=scene.device) for t in (wp.vec2i, wp.vec4, wp.vec2)]
        launch(find_overlaps, len(curves.firsts), [scene.data(), *records], [count, *out], device=scene.device)
        needed = int(count.numpy()[0])
        if needed <= room:
            break
        room = needed
    pairs, places, lengths = (a.numpy()[:needed] for a in out)
    keep = np.ones(len(pairs), bool)
    if shape == other and not curves.cubic:
        keep = ~((pairs[:, 1] - pairs[:, 0] == 1) & follows(curves.firsts)[pairs[:, 0]])
    return pairs[keep].astype(np.int64), places[keep], lengths[keep].astype(np.float64)


def cones_along(scene: Scene, shape: int) -> np.ndarray:
    """Return cones (N, 2, 4) along curves."""
    curves = scene.geometry(shape)
    assert isinstance(curves, Curves)
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


def require_uncut_tubes(scene: Scene, sensor: int, shapes: list[int]) -> None:
    """Raise if a clip plane of a camera cuts curves.

    Raises:
        ValueError: the derivative of that border is in no term.
    """
    view = camera_view(scene, sensor)
    key = ("uncut tubes", view.numbers(), tuple(shapes))
    kept(scene, key, lambda: _require_uncut(scene, view, sensor, shapes))


def _require_uncut(scene: Scene, view: CameraView, sensor: int, shapes: list[int]) -> None:
    axis = np.linalg.inv(view.pose[:3, :3])[2]
    for i in shapes:
        cones = cones_along(scene, i)
        depth = view.depth(cones[..., :3])
        reach = cones[..., 3] * np.linalg.norm(axis)
        for plane in view.clip_depths():
            if (((depth - reach).min(axis=1) < plane) & ((depth + reach).max(axis=1) > plane)).any():
                raise ValueError(
                    f"a clip plane of sensor {sensor} cuts the curves {scene.description.shapes[i].path!r}, and the "
                    "derivative of that border is not estimated; change near_clip or far_clip, move the camera, or say "
                    "PathIntegrator(boundary=None) to get the interior term alone"
                )

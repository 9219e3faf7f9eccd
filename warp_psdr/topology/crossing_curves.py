"""Curves of intersection between shapes without triangles and triangles: chords, for ``boundary/crossing``.

In the coordinates of such a shape its surface is phi = 0. Triangles are cut in four until their sides are short for the
shape, and parts far from the surface are dropped. If the corners of a small triangle differ in the sign of phi, two of
its sides have a root, and the chord between the two stands for the curve. Sides that triangles share have equal roots,
so chords join. Loops within one small triangle are missed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.topology.crossing_fields import HALVINGS, Field, across_axis, exact_field, grid_field
from warp_psdr.topology.kinds.exact_shapes import TOUCHING, crossable_shapes, crossed_faces, least_distance, rim_points
from warp_psdr.topology.kinds.joined_rims import joined_rims

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Least sine of the angle between two surfaces that run through each other.
LEAST = 5.0e-3
#: How far beside a chord it has to be on both sides of a grid's surface, in voxels.
ASIDE = 0.1
#: Most small triangles at once.
MOST = 4_000_000
#: Radius of a small triangle of a curved surface, over that of its corners.
BULGE = 1.1
#: Points of a rim, and of a side of a triangle, of which no two neighbours may touch another surface: they would run
#: along it.
RIM_POINTS, SIDE_POINTS = 256, 33

#: Points of small triangles -> those of a curved surface.
Project = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Chords:
    """Chords of curves, N of them.

    Attributes:
        points: (N, 2, 3) both ends, in the world.
        faces: (N,) numbers of the triangles.
        spans: (N, 2) the part of the chord on which the surface has not ended.
        rows: (N,) which of the triangles that were cut.
    """

    points: np.ndarray
    faces: np.ndarray
    spans: np.ndarray
    rows: np.ndarray


def cut(field: Field, corners: np.ndarray, faces: np.ndarray, project: Project | None = None) -> Chords:
    """Return the chords of the curves on triangles (M, 3, 3), in the world, of the numbers ``faces`` (M,).

    ``project``: points (..., 3) of triangles, in the field's coordinates -> those of the surface that they stand for.
    """
    local = (corners - field.origin) @ np.linalg.inv(field.linear).T
    parts, owners = _small(field, local, project)
    a, b, owner = _roots(field, parts, owners, project)
    chords = np.stack([a, b], axis=1)
    spans = _spans(field, chords, owner)
    keep = (spans[:, 1] > spans[:, 0]) & (np.linalg.norm(b - a, axis=1) > 0.0)
    rows = owner[keep]
    return Chords(chords[keep] @ field.linear.T + field.origin, faces[rows], spans[keep], rows)


def _small(field: Field, local: np.ndarray, project: Project | None) -> tuple[np.ndarray, np.ndarray]:
    """Return small parts (K, 3, 3) of triangles, near the surface, and the numbers (K,) of their triangles."""
    most = field.sides(local)
    owners = np.arange(len(local))
    found, whose = [], []
    while len(local):
        middle = local.mean(axis=1)
        radius = np.linalg.norm(local - middle[:, None], axis=2).max(axis=1)
        keep = field.near(middle, radius if project is None else BULGE * radius, owners)
        local, owners = local[keep], owners[keep]
        longest = np.linalg.norm(local - np.roll(local, 1, axis=1), axis=2).max(axis=1, initial=0.0)
        done = longest <= most[owners]
        found.append(local[done])
        whose.append(owners[done])
        rest = local[~done]
        if 4 * len(rest) > MOST:
            raise ValueError(f"a curve of intersection has more than {MOST} pieces; move the two surfaces apart")
        p, q, r = rest[:, 0], rest[:, 1], rest[:, 2]
        pq, qr, rp = (m if project is None else project(m) for m in (0.5 * (p + q), 0.5 * (q + r), 0.5 * (r + p)))
        local = np.concatenate([np.stack(t, axis=1) for t in ((p, pq, rp), (pq, q, qr), (rp, qr, r), (pq, qr, rp))])
        owners = np.tile(owners[~done], 4)
    if not found:
        return np.zeros((0, 3, 3)), np.zeros(0, int)
    return np.concatenate(found), np.concatenate(whose)


def _roots(field: Field, parts: np.ndarray, owners: np.ndarray, project: Project | None) -> tuple[np.ndarray, ...]:
    """Return where the sides of small triangles meet the surface: one side's (N, 3), the other's, and the owners."""
    values = field.phi(parts.reshape(-1, 3), np.repeat(owners, 3)).reshape(-1, 3)
    inside = values < 0.0
    mixed = inside.any(axis=1) & ~inside.all(axis=1)
    parts, values, inside, owners = parts[mixed], values[mixed], inside[mixed], owners[mixed]
    lone = np.where(inside.sum(axis=1) == 1, inside.argmax(axis=1), (~inside).argmax(axis=1))
    rows = np.arange(len(parts))
    ends = []
    for step in (1, 2):
        p, q = parts[rows, lone], parts[rows, (lone + step) % 3]
        within = inside[rows, lone]
        # From the corner inside to the one outside, so that neighbours find the same.
        p, q = np.where(within[:, None], p, q), np.where(within[:, None], q, p)
        below, above = values[rows, lone], values[rows, (lone + step) % 3]
        below, above = np.where(within, below, above), np.where(within, above, below)
        low, high = np.zeros(len(p)), np.ones(len(p))
        for _ in range(field.steps):
            share = below / (below - above) if field.interpolates else 0.5
            t = low + share * (high - low)
            x = p + t[:, None] * (q - p)
            value = field.phi(x if project is None else project(x), owners)
            left = value < 0.0
            low, below = np.where(left, t, low), np.where(left, value, below)
            high, above = np.where(left, high, t), np.where(left, above, value)
        share = below / (below - above) if field.interpolates else 0.5
        x = p + (low + share * (high - low))[:, None] * (q - p)
        ends.append(x if project is None else project(x))
    return ends[0], ends[1], owners


def _spans(field: Field, chords: np.ndarray, owners: np.ndarray) -> np.ndarray:
    spans = np.tile([0.0, 1.0], (len(chords), 1))
    if field.ends is None or not len(chords):
        return spans
    a, b = field.ends(chords[:, 0], owners), field.ends(chords[:, 1], owners)
    spans[(a < 0.0) & (b < 0.0)] = 0.0
    rows = np.flatnonzero((a < 0.0) != (b < 0.0))
    low, high = np.zeros(len(rows)), np.ones(len(rows))
    first = a[rows] >= 0.0
    for _ in range(HALVINGS):
        t = 0.5 * (low + high)
        p = (1.0 - t)[:, None] * chords[rows, 0] + t[:, None] * chords[rows, 1]
        on = (field.ends(p, owners[rows]) >= 0.0) == first
        low, high = np.where(on, t, low), np.where(on, high, t)
    spans[rows[first], 1] = low[first]
    spans[rows[~first], 0] = high[~first]
    return spans


def pierced_faces(scene: Scene, shape: int, shapes: frozenset[int] | None) -> np.ndarray:
    """Return ``crossed_faces`` less those that a disk lies on which closes what stands on them."""
    rows = crossed_faces(scene, shape, shapes)
    below = [other for disk, other in joined_rims(scene).buried if disk == shape]
    return rows[~np.isin(scene.builder.face_shape[rows], below)]


def cut_grid(scene: Scene, shape: int, shapes: frozenset[int] | None) -> Chords:
    """Return the chords of the curves in which meshes run through a grid, one of both among ``shapes`` (None: any).

    What touches the surface has none: beside a chord a triangle has to be outside on one side, inside on the other.
    """
    corners = scene.points[scene.builder.indices].astype(np.float64)
    rows = np.arange(len(corners))
    if shapes is not None and shape not in shapes:
        rows = np.flatnonzero(np.isin(scene.builder.face_shape, sorted(shapes)))
    field, tolerance = grid_field(scene, shape)
    chords = cut(field, corners[rows], rows)
    inverse = np.linalg.inv(field.linear).T
    p = corners[chords.faces] @ inverse
    n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    ends = (chords.points - field.origin) @ inverse
    aside = np.cross(n, ends[:, 1] - ends[:, 0])
    aside *= ASIDE / np.maximum(np.linalg.norm(aside, axis=1), 1e-300)[:, None]
    middle = ends.mean(axis=1)
    one, other = field.phi(middle + aside), field.phi(middle - aside)
    keep = (np.minimum(one, other) < -tolerance) & (np.maximum(one, other) > tolerance)
    return Chords(chords.points[keep], chords.faces[keep], chords.spans[keep], chords.rows[keep])


def runs_along(field: Field, kind: str, ends: set[int], corners: np.ndarray) -> bool:
    """Whether a rim, of those at ``ends``, runs along one of some triangles (M, 3, 3), or a side along the shape."""
    if kind == "sphere" or not len(corners):
        return False
    local = (corners - field.origin) @ np.linalg.inv(field.linear).T
    for end in ends:
        touches = np.array([(least_distance(local - p) < TOUCHING).any() for p in rim_points(end, RIM_POINTS)])
        if (touches & np.roll(touches, 1)).any():
            return True
    # Sides, cut off at a box around the shape.
    a, b = local.reshape(-1, 3), np.roll(local, -1, axis=1).reshape(-1, 3)
    way = np.where(b == a, 1e-300, b - a)
    lower, upper = np.array([-1.1, -1.1, -0.1]), np.array([1.1, 1.1, 0.1 if kind == "disk" else 1.1])
    s, t = (lower - a) / way, (upper - a) / way
    first = np.clip(np.minimum(s, t).max(axis=1), 0.0, 1.0)
    last = np.clip(np.maximum(s, t).min(axis=1), 0.0, 1.0)
    rows = np.flatnonzero(last > first)
    u = first[rows, None] + (last - first)[rows, None] * np.linspace(0.0, 1.0, SIDE_POINTS)
    points = a[rows, None] + u[..., None] * (b - a)[rows, None]
    if kind == "disk":
        on = (np.abs(points[..., 2]) < TOUCHING) & (across_axis(points) < 1.0 + TOUCHING)
    else:
        on = (np.abs(across_axis(points) - 1.0) < TOUCHING) & (np.abs(points[..., 2] - 0.5) < 0.5 + TOUCHING)
    return bool((on[:, 1:] & on[:, :-1]).any())


def touched(scene: Scene, shapes: frozenset[int] | None) -> tuple[int, int] | None:
    """Return an exact shape and a mesh that touches it, one of them among ``shapes`` (None: any).

    They do where one runs along the other, or where no curve is found at more than a small angle. What touches a sphere
    in a point, and cylinders that stand on a mesh, closed ones or not, are left out.
    """
    b, joined = scene.builder, joined_rims(scene)
    corners = scene.points[b.indices].astype(np.float64)
    for i in crossable_shapes(scene):
        hit = pierced_faces(scene, i, shapes)
        field, kind = exact_field(scene, i), scene.geometry(i).name
        for j in np.unique(b.face_shape[hit]):
            rows = hit[b.face_shape[hit] == j]
            chords = cut(field, corners[rows], rows)
            ends = {0} if kind == "disk" else {0, 1} - joined.standing(i, int(j))
            if (
                not len(chords.faces)
                or runs_along(field, kind, ends, corners[rows])
                or _slant(field, chords, corners) < LEAST
            ):
                return i, int(j)
    return None


def _slant(field: Field, chords: Chords, corners: np.ndarray) -> float:
    """Return the least sine of the angle between the two surfaces at the middles of chords."""
    inverse = np.linalg.inv(field.linear)
    q = (chords.points.mean(axis=1) - field.origin) @ inverse.T
    step = 1.0e-6
    slope = np.stack([field.phi(q + step * e) - field.phi(q - step * e) for e in np.eye(3)], axis=1) @ inverse
    p = corners[chords.faces]
    n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    sine = np.linalg.norm(np.cross(slope, n), axis=1)
    return float((sine / (np.linalg.norm(slope, axis=1) * np.linalg.norm(n, axis=1))).min(initial=1.0))

"""Rims of exact shapes that are no open edges: disks that close cylinders, and cylinders that stand on a surface.

If a disk's rim and a cylinder's coincide, they are one edge of two surfaces, the disk's. If a cylinder's rim lies in a
flat surface that continues on both sides, the rim is no edge: the two surfaces meet in a curve of intersection, as if
the cylinder went on through the other; a disk between the two is not seen. Both hold for motions that keep together
what joins.

Derivation: ``docs/theory/implicit.md#rims-that-join``.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.topology.kinds.exact_shapes import exact_shapes, least_distance, pose, rim_points

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Distance, in ray epsilons, within which rims coincide or lie in a surface: rounding of float32 poses.
ROUNDING_EPSILONS = 0.2
#: Points of a rim, and how much wider and narrower circles are on which a surface goes on beside it.
RIM_POINTS, BESIDE = 64, 1.0e-3
#: Velocity of one rim against what it joins, as a fraction of the largest of both, that counts as zero.
RESTING = 1.0e-4


@dataclass(frozen=True)
class JoinedRims:
    """Rims that join, by numbers of shapes; an end of a cylinder is 0 or 1.

    Attributes:
        caps: (disk, cylinder, end) whose rims coincide.
        stands: (cylinder, end, shape): the rim lies in a flat surface, of a mesh or a disk.
        buried: (disk, shape): it closes a cylinder below, which stands on that shape and is closed above, too.
        bared: the same of a cylinder that is open above, in which disk and shape are in one place.
    """

    caps: tuple[tuple[int, int, int], ...] = ()
    stands: tuple[tuple[int, int, int], ...] = ()
    buried: tuple[tuple[int, int], ...] = ()
    bared: tuple[tuple[int, int], ...] = ()

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """The shapes that join."""
        return [(a, b) for a, b, _end in self.caps] + [(a, b) for a, _end, b in self.stands]

    def closed(self, shape: int) -> set[int]:
        """Return the ends of a cylinder whose rims are no edges of their own."""
        return {e for _d, c, e in self.caps if c == shape} | {e for c, e, _other in self.stands if c == shape}

    def standing(self, shape: int, on: int | None = None) -> set[int]:
        """Return the ends on which a cylinder stands, on one shape (None: on any)."""
        return {e for c, e, other in self.stands if c == shape and on in (None, other)}


def rim(scene: Scene, shape: int, end: int = 0, widened: float = 1.0) -> np.ndarray:
    """Return points (N, 3), in the world, of a rim of a disk or a cylinder."""
    linear, origin = pose(scene, shape)
    return rim_points(end, RIM_POINTS, widened) @ linear.T + origin


def joined_rims(scene: Scene) -> JoinedRims:
    """Return the rims of a scene that join, as its shapes stand; kept until one of them moves."""
    kind = {i: scene.geometry(i).name for i in exact_shapes(scene)}
    cylinders = [i for i in kind if kind[i] == "cylinder"]
    disks = [i for i in kind if kind[i] == "disk"]
    if not cylinders:
        return JoinedRims()
    poses = np.array([np.column_stack(pose(scene, i)) for i in cylinders + disks])
    kept = getattr(scene, "_joined_rims", None)
    if kept is None or not (np.array_equal(kept[0], poses) and np.array_equal(kept[1], scene.points)):
        kept = (poses, scene.points.copy(), _found(scene, cylinders, disks))
        scene._joined_rims = kept  # type: ignore[attr-defined]
    return kept[2]


def _found(scene: Scene, cylinders: list[int], disks: list[int]) -> JoinedRims:
    tolerance = scene.steps.scene or ROUNDING_EPSILONS * scene.ray_epsilon
    caps = [(d, c, e) for d in disks for c in cylinders for e in (0, 1) if _coincide(scene, d, c, e, tolerance)]
    stands = []
    for c in cylinders:
        for e in (0, 1):
            circles = np.concatenate([rim(scene, c, e, s) for s in (1.0, 1.0 + BESIDE, 1.0 - BESIDE)])
            stands += [(c, e, d) for d in disks if _on_disk(scene, d, circles, tolerance)]
            stands += [(c, e, m) for m in _meshes_below(scene, circles, tolerance)]
    both = {c for _d, c, e in caps if any((c, 1 - e) == cap[1:] for cap in caps)}
    below = [(d, other, c in both) for d, c, e in caps for b, f, other in stands if (c, e) == (b, f)]
    buried, bared = (tuple((d, other) for d, other, closed in below if closed == wanted) for wanted in (True, False))
    return JoinedRims(tuple(caps), tuple(stands), buried, bared)


def _coincide(scene: Scene, disk: int, cylinder: int, end: int, tolerance: float) -> bool:
    linear, origin = pose(scene, cylinder)
    q = (rim(scene, disk) - origin) @ np.linalg.inv(linear).T
    r = np.maximum(np.hypot(q[:, 0], q[:, 1]), 1e-300)
    off = q - np.stack([q[:, 0] / r, q[:, 1] / r, np.full(len(q), float(end))], axis=1)
    return bool(np.linalg.norm(off @ linear.T, axis=1).max() <= tolerance)


def _on_disk(scene: Scene, disk: int, points: np.ndarray, tolerance: float) -> bool:
    linear, origin = pose(scene, disk)
    n = np.cross(linear[:, 0], linear[:, 1])
    if np.abs((points - origin) @ n).max() > tolerance * np.linalg.norm(n):
        return False
    q = (points - origin) @ np.linalg.inv(linear).T
    return bool(np.hypot(q[:, 0], q[:, 1]).max() <= 1.0)


def _meshes_below(scene: Scene, points: np.ndarray, tolerance: float) -> list[int]:
    """Return the meshes whose surface holds all of some points (N, 3)."""
    corners = scene.points[scene.builder.indices]
    near = (corners.min(axis=1, initial=np.inf) <= points.max(axis=0) + tolerance).all(axis=1)
    rows = np.flatnonzero(near & (corners.max(axis=1, initial=-np.inf) >= points.min(axis=0) - tolerance).all(axis=1))
    parts = np.split(points, np.arange(RIM_POINTS, len(points), RIM_POINTS))
    found = []
    for m in np.unique(scene.builder.face_shape[rows]):
        p = corners[rows[scene.builder.face_shape[rows] == m]].astype(np.float64)
        if all((least_distance(p - x) <= tolerance).any() for x in points[:: RIM_POINTS // 4]):
            apart = [least_distance((p[None] - c[:, None, None]).reshape(-1, 3, 3)).reshape(len(c), -1) for c in parts]
            if (np.concatenate(apart).min(axis=1) <= tolerance).all():
                found.append(int(m))
    return found


def outlines(scene: Scene, shapes: frozenset[int] | None) -> list[tuple[int, tuple[int, int], int]]:
    """Return the outlines of some exact shapes (None: of all), each as the members of an ``OutlineItem``."""
    joined = joined_rims(scene)
    record = {i: scene.face_count + k for k, i in enumerate(scene.builder.primitives)}
    found = []
    for i, face in record.items():
        if shapes is not None and i not in shapes:
            continue
        affine = scene.geometry(i).device.affine
        if affine is None:
            continue
        if affine.outline is not None:
            ends = {e: record[d] for d, c, e in joined.caps if c == i}
            found.append((face, (ends.get(0, -1), ends.get(1, -1)), -1))
        closed = joined.closed(i) if scene.geometry(i).name == "cylinder" else set()
        if affine.rim is not None and len(closed) < 2 and i not in dict(joined.buried):
            neighbour = next((record[c] for d, c, _end in joined.caps if d == i), -1)
            found.append((-1 - face, (neighbour, -1), next(iter(closed), -1)))
    return found


def warn(scene: Scene, tangents: np.ndarray) -> None:
    """Warn (RuntimeWarning) about motions that part what joins at a rim.

    Args:
        scene: the scene.
        tangents: flat, laid out like the scene's values: velocities of poses and vertices.
    """
    joined = joined_rims(scene)
    named = [(c, e, d, True) for d, c, e in joined.caps] + [(c, e, b, False) for c, e, b in joined.stands]
    for cylinder, end, other, closes in named:
        x = rim(scene, cylinder, end)
        v, rest = _velocity(scene, tangents, cylinder, x), _velocity(scene, tangents, other, x)
        normal = np.cross(x[RIM_POINTS // 4] - x[0], x[RIM_POINTS // 2] - x[0])
        along = np.roll(x, -1, axis=0) - np.roll(x, 1, axis=0)
        along /= np.linalg.norm(along, axis=1)[:, None]
        apart = v - rest
        if closes:
            apart = np.linalg.norm(apart - (apart * along).sum(axis=1)[:, None] * along, axis=1)
            returned = "what is returned there is neither of them"
        else:
            apart = np.abs(apart @ normal) / np.linalg.norm(normal)
            returned = "what is returned there is that of sinking in"
        if apart.max() > RESTING * np.linalg.norm(np.concatenate([v, rest]), axis=1).max():
            paths = [scene.description.shapes[i].path for i in (cylinder, other)]
            warnings.warn(
                f"{paths[0]!r} and {paths[1]!r} join at a rim, and the tangent parts them: the image has two one-sided "
                f"derivatives there, and {returned}. Move them together, or leave a gap",
                RuntimeWarning,
                stacklevel=4,
            )


def _velocity(scene: Scene, tangents: np.ndarray, shape: int, points: np.ndarray) -> np.ndarray:
    """Return the velocities (N, 3) of the material points of a shape at points (N, 3) of it."""
    if shape in scene.builder.primitives:
        offset = scene.poses.offsets(shape)[0]
        linear, origin = pose(scene, shape)
        rate = tangents[offset : offset + 16].reshape(4, 4).astype(np.float64)
        return (points - origin) @ np.linalg.inv(linear).T @ rate[:3, :3].T + rate[:3, 3]
    faces = scene.builder.indices[scene.builder.face_shape == shape]
    corners = scene.points[faces].astype(np.float64)
    rates = tangents[scene.positions : scene.positions + 3 * scene.vertex_count].reshape(-1, 3)[faces]
    found = []
    for x in points:
        k = int(np.argmin(least_distance(corners - x)))
        shares = np.linalg.lstsq(np.vstack([corners[k].T, np.ones(3)]), np.append(x, 1.0))[0]
        found.append(shares @ rates[k].astype(np.float64))
    return np.array(found)

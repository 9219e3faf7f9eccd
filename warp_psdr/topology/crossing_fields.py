"""Shapes without triangles as fields phi, for the search of curves of intersection in ``crossing_curves.py``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.scene.kinds.sdfgrid import is_passed
from warp_psdr.topology.grid_contacts import TOUCHING as TOUCHING_GRID
from warp_psdr.topology.grid_contacts import interpolated, spline_interpolated
from warp_psdr.topology.kinds.exact_shapes import TOUCHING, pose
from warp_psdr.topology.kinds.grid_silhouettes import grid_values, is_smooth_grid
from warp_psdr.topology.kinds.joined_rims import joined_rims

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Longest side of a small triangle, over the radius of an exact shape, and over that of the circle that a plane cuts
#: out of a sphere.
FINE, OF_CIRCLE = 0.04, 0.2
#: How far a cylinder goes on below what it stands on, over its length.
OVERLAP = 1.0e-3
#: Bisections of a root.
HALVINGS = 44
#: ``FINE`` of grids, over a voxel; and points that are looked at at once.
OF_VOXEL, CHUNK = 0.3, 32768


@dataclass(frozen=True)
class Field:
    """A shape without triangles, in its own coordinates.

    Functions of points are given the numbers (N,) of the triangles that these are of as well, for what only one part
    of the shape is meant by.

    Attributes:
        phi: points (N, 3) -> (N,), negative on one side.
        near: centres (N, 3) and radii (N,) of balls -> whether the surface may pass them.
        ends: points (N, 3) -> (N,), negative where the surface has ended; None: it has no ends.
        sides: triangles (M, 3, 3) -> (M,), the longest side of their parts.
        linear: (3, 3), to the world.
        origin: (3,).
        steps: to a root, bisections or, where the field ``interpolates``, those of false position.
        interpolates: phi is about linear on a small triangle, and dear.
    """

    phi: Callable[..., np.ndarray]
    near: Callable[..., np.ndarray]
    ends: Callable[..., np.ndarray] | None
    sides: Callable[[np.ndarray], np.ndarray]
    linear: np.ndarray
    origin: np.ndarray
    steps: int = HALVINGS
    interpolates: bool = False


def exact_field(scene: Scene, shape: int) -> Field:
    """Return an exact shape as a field."""
    kind = scene.geometry(shape).name
    phi, near, ends, sides = EXACT_FIELDS[kind]
    standing = joined_rims(scene).standing(shape)
    if standing:
        # As if it went on below what it stands on.
        low, high = (OVERLAP * (e in standing) for e in (0, 1))
        ends = lambda q, _rows=None: (q[..., 2] + low) * (1.0 + high - q[..., 2])  # noqa: E731
    return Field(phi, near, ends, sides, *pose(scene, shape))


def across_axis(q: np.ndarray) -> np.ndarray:
    """Return the distances (...) of points (..., 3) from the z axis."""
    return np.hypot(q[..., 0], q[..., 1])


def _sphere_sides(local: np.ndarray) -> np.ndarray:
    n = np.cross(local[:, 1] - local[:, 0], local[:, 2] - local[:, 0])
    height = np.abs((n * local[:, 0]).sum(axis=1)) / np.maximum(np.linalg.norm(n, axis=1), 1e-300)
    circle = np.sqrt(np.maximum(1.0 - height * height, TOUCHING))
    return np.minimum(FINE, OF_CIRCLE * circle)


def _even_sides(local: np.ndarray) -> np.ndarray:
    return np.full(len(local), FINE)


#: Kind -> phi, near, ends, sides of its ``Field``.
EXACT_FIELDS: dict[str, tuple] = {
    "sphere": (
        lambda q, _rows=None: (q * q).sum(axis=-1) - 1.0,
        lambda c, r, _rows=None: np.abs(np.linalg.norm(c, axis=1) - 1.0) <= r,
        None,
        _sphere_sides,
    ),
    "cylinder": (
        lambda q, _rows=None: across_axis(q) ** 2 - 1.0,
        lambda c, r, _rows=None: (np.abs(across_axis(c) - 1.0) <= r) & (np.abs(c[:, 2] - 0.5) <= 0.5 + r),
        lambda q, _rows=None: q[..., 2] * (1.0 - q[..., 2]),
        _even_sides,
    ),
    "disk": (
        lambda q, _rows=None: q[..., 2],
        lambda c, r, _rows=None: (np.abs(c[:, 2]) <= r) & (across_axis(c) <= 1.0 + r),
        lambda q, _rows=None: 1.0 - across_axis(q) ** 2,
        _even_sides,
    ),
}


def grid_field(scene: Scene, shape: int) -> tuple[Field, float]:
    """Return a grid as a field, in voxels, and the value up to which a point is on its surface."""
    values, cubic = grid_values(scene, shape), is_smooth_grid(scene, shape)
    linear, origin = pose(scene, shape)
    cells = np.array(values.shape[::-1]) - 1
    most = float(np.abs(values).max())
    # How many voxels that the surface passes lie in front of a node, along all axes.
    passed = np.pad(is_passed(values, cubic).astype(np.int64), ((1, 0),) * 3).cumsum(0).cumsum(1).cumsum(2)
    of = spline_interpolated if cubic else interpolated

    def phi(p: np.ndarray, _rows: np.ndarray | None = None) -> np.ndarray:
        parts = [of(values, p[k : k + CHUNK]) for k in range(0, len(p), CHUNK)]
        inside = ((p >= 0.0) & (p <= cells)).all(axis=-1)
        return np.where(inside, np.concatenate(parts), most) if parts else np.zeros(0)

    def near(center: np.ndarray, radius: np.ndarray, _rows: np.ndarray) -> np.ndarray:
        low = np.clip(np.floor(center - radius[:, None]), 0, cells).astype(int)
        high = np.clip(np.ceil(center + radius[:, None]), 0, cells).astype(int)
        count = np.zeros(len(center), np.int64)
        for corner in np.ndindex(2, 2, 2):
            at = np.where(corner, high, low)
            sign = 1 if sum(corner) % 2 else -1
            count += sign * passed[at[:, 2], at[:, 1], at[:, 0]]
        return count > 0

    def sides(local: np.ndarray) -> np.ndarray:
        return np.full(len(local), OF_VOXEL)

    return Field(phi, near, None, sides, linear / cells, origin), TOUCHING_GRID * most

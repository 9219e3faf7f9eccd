"""The origin of the device's coordinates: the world's origin, or a point near a scene that is far away from it.

The device holds x - o in float32. If a scene lies far away from the world's origin, o is near its centre and is
subtracted in float64 on load. Parameters stay in world coordinates, and so do their gradients and tangents.

Derivation: ``docs/theory/numerics.md#origins-near-the-scene``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warp_psdr.scene.description import ShapeDescription

#: Distance of the centre, in radii along an axis, beyond which a scene is far away: three bits of 24 are lost there.
FAR = 8.0
#: The same for one shape, beyond which its triangles are judged before they are rounded to float32.
COLLAPSING = 1.0e3


def find_origin(shapes: Iterable[ShapeDescription]) -> np.ndarray:
    """Return the point, (3,) float64, to subtract from all positions of a scene; zeros unless it is far away."""
    boxes = [(s.vertices.min(axis=0), s.vertices.max(axis=0)) for s in shapes]
    if not boxes:
        return np.zeros(3)
    low = np.min([b[0] for b in boxes], axis=0).astype(np.float64)
    high = np.max([b[1] for b in boxes], axis=0).astype(np.float64)
    center, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    # At the largest distances a scene that was rounded to float32 may look like a point.
    radius = max(radius, float(np.spacing(np.float32(max(np.abs(low).max(), np.abs(high).max())))))
    step = 2.0 ** np.floor(np.log2(radius))
    return np.where(np.abs(center) > FAR * radius, np.round(center / step) * step, 0.0)


def collapses(points: np.ndarray) -> bool:
    """Return whether float32 would distort the triangles between points (N, 3): they are far away for their size."""
    radius = 0.5 * float(np.linalg.norm(np.ptp(points, axis=0)))
    return bool(np.abs(points).max() > COLLAPSING * radius)


def moved(matrix: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return a transformation to world space, (4, 4), as one to the device's coordinates."""
    matrix = np.array(matrix, dtype=np.float64)
    matrix[:3, 3] -= origin
    return matrix


def shift_of(shape: tuple[int, ...], origin: np.ndarray) -> np.ndarray:
    """Return what is to be added to the stored numbers of a position, (3,) or (N, 3), or of a (4, 4) matrix; flat."""
    if shape == (4, 4):
        matrix = np.zeros((4, 4))
        matrix[:3, 3] = origin
        return matrix.reshape(-1)
    return np.broadcast_to(origin, shape).reshape(-1)


def to_world(stored: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return stored numbers, flat, as float32 world coordinates."""
    return (stored.astype(np.float64) + shift).astype(np.float32)


def from_world(world: np.ndarray, stored: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers to store, float32, for world coordinates, and a mask of those that differ from what is stored.

    Args:
        world: flat, float32 or float64.
        stored: flat, float32: kept where the world coordinates say the same to float32.
        shift: see ``shift_of``.
    """
    if world.dtype == np.float64:
        changed = (world - shift).astype(np.float32)
        return changed, changed != stored
    edited = world != to_world(stored, shift)
    return np.where(edited, (world.astype(np.float64) - shift).astype(np.float32), stored), edited

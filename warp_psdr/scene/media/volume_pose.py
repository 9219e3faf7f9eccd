"""Poses of volume textures and of grids of media: a pose M (``to_world``), and W = M^-1, by which kernels read them.

The derivative of W is -W dM W, so an adjoint A of W is -W^T A W^T of M.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.scene.transforms import singular

if TYPE_CHECKING:
    from warp_psdr.scene.description import ShapeDescription
    from warp_psdr.scene.scene import Scene

#: Floats of M, and of the three rows of W that are kept behind it.
POSE, INVERSE = 16, 12
#: Side of the box around all that rays meet, in diameters of the scene: what moves by edits stays in it, and a medium
#: that nothing bounds is thick or not seen through where it ends.
AROUND = 1000.0


@dataclass(frozen=True)
class VolumePose:
    """Where the pose of a volume is; its inverse follows it."""

    parameter: str
    offset: int  #: flat, of M

    @property
    def inverse(self) -> int:
        """Flat offset of W."""
        return self.offset + POSE

    def rebuild(self, values: wp.array, held: np.ndarray) -> None:
        """Write the inverse of the pose that is held, flat, on the host.

        Raises:
            ValueError: there is none.
        """
        pose = held[self.offset : self.offset + POSE].reshape(4, 4)
        reason = singular(pose)
        if reason:
            raise ValueError(f"{self.parameter}: {reason}; restore a pose that has one")
        values[self.inverse : self.inverse + INVERSE].assign(inverse_of(pose).reshape(-1))


def inverse_of(pose: np.ndarray) -> np.ndarray:
    """Return the three rows of the inverse of a pose (4, 4), (3, 4) float32."""
    return np.linalg.inv(pose.astype(np.float64))[:3].astype(np.float32)


def box_around(shapes: Sequence[ShapeDescription]) -> np.ndarray:
    """Return the (4, 4) from the unit cube to a box that is far larger than a scene, with the scene in its middle."""
    low, high = _ends(shapes)
    side = AROUND * (extent_of(shapes) or 1.0)
    box = np.diag([side, side, side, 1.0])
    box[:3, 3] = 0.5 * (low + high) - 0.5 * side
    return box


def extent_of(shapes: Sequence[ShapeDescription]) -> float:
    """Return the diagonal of a box that holds all shapes."""
    low, high = _ends(shapes)
    return float(np.linalg.norm(high - low))


def _ends(shapes: Sequence[ShapeDescription]) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([s.vertices for s in shapes] or [np.zeros((1, 3))]).astype(np.float64)
    return points.min(axis=0), points.max(axis=0)


def pull_poses(scene: Scene, names: list[str], grad: wp.array) -> None:
    """Add the gradients of poses that arrive through their inverses; ``grad``: flat, in place."""
    for p in of(scene, names):
        w = _square(scene.values, p.inverse)
        a = _square(grad, p.inverse)
        a[3] = 0.0
        pulled = grad[p.offset : p.offset + POSE].numpy() - (w.T @ a @ w.T).reshape(-1)
        grad[p.offset : p.offset + POSE].assign(pulled.astype(np.float32))


def push_poses(scene: Scene, names: list[str], tangent: wp.array) -> None:
    """Add the tangents of the inverses of the named poses; ``tangent``: flat, in place."""
    for p in of(scene, names):
        w = _square(scene.values, p.inverse)
        d = tangent[p.offset : p.offset + POSE].numpy().astype(np.float64).reshape(4, 4)
        pushed = tangent[p.inverse : p.inverse + INVERSE].numpy() - (w @ d @ w)[:3].reshape(-1)
        tangent[p.inverse : p.inverse + INVERSE].assign(pushed.astype(np.float32))


def of(scene: Scene, names: list[str]) -> list[VolumePose]:
    """Return the poses of volumes among the named parameters."""
    return [p for p in scene.builder.volume_poses if p.parameter in names]


def _square(flat: wp.array, offset: int) -> np.ndarray:
    """Return three rows that are held, with the fourth of a pose, (4, 4) float64."""
    rows = flat[offset : offset + INVERSE].numpy().astype(np.float64).reshape(3, 4)
    return np.vstack([rows, [0.0, 0.0, 0.0, 1.0]])

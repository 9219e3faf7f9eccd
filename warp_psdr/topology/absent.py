"""Interfaces of media (Mitsuba's ``null``), which hide nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels.bsdf.null import NULL
from warp_psdr.scene.materials.bsdfs import model_of

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


def absent_shapes(scene: Scene) -> np.ndarray:
    """Return which shapes are surfaces that are not there, (S,) bool."""
    return np.array([all(model_of(side) is NULL for side in s.bsdf.sides) for s in scene.description.shapes], bool)


def absent_faces(scene: Scene) -> np.ndarray:
    """Return a mask of their triangles."""
    return absent_shapes(scene)[scene.builder.face_shape]


def there(scene: Scene, shapes: list[int]) -> list[int]:
    """Return those of some shapes that are surfaces which are there; without media, all of them."""
    absent = absent_shapes(scene) if scene.builder.media else np.zeros(len(scene.description.shapes), bool)
    return [i for i in shapes if not absent[i]]

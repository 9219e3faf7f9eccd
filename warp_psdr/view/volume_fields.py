"""Gradients by the coefficients of media as signed fields: on the shapes that bound them, and of voxels on planes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from warp_psdr.plots import Reduce, to_signed
from warp_psdr.scene.description import MediumDescription, ShapeDescription, VolumeDescription
from warp_psdr.view.fields import Field, mesh_field

#: Where the planes across the axes of a grid's unit cube are.
MIDDLE = 0.5


def volumes_of(shape: ShapeDescription) -> Iterator[VolumeDescription]:
    """Yield the coefficients of the media that a shape bounds, each once."""
    media: list[MediumDescription] = [m for m in (shape.interior, shape.exterior) if m is not None]
    for medium in dict.fromkeys(media):
        for volume in (medium.sigma_t, medium.albedo, medium.emission, medium.phase.weight):
            if volume is not None:
                yield volume


def volume_field(
    volume: VolumeDescription, values: np.ndarray, to_world: np.ndarray, *, reduce: Reduce = "mean"
) -> Field:
    """Make a field of voxels: their sums along each axis, on planes across it through the middle of the box.

    Args:
        volume: A grid.
        values: Its voxels, (Z, Y, X, C).
        to_world: (4, 4), of its unit cube.
        reduce: How colours become one value.
    """
    voxels = to_signed(values.reshape(-1, values.shape[3]), reduce=reduce).reshape(values.shape[:3])
    vertices, faces, sums, count = [], [], [], 0
    for axis in range(3):
        plane = voxels.sum(axis=2 - axis)
        # Of x, y, z those that span the plane, the one that varies slowest in ``plane`` first.
        slow, fast = (k for k in (2, 1, 0) if k != axis)
        rows, columns = plane.shape
        v, u = np.meshgrid(np.linspace(0.0, 1.0, rows + 1), np.linspace(0.0, 1.0, columns + 1), indexing="ij")
        points = np.full((v.size, 3), MIDDLE)
        points[:, slow], points[:, fast] = v.reshape(-1), u.reshape(-1)
        first = count + (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1)
        corners = np.stack([first, first + 1, first + columns + 2, first + columns + 1], axis=1)
        vertices.append(points @ to_world[:3, :3].T + to_world[:3, 3])
        faces.append(corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3))
        sums.append(np.repeat(plane.reshape(-1), 2))
        count += len(points)
    field = mesh_field(np.concatenate(vertices), np.concatenate(faces), np.concatenate(sums), on="face")
    return replace(field, quantity="summed along each axis")

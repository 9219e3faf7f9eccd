"""Where the interpolated normals of a grid of signed distances may turn away from an eye that the surface faces.

The normal of a point is a positive sum of those of eight voxels, each made of one of two slopes along each axis. The
differences of values along the rows next to a voxel bound these slopes. Interval arithmetic then bounds n . (eye - x).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels.boundary.silhouette.grid_points import GridItems
from warp_psdr.scene.kinds.sdfgrid import SdfGrid, is_passed
from warp_psdr.topology.kinds.exact_shapes import pose
from warp_psdr.topology.kinds.grid_silhouettes import (
    VOXEL,
    Eyes,
    gathered,
    grid_shapes,
    grid_values,
    interval_product,
    item_numbers,
    may_vanish,
)

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


def interpolated_grids(scene: Scene) -> list[int]:
    """Return the numbers of the shapes that are grids with interpolated normals."""
    found = [(i, scene.geometry(i)) for i in grid_shapes(scene, False)]
    return [i for i, grid in found if isinstance(grid, SdfGrid) and grid.smooth]


def may_turn(values: np.ndarray, nodes: np.ndarray, low: np.ndarray, high: np.ndarray, distant: bool) -> np.ndarray:
    """Return in which voxels the interpolated normal may be perpendicular to what some eye of a box sees them along.

    Args:
        values: (Z, Y, X).
        nodes: (N,) numbers of the voxels' first nodes.
        low: (3,) least coordinates x, y, z of the eyes, in voxels.
        high: the greatest ones.
        distant: the eyes are directions.
    """
    nz, ny, nx = values.shape
    sizes, stride, flat = (nx, ny, nz), (1, nx, nx * ny), values.reshape(-1)
    place = np.stack([nodes % nx, nodes // nx % ny, nodes // (nx * ny)], axis=1)
    away = [low, high] if distant else [place - high, place + 1.0 - low]
    terms = []
    for axis in range(3):
        # Three slabs of voxels, without those outside of the grid, and the four rows around the voxel.
        slopes = []
        for slab in (-1, 0, 1):
            at = np.clip(place[:, axis] + slab, 0, sizes[axis] - 2) - place[:, axis]
            for row in range(4):
                others = [k for k in range(3) if k != axis]
                first = nodes + at * stride[axis] + (row & 1) * stride[others[0]] + (row >> 1) * stride[others[1]]
                slopes.append(flat[first + stride[axis]] - flat[first])
        bounds = [np.min(slopes, axis=0), np.max(slopes, axis=0)]
        terms.append(interval_product(bounds, [end[..., axis] for end in away]))
    return may_vanish(terms)


def turned_items(scene: Scene, shapes: list[int], eyes: Eyes | None) -> GridItems | None:
    """Return the voxels that the surfaces of some of ``interpolated_grids`` pass; None: there are none.

    ``eyes``: those alone in which the normal may turn away from one of them.
    """
    listed = []
    for shape in shapes:
        values = grid_values(scene, shape)
        nodes = item_numbers(is_passed(values), values.shape)
        if eyes is not None:
            linear, origin = pose(scene, shape)
            cells = np.array(values.shape[::-1]) - 1.0
            local = (eyes.corners if eyes.distant else eyes.corners - origin) @ np.linalg.inv(linear).T * cells
            nodes = nodes[may_turn(values, nodes, local.min(axis=0), local.max(axis=0), eyes.distant)]
        listed.append((shape, 4 * nodes + VOXEL, np.ones(len(nodes), bool)))
    return gathered(scene, listed)

"""Where segments can touch a network: the cells that its surface may pass, and those whose silhouette an eye may see.

From an eye the silhouette lies where Psi = grad phi . (x - eye) is zero. The bound of the second derivatives in an
eighth of a cell bounds how fast Psi changes there, so the value of Psi in the middle decides. Cells that are left out
have no silhouette.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels.boundary.silhouette.grid_points import GridItems
from warp_psdr.scene.kinds.network_bounds import OFFSETS, bounds_of, in_parts, single
from warp_psdr.scene.kinds.neuralsdf import Network, network_and_cells
from warp_psdr.topology.kinds.exact_shapes import pose
from warp_psdr.topology.kinds.grid_silhouettes import VOXEL, Eyes, copied, gathered, named
from warp_psdr.topology.unchanged import kept

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Rounding of bounds, over their size, and squares along a side of a cell at which its surface is looked for.
ROUNDING, SQUARES = 1.0e-5, 4


def network_shapes(scene: Scene) -> list[int]:
    """Return the numbers of the shapes that are networks."""
    return [i for i in scene.builder.primitives if isinstance(scene.geometry(i), Network)]


def passed_cells(cells: np.ndarray) -> np.ndarray:
    """Return the cells (N, 3), by x, y, z, that the surface may pass."""
    return np.argwhere(cells <= 0.0)[:, ::-1]


def eighths(network: Network, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the middles (M, 3) of the eighths of cells (N, 3), the numbers of their cells, and half their size."""
    half = 0.25 / network.count
    middles = ((at + 0.5) / network.count)[:, None] + half * OFFSETS
    owners = np.repeat(np.arange(len(at)), 8)
    return middles.reshape(-1, 3), owners, half


def seen_cells(network: Network, at: np.ndarray, low: np.ndarray, high: np.ndarray, distant: bool) -> np.ndarray:
    """Return which cells (N, 3) may hold a silhouette from some eye of a box from low to high (3,), in [0, 1]^3."""
    middles, owners, half = eighths(network, at)
    found = in_parts(single(network), middles.astype(np.float32), np.full(3, half, np.float32))
    gradient = found.gradient.astype(np.float64)
    reach = np.sqrt(3.0) * half
    away = 0.5 * (low + high) if distant else middles - 0.5 * (low + high)
    spread = 0.5 * (high - low)
    psi = (gradient * away).sum(axis=1)
    length = np.linalg.norm(np.broadcast_to(away, middles.shape), axis=1) + np.linalg.norm(spread)
    slope = np.linalg.norm(gradient, axis=1)
    off = (np.abs(gradient) * spread).sum(axis=1) + reach * found.bend * (length + (0.0 if distant else reach))
    if not distant:
        off += reach * (slope + reach * found.bend)
    shown = found.passed & (np.abs(psi) <= off + ROUNDING * slope * length)
    seen = np.zeros(len(at), bool)
    seen[owners[shown]] = True
    return seen


def network_items(scene: Scene, shapes: list[int], eyes: list[Eyes] | None) -> GridItems | None:
    """Return the items of some networks, as ``grid_silhouettes.grid_items``."""
    key = ("network items", tuple(shapes), named(eyes))
    return copied(kept(scene, key, lambda: _network_items(scene, shapes, eyes)))


def _network_items(scene: Scene, shapes: list[int], eyes: list[Eyes] | None) -> GridItems | None:
    listed = []
    for shape in shapes:
        network, cells = network_and_cells(scene, shape)
        at = passed_cells(cells)
        nodes = network.count + 1
        numbers = 4 * (at[:, 0] + nodes * (at[:, 1] + nodes * at[:, 2])) + VOXEL
        seen = np.full(len(at), eyes is None)
        linear, origin = pose(scene, shape)
        for e in eyes or []:
            local = (e.corners if e.distant else e.corners - origin) @ np.linalg.inv(linear).T
            seen[~seen] = seen_cells(network, at[~seen], local.min(axis=0), local.max(axis=0), e.distant)
        listed.append((shape, numbers, seen))
    return gathered(scene, listed)


def is_open_network(network: Network, cells: np.ndarray) -> bool:
    """Return whether the surface may end at a face of the box."""
    at, n = passed_cells(cells), network.count
    offsets = (np.array(list(itertools.product(range(SQUARES), repeat=2))) + 0.5) / SQUARES
    for axis, end in itertools.product(range(3), (0, n - 1)):
        on_face = at[at[:, axis] == end]
        if not len(on_face):
            continue
        places = np.repeat(on_face.astype(np.float64), len(offsets), axis=0)
        across = [k for k in range(3) if k != axis]
        places[:, across] += np.tile(offsets, (len(on_face), 1))
        places[:, axis] = end and n
        half = np.full(3, 0.5 / (SQUARES * n))
        half[axis] = 0.0
        if bounds_of(network, places / n, half).passed.any():
            return True
    return False

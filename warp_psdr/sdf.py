"""Grids of signed distances: from meshes, back to meshes, and kept distances while they are optimised.

Values are arrays (Z, Y, X) or (Z, Y, X, 1), negative inside, at the nodes of the unit cube, as ``sdfgrid`` takes them.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import warp as wp

from warp_psdr.device import launch
from warp_psdr.kernels.primitive.redistance import GIVEN, OPEN, make_mesh_distance_kernel, make_sweep_kernel
from warp_psdr.scene.kinds.sdfgrid import is_passed
from warp_psdr.startup import device_named

__all__ = ["coefficients", "from_mesh", "redistance", "smooth_union", "to_mesh"]

#: Times eight sweeps after which distances no longer change on any grid that was tried.
ROUNDS = 20


def redistance(
    values: np.ndarray, lengths: tuple[float, float, float] = (1.0, 1.0, 1.0), cubic: bool = False, device=None
) -> np.ndarray:
    """Return values that are distances again, of the same surface, bit for bit.

    Values that the surface depends on stay as they are: the corners of all voxels that it passes. All others become
    distances, by fast sweeping [Zha05] from nodes next to the surface, whose own distances follow from where it crosses
    the edges to their neighbours. Call it between two steps of an optimiser: it is no part of what is differentiated.

    Args:
        values: (Z, Y, X) or (Z, Y, X, 1).
        lengths: of the box along x, y and z, in the unit of the values; the lengths of the columns of ``to_world``.
        cubic: of a grid with ``interpolation: cubic``: all 64 values of a voxel that the surface may pass stay.
        device: Warp device; None: the current one.

    Returns:
        float32, in the shape of ``values``.

    Raises:
        ValueError: They are no grid, not finite, or no two neighbours differ in sign.
    """
    grid = _grid(values)
    if not all(math.isfinite(x) and x > 0.0 for x in lengths):
        raise ValueError(f"lengths={lengths}: give three positive lengths")
    passed = is_passed(grid, cubic)
    nz, ny, nx = grid.shape
    spacing = [x / (n - 1) for x, n in zip(lengths, (nx, ny, nz), strict=True)]
    seeds = _seeds(_smoothed(grid) if cubic else grid, spacing)
    known = np.isfinite(seeds)
    if not known.any():
        raise ValueError("no two neighbours differ in sign, so there is no surface between them; give values of both")
    kept = np.zeros(np.array(grid.shape) + 2 * cubic, bool)
    around = range(4 if cubic else 2)
    for offset in itertools.product(around, repeat=3):
        kept[tuple(slice(o, o + n) for o, n in zip(offset, passed.shape, strict=True))] |= passed
    kept = kept[1:-1, 1:-1, 1:-1] if cubic else kept
    device = device_named(device)
    distance = wp.array(np.where(known, seeds, 3.0e38).astype(np.float32), dtype=wp.float32, device=device)
    state = wp.array(np.where(known, GIVEN, OPEN).astype(np.int32), dtype=wp.int32, device=device)
    changed = wp.zeros(1, dtype=wp.int32, device=device)
    planes, dim = (range(-1, 0), (nz, ny, nx)) if device.is_cpu else (range(nx + ny + nz - 2), (nz, ny, 1))
    for _ in range(ROUNDS):
        changed.zero_()
        for turned, plane in itertools.product(itertools.product((0, 1), repeat=3), planes):
            inputs = [wp.vec3(*spacing), plane, wp.vec3i(*turned)]
            launch(make_sweep_kernel(), dim=dim, inputs=inputs, outputs=[state, distance, changed], device=device)
        if not changed.numpy()[0]:
            break
    result = np.where(kept, grid, np.copysign(distance.numpy(), np.where(grid < 0.0, -1.0, 1.0)))
    return result.astype(np.float32).reshape(np.shape(values))


def from_mesh(
    vertices: np.ndarray, faces: np.ndarray, nodes: int | tuple[int, int, int] = 64, margin: float = 0.1, device=None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the signed distances of a closed mesh on a grid around it, and the grid's ``to_world``.

    Args:
        vertices: (N, 3).
        faces: (M, 3) vertex numbers, counter-clockwise seen from outside.
        nodes: along x, y and z; one number: along the longest axis, with cubic voxels.
        margin: on all sides, over the longest one of the mesh.
        device: Warp device; None: the current one.

    Returns:
        Values (Z, Y, X, 1), float32, in the unit of the vertices; ``to_world`` (4, 4).

    Raises:
        ValueError: The mesh is not closed, not finite, or empty; or there are less than two nodes along an axis.
    """
    points, triangles = np.asarray(vertices, np.float64), np.asarray(faces)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise ValueError(f"vertices of the shape {points.shape}: give finite numbers (N, 3)")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu" or not len(triangles):
        raise ValueError(f"faces of the shape {triangles.shape} and type {triangles.dtype}: give integers (M, 3)")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise ValueError(f"faces name vertices {triangles.min()} to {triangles.max()} of {len(points)}")
    open_edges = _open_edges(points, triangles)
    if open_edges:
        raise ValueError(f"{open_edges} edges have one face alone: the mesh has no inside; close its holes")
    low, high = points.min(axis=0), points.max(axis=0)
    longest = float((high - low).max())
    if not longest > 0.0 or not (math.isfinite(margin) and margin > 0.0):
        raise ValueError(
            f"an extent of {longest} and margin={margin}: give a mesh with an extent, and a positive margin"
        )
    low, high = low - margin * longest, high + margin * longest
    if isinstance(nodes, tuple):
        counts = np.array(nodes)
    else:
        counts = np.full(3, nodes)
        if nodes >= 2:
            spacing = (high - low).max() / (nodes - 1)
            counts = np.maximum(np.ceil((high - low) / spacing - 1e-6).astype(int) + 1, 2)
            middle, half = 0.5 * (low + high), 0.5 * spacing * (counts - 1)
            low, high = middle - half, middle + half
    if counts.shape != (3,) or (counts < 2).any():
        raise ValueError(f"nodes={nodes}: give 2 or more along each axis")
    device = device_named(device)
    mesh = wp.Mesh(
        points=wp.array(points.astype(np.float32), dtype=wp.vec3, device=device),
        indices=wp.array(triangles.reshape(-1).astype(np.int32), dtype=wp.int32, device=device),
        support_winding_number=True,
    )
    distance = wp.zeros(tuple(int(n) for n in counts[::-1]), dtype=wp.float32, device=device)
    steps = wp.vec3(*((high - low) / (counts - 1)))
    inputs = [mesh.id, wp.vec3(*low), steps]
    launch(make_mesh_distance_kernel(), dim=distance.shape, inputs=inputs, outputs=[distance], device=device)
    pose = np.diag([*(high - low), 1.0])
    pose[:3, 3] = low
    return distance.numpy()[..., None], pose


def to_mesh(
    values: np.ndarray, to_world: np.ndarray | None = None, cubic: bool = False, device=None
) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh of the surface, by marching cubes.

    Its vertices lie on the edges between nodes, where linear interpolation along the edge is zero. It is not the
    surface that is rendered: within voxels that is curved, and of ambiguous voxels marching cubes chooses one of two.

    Args:
        values: (Z, Y, X) or (Z, Y, X, 1).
        to_world: (4, 4) pose of the grid, or a ``psdr.Transform``; None: the unit cube.
        cubic: of a grid with ``interpolation: cubic``: of its B-spline's values at the nodes.
        device: Warp device; None: the current one.

    Returns:
        Vertices (N, 3), float32; faces (M, 3), int32, counter-clockwise seen from outside. Both are empty where all
        values have one sign.

    Raises:
        ValueError: They are no grid, or not finite.
    """
    from warp.geometry import IsoSurfaceMarchingCubes

    grid = _grid(values)
    grid = _smoothed(grid) if cubic else grid
    pose = np.eye(4) if to_world is None else np.asarray(getattr(to_world, "matrix", to_world), np.float64)
    if pose.shape != (4, 4):
        raise ValueError(f"to_world of the shape {pose.shape}: give a matrix (4, 4)")
    if (grid < 0.0).all() or (grid >= 0.0).all():
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    field: Any = wp.array(np.ascontiguousarray(grid.T, np.float32), dtype=wp.float32, device=device_named(device))
    points, indices = IsoSurfaceMarchingCubes.extract(field, 0.0, lower=(0.0, 0.0, 0.0), upper=(1.0, 1.0, 1.0))
    vertices = points.numpy().astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    faces = indices.numpy().reshape(-1, 3)
    if np.linalg.det(pose[:3, :3]) < 0.0:
        faces = faces[:, ::-1]
    return vertices.astype(np.float32), np.ascontiguousarray(faces, np.int32)


def smooth_union(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Return the values of two shapes that flow into each other, ``-width log(exp(-a / width) + exp(-b / width))``.

    Args:
        a: values of one shape.
        b: values of the other, in the same shape.
        width: of the blend, in the unit of the values, >= 0; 0: their union.

    Raises:
        ValueError: The shapes differ, or the width is negative.
    """
    first, second = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if first.shape != second.shape or not (math.isfinite(width) and width >= 0.0):
        raise ValueError(f"shapes {first.shape} and {second.shape}, width={width}: give equal shapes and a width >= 0")
    if width == 0.0:
        return np.minimum(first, second).astype(np.float32)
    return (-width * np.logaddexp(-first / width, -second / width)).astype(np.float32)


def coefficients(values: np.ndarray) -> np.ndarray:
    """Return the values for ``interpolation: cubic`` whose B-spline passes through the given ones at the nodes.

    Args:
        values: (Z, Y, X) or (Z, Y, X, 1).

    Returns:
        float32, in the shape of ``values``.

    Raises:
        ValueError: They are no grid, or not finite.
    """
    found = _grid(values).astype(np.float64)
    for axis in range(3):
        found = _solved(found, axis)
    return found.astype(np.float32).reshape(np.shape(values))


def _grid(values: np.ndarray) -> np.ndarray:
    grid = np.asarray(values, np.float32)
    grid = grid[..., 0] if grid.ndim == 4 and grid.shape[3] == 1 else grid
    if grid.ndim != 3 or min(grid.shape) < 2:
        raise ValueError(
            f"values of the shape {np.shape(values)}: give (Z, Y, X) or (Z, Y, X, 1), 2 or more along each"
        )
    if not np.isfinite(grid).all():
        raise ValueError("some values are not finite; give finite signed distances")
    return grid


def _seeds(grid: np.ndarray, spacing: list[float]) -> np.ndarray:
    """Distances of nodes from a plane through where the surface crosses the edges to neighbours; inf without any."""
    inside, size = grid < 0.0, np.abs(grid.astype(np.float64))
    total = np.zeros(grid.shape)
    for axis in range(3):
        step = spacing[2 - axis]
        nearest = np.full(grid.shape, np.inf)
        low, high = ([slice(None)] * 3 for _ in range(2))
        low[axis], high[axis] = slice(0, -1), slice(1, None)
        for here, there in ((tuple(low), tuple(high)), (tuple(high), tuple(low))):
            whole = np.maximum(size[here] + size[there], 1e-300)
            crossing = np.maximum(step * size[here] / whole, 1e-12 * step)
            crossing = np.where(inside[here] != inside[there], crossing, np.inf)
            nearest[here] = np.minimum(nearest[here], crossing)
        total += 1.0 / nearest**2
    with np.errstate(divide="ignore"):
        return 1.0 / np.sqrt(total)


def _smoothed(grid: np.ndarray) -> np.ndarray:
    """The values of a B-spline at the nodes."""
    for axis in range(3):
        grid = _along(grid, axis)
    return grid


def _along(grid: np.ndarray, axis: int) -> np.ndarray:
    """(c_{i-1} + 4 c_i + c_{i+1}) / 6 along an axis; the border's values go on."""
    c = np.moveaxis(np.pad(grid, [(int(k == axis),) * 2 for k in range(3)], mode="edge"), axis, 0)
    return np.moveaxis((c[:-2] + 4.0 * c[1:-1] + c[2:]) / 6.0, 0, axis)


def _solved(values: np.ndarray, axis: int) -> np.ndarray:
    """The inverse of ``_along``: a tridiagonal system, by elimination."""
    right = 6.0 * np.moveaxis(values, axis, 0)
    count = len(right)
    diagonal = np.full(count, 4.0)
    diagonal[[0, -1]] = 5.0
    for k in range(1, count):
        factor = 1.0 / diagonal[k - 1]
        diagonal[k] -= factor
        right[k] -= factor * right[k - 1]
    right[-1] /= diagonal[-1]
    for k in range(count - 2, -1, -1):
        right[k] = (right[k] - right[k + 1]) / diagonal[k]
    return np.moveaxis(right, 0, axis)


def _open_edges(points: np.ndarray, faces: np.ndarray) -> int:
    """How many edges of a mesh, welded by place, do not have as many faces on either side."""
    _places, welded = np.unique(points, axis=0, return_inverse=True)
    corners = welded.reshape(-1)[faces]
    ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    ends = ends[ends[:, 0] != ends[:, 1]]
    side = np.where(ends[:, 0] < ends[:, 1], 1, -1)
    edges, number = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
    return int((np.bincount(number.reshape(-1), side, len(edges)) != 0).sum())

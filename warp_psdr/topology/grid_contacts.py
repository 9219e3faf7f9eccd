"""Grids and networks of signed distances against the rest of a scene: what runs through, cuts, or opens them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.scene.kinds.network_bounds import values_of
from warp_psdr.scene.kinds.neuralsdf import Network, network_and_cells
from warp_psdr.scene.kinds.sdfgrid import is_passed, spline_values
from warp_psdr.scene.kinds.zero_set import CORNERS
from warp_psdr.topology.camera_view import camera_view
from warp_psdr.topology.kinds.exact_shapes import pose, with_exact_shapes
from warp_psdr.topology.kinds.grid_silhouettes import grid_shapes, grid_values, is_smooth_grid
from warp_psdr.topology.kinds.network_silhouettes import network_shapes, passed_cells
from warp_psdr.topology.unchanged import kept

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Points across a voxel at which a triangle that passes it is compared with the surface.
POINTS = 6
#: Value over the largest one of a grid up to which a triangle touches the surface instead of running through it.
TOUCHING = 1.0e-5
#: Voxels by which boxes of another grid's voxels are wider, against rounding.
NEXT_TO = 1.0e-4


def is_open(values: np.ndarray, cubic: bool = False) -> bool:
    """Return whether the surface of a grid (Z, Y, X) ends at a face of its box; if ``cubic``, whether it may."""
    for axis in range(3):
        for end, inner in ((0, 1), (-1, -2)):
            face = np.take(values, end, axis=axis)
            if cubic:
                # The coefficients of the spline in the face, whose outermost values go on behind it.
                face = (5.0 * face + np.take(values, inner, axis=axis)) / 6.0
            inside = face < 0.0
            if inside.any() and not inside.all():
                return True
    return False


@dataclass(frozen=True, eq=False)
class Passed:
    """Where a surface passes a grid of voxels, or the cells of a network."""

    voxels: np.ndarray  #: (N, 3), x, y, z
    cells: np.ndarray  #: (3,) voxels along the axes
    field: Callable[[np.ndarray], np.ndarray]  #: phi (M,) at points (M, 3), in voxels
    size: float  #: values of phi up to which something touches the surface

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray] | None:
        """The ends (x, y, z), in voxels, of a box around the surface; None: there is none."""
        return (self.voxels.min(axis=0), self.voxels.max(axis=0) + 1) if len(self.voxels) else None


def passed_by(scene: Scene, shape: int) -> Passed:
    """Return where the surface of a grid or of a network passes."""
    return kept(scene, ("passed by", shape), lambda: _passed_by(scene, shape))


def _passed_by(scene: Scene, shape: int) -> Passed:
    if isinstance(scene.geometry(shape), Network):
        network, found = network_and_cells(scene, shape)
        at, n = passed_cells(found), float(network.count)
        slopes = np.linalg.norm(values_of(network, (at + 0.5) / n)[1], axis=1)
        size = TOUCHING * slopes.max(initial=0.0)
        return Passed(at, np.full(3, n), lambda points: values_of(network, points / n)[0], size)
    values, cubic = grid_values(scene, shape), is_smooth_grid(scene, shape)
    field = spline_interpolated if cubic else interpolated
    return Passed(
        np.argwhere(is_passed(values, cubic))[:, ::-1],
        np.array(values.shape[::-1]) - 1.0,
        functools.partial(field, values),
        TOUCHING * float(np.abs(values).max()),
    )


def in_box(scene: Scene, shape: int, low: np.ndarray, high: np.ndarray) -> int | None:
    """Return a mesh of which a triangle may reach into the part from low to high (3,) of a shape's box [0, 1]^3."""
    linear, origin = pose(scene, shape)
    corners = CORNERS * (high - low) + low
    local = (scene.points[scene.builder.indices].astype(np.float64) - origin) @ np.linalg.inv(linear).T
    near = ((local.min(axis=1, initial=np.inf) < high) & (local.max(axis=1, initial=-np.inf) > low)).all(axis=1)
    for row in np.flatnonzero(near):
        a, b, c = local[row]
        height = (corners - a) @ np.cross(b - a, c - a)
        if height.min() < 0.0 < height.max():
            return int(scene.builder.face_shape[row])
    return None


def pierced_grid(scene: Scene, shapes: frozenset[int] | None) -> tuple[int, int] | None:
    """Return a grid and another one, or an exact shape, that runs through it, one of them in ``shapes`` (None: any).

    Through a network meshes run, too. Of another grid or network the voxels are compared that both surfaces pass.
    """
    grids = sorted([*grid_shapes(scene), *network_shapes(scene)])
    if not grids:
        return None
    corners, owners = with_exact_shapes(scene)
    surfaces = {i: passed_by(scene, i) for i in grids}
    for n, i in enumerate(grids):
        own = surfaces[i]
        box = own.box
        if box is None:
            continue
        linear, origin = pose(scene, i)
        inverse = np.linalg.inv(linear) * own.cells[:, None]
        local = (corners - origin) @ inverse.T
        near = (local.min(axis=1, initial=np.inf) < box[1]).all(axis=1) & (
            local.max(axis=1, initial=-np.inf) > box[0]
        ).all(axis=1)
        if shapes is not None and i not in shapes:
            near &= np.isin(owners, sorted(shapes))
        if not isinstance(scene.geometry(i), Network):
            near[: scene.face_count] = False  # meshes: ``crossing_curves.py``
        for row in np.flatnonzero(near):
            if _runs_through(own, local[row]):
                return i, int(owners[row])
        for j in grids[n + 1 :]:
            if shapes is None or i in shapes or j in shapes:
                turned, place = pose(scene, j)
                if _meets(own, surfaces[j], inverse @ turned / surfaces[j].cells, inverse @ (place - origin)):
                    return i, j
    return None


def _meets(own: Passed, other: Passed, linear: np.ndarray, origin: np.ndarray) -> bool:
    """Whether two surfaces pass voxels that overlap; ``linear`` and ``origin`` lead from the other's to one's own."""
    if own.box is None or other.box is None:
        return False
    low, high = other.box
    ends = (CORNERS * (high - low) + low) @ linear.T + origin
    if (ends.min(axis=0) >= own.box[1]).any() or (ends.max(axis=0) <= own.box[0]).any():
        return False
    middles = (other.voxels + 0.5) @ linear.T + origin
    reach = 0.5 * np.abs(linear).sum(axis=1) + NEXT_TO
    return _passes_any(own, middles - reach, middles + reach)


def _passes_any(surface: Passed, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether a surface passes a voxel that one of the boxes from low to high (N, 3), in voxels, reaches into."""
    size = surface.cells.astype(int)
    # How many of the voxels before a node, along all three axes, are passed.
    before = np.zeros(size + 1, np.int64)
    before[tuple(surface.voxels.T + 1)] = 1
    for axis in range(3):
        before = before.cumsum(axis=axis)
    ends = np.clip(np.floor(low).astype(int), 0, size), np.clip(np.ceil(high).astype(int), 0, size)
    total = np.zeros(len(low), np.int64)
    for corner in np.ndindex(2, 2, 2):
        at = [ends[side][:, axis] for axis, side in enumerate(corner)]
        total += (-1) ** (3 - sum(corner)) * before[tuple(at)]
    return bool((total > 0).any())


def _runs_through(surface: Passed, triangle: np.ndarray) -> bool:
    """Whether phi has both signs on a triangle (3, 3), in voxels: at points of it in voxels that the surface passes."""
    voxels = surface.voxels
    p, e1, e2 = triangle[0], triangle[1] - triangle[0], triangle[2] - triangle[0]
    n = np.cross(e1, e2)
    squared = n @ n
    if squared == 0.0:
        return False
    middle = voxels + 0.5
    voxels = voxels[np.abs((middle - p) @ n) <= 0.5 * np.abs(n).sum()]
    if not len(voxels):
        return False
    across = int(np.argmax(np.abs(n)))
    others = [k for k in range(3) if k != across]
    t = (np.arange(POINTS) + 0.5) / POINTS
    square = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    points = np.empty((len(voxels), len(square), 3))
    points[..., others] = voxels[:, None, others] + square
    points[..., across] = p[across] - ((points[..., others] - p[others]) @ n[others]) / n[across]
    inside = (points[..., across] >= voxels[:, None, across]) & (points[..., across] <= voxels[:, None, across] + 1)
    r = points - p
    u, v = np.cross(r, e2) @ n / squared, np.cross(e1, r) @ n / squared
    points = points[inside & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)]
    if not len(points):
        return False
    found = surface.field(points)
    return bool(found.min() < -surface.size and found.max() > surface.size)


def interpolated(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return tri-linear values (N,) of a grid (Z, Y, X) at points (N, 3), in voxels."""
    cell = np.clip(points.astype(int), 0, np.array(values.shape[::-1]) - 2)
    f, total = points - cell, np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        at = cell + corner
        weight = np.prod(np.where(corner, f, 1.0 - f), axis=1)
        total += weight * values[at[:, 2], at[:, 1], at[:, 0]]
    return total


def spline_interpolated(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the values (N,) of the cubic B-spline of a grid (Z, Y, X) at points (N, 3), in voxels."""
    cell = np.clip(points.astype(int), 0, np.array(values.shape[::-1]) - 2)
    x = points - cell
    y = 1.0 - x
    weights = np.stack([y**3, 4.0 + x * x * (3.0 * x - 6.0), 4.0 + y * y * (3.0 * y - 6.0), x**3], axis=-1) / 6.0
    around = spline_values(values, cell[:, ::-1])
    return np.einsum("nkji,ni,nj,nk->n", around, weights[:, 0], weights[:, 1], weights[:, 2], optimize=True)


def require_uncut_grids(scene: Scene, sensor: int, shapes: list[int]) -> None:
    """Raise if a clip plane of a camera runs through the box around the surface of a grid or network.

    Raises:
        ValueError: the derivative of that border is in no term.
    """
    view = camera_view(scene, sensor)
    for i in shapes:
        passed = passed_by(scene, i)
        box = passed.box
        if box is None:
            continue
        linear, origin = pose(scene, i)
        ends = (CORNERS * (box[1] - box[0]) + box[0]) / passed.cells
        depth = view.depth(ends @ linear.T + origin)
        for plane in view.clip_depths():
            if depth.min() < plane < depth.max():
                kind = "network" if isinstance(scene.geometry(i), Network) else "grid"
                raise ValueError(
                    f"a clip plane of sensor {sensor} runs through the box around the surface of the {kind} "
                    f"{scene.description.shapes[i].path!r}, and the derivative of a border that it cuts is not "
                    "estimated; change near_clip or far_clip, move the camera, or say PathIntegrator(boundary=None) to "
                    "get the interior term alone"
                )

"""Where segments can touch a grid of signed distances: its items, and those whose silhouette an eye may see.

An item is a face between two voxels, or a voxel, that the surface passes, numbered as in ``grid_points.py`` of the
kernels. From an eye the silhouette lies where Psi = grad phi . (x - eye) is zero, or changes its sign across a face.
Derivatives of phi along an axis are bilinear, so the differences at the corners bound them, and interval arithmetic
bounds Psi. Items that are left out have no silhouette.
"""

from __future__ import annotations

import itertools
from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.boundary.silhouette.grid_points import VOXEL_ITEM, GridItems
from warp_psdr.scene.kinds.sdfgrid import SdfGrid, bezier_values, is_passed, spline_values
from warp_psdr.topology.camera_view import camera_view
from warp_psdr.topology.kinds.exact_shapes import pose
from warp_psdr.topology.unchanged import kept

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Kind of an item that is a voxel.
VOXEL = 3
#: Rounding of bounds, over their size; above the angle of sheets seen from their edges (``edge_on.py`` of the kernels).
ROUNDING = 1.0e-5


@dataclass(frozen=True, eq=False)
class Eyes:
    """Where rays that touch a shape may come from: a box of points, or of directions, in the device's coordinates."""

    corners: np.ndarray  #: (N, 3)
    distant: bool


def grid_values(scene: Scene, shape: int) -> np.ndarray:
    """Return the values (Z, Y, X) of a shape that is a grid, as they are now."""
    p = scene.parameters[f"{scene.description.shapes[shape].path}.grid"]
    return scene.values.numpy()[p.offset : p.offset + p.size].reshape(p.shape)[..., 0].astype(np.float64)


def is_smooth_grid(scene: Scene, shape: int) -> bool:
    """Return whether a shape is a grid whose interpolation is cubic."""
    grid = scene.description.shapes[shape].geometry
    return isinstance(grid, SdfGrid) and grid.cubic


def grid_shapes(scene: Scene, cubic: bool | None = None) -> list[int]:
    """Return the numbers of the shapes that are grids, of one interpolation or (None) of both."""
    found = [i for i in scene.builder.primitives if isinstance(scene.geometry(i), SdfGrid)]
    return [i for i in found if cubic is None or is_smooth_grid(scene, i) == cubic]


def items_of(values: np.ndarray, concave: bool = False, cubic: bool = False) -> np.ndarray:
    """Return the numbers (N,) of the items of a grid (Z, Y, X), without faces whose creases are all concave.

    ``concave``: of faces alone, with those. ``cubic``: of a smooth grid, whose items are voxels.
    """
    if cubic:
        return item_numbers(is_passed(values, True), values.shape) * 4 + VOXEL
    inside, flat = values < 0.0, values.reshape(-1)
    stride = (1, values.shape[2], values.shape[2] * values.shape[1])
    found = [] if concave else [item_numbers(is_passed(values), values.shape) * 4 + VOXEL]
    for axis in range(3):
        along = 2 - axis  # in the array
        corners = []
        for offsets in itertools.product((0, 1), repeat=2):
            ends = [slice(o, n - 1 + o) for o, n in zip(offsets, np.delete(values.shape, along), strict=True)]
            ends.insert(along, slice(1, -1))
            corners.append(inside[tuple(ends)])
        # Bends alone of faces that the surface passes: they are few.
        passed = np.any(corners, axis=0) & ~np.all(corners, axis=0)
        first = item_numbers(passed, values.shape) + stride[axis]
        others = [stride[k] for k in range(3) if k != axis]
        at = np.array([first + np.dot(offsets, others) for offsets in itertools.product((0, 1), repeat=2)])
        bends = (flat[at + stride[axis]] - flat[at]) - (flat[at] - flat[at - stride[axis]])
        found.append(4 * first[(np.abs(bends) if concave else bends).max(axis=0) > 0.0] + axis)
    return np.concatenate(found)


def item_numbers(mask: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the numbers, in a grid (Z, Y, X) of a shape, of the nodes that a mask over its first ones holds."""
    z, y, x = np.nonzero(mask)
    return (z * shape[1] + y) * shape[2] + x


def may_show(values: np.ndarray, numbers: np.ndarray, low: np.ndarray, high: np.ndarray, distant: bool) -> np.ndarray:
    """Return which items may hold a silhouette from some eye of a box.

    Args:
        values: (Z, Y, X).
        numbers: (N,) of items.
        low: (3,) least coordinates x, y, z of the eyes, in voxels.
        high: the greatest ones.
        distant: the eyes are directions.
    """
    least, most = _bounds(values, numbers, low, high, distant)
    return ~(np.all(least > 0.0, axis=0) | np.all(most < 0.0, axis=0))


def may_face(values: np.ndarray, numbers: np.ndarray, low: np.ndarray, high: np.ndarray, distant: bool) -> np.ndarray:
    """Return which items may turn both their sides to some eye of a box; arguments as of ``may_show``.

    From outside of the grid its surface, which is closed, is seen from there alone; from a box that reaches into the
    grid all items may be.
    """
    nz, ny, nx = values.shape
    if not distant and (high >= 0.0).all() and (low <= [nx - 1, ny - 1, nz - 1]).all():
        return np.ones(len(numbers), bool)
    least, most = _bounds(values, numbers, low, high, distant)
    # Towards the eye phi grows, which Psi counts along the ray; a direction leads towards the eye.
    grows = (values[0, 0, 0] > 0.0) == distant
    return np.all(most >= 0.0 if grows else least <= 0.0, axis=0)


def _bounds(
    values: np.ndarray, numbers: np.ndarray, low: np.ndarray, high: np.ndarray, distant: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds (2, N) of Psi, rounding included, on the two sides of faces; of voxels twice the same."""
    _nz, ny, nx = values.shape
    node, kind = numbers >> 2, numbers & 3
    corner = np.stack([node % nx, node // nx % ny, node // (nx * ny)], axis=1).astype(np.float64)
    stride, flat = (1, nx, nx * ny), values.reshape(-1)
    lower, upper = np.zeros((2, len(numbers))), np.zeros((2, len(numbers)))
    for k in range(VOXEL + 1):
        rows = np.flatnonzero(kind == k)
        place, first = corner[rows], node[rows]
        extent = np.array([0.0 if axis == k else 1.0 for axis in range(3)])
        away = (low, high) if distant else (place - high, place + extent - low)
        terms = []
        for axis in range(3):
            free = [stride[other] for other in range(3) if other not in (axis, k)]
            terms.append(interval_product(_slopes(flat, first, stride[axis], free), [end[..., axis] for end in away]))
        sides = [terms]
        if k < VOXEL:  # the voxel in front of the face
            free = [stride[other] for other in range(3) if other != k]
            before = interval_product(_slopes(flat, first - stride[k], stride[k], free), [end[..., k] for end in away])
            sides.append([before if axis == k else term for axis, term in enumerate(terms)])
        for number in range(2):
            side = sides[min(number, len(sides) - 1)]
            slack = ROUNDING * sum(np.maximum(-least, most) for least, most in side)
            lower[number, rows] = sum(least for least, _most in side) - slack
            upper[number, rows] = sum(most for _least, most in side) + slack
    return lower, upper


def spline_may_show(
    values: np.ndarray, numbers: np.ndarray, low: np.ndarray, high: np.ndarray, distant: bool
) -> np.ndarray:
    """Return the same of the voxels of a smooth grid; arguments as of ``may_show``.

    Derivatives along an axis lie between the least and the greatest of three times the differences of Bezier
    coefficients.
    """
    _nz, ny, nx = values.shape
    node = numbers >> 2
    place = np.stack([node % nx, node // nx % ny, node // (nx * ny)], axis=1).astype(np.float64)
    bezier = bezier_values(spline_values(values, place[:, ::-1].astype(int)))
    away = (low, high) if distant else (place - high, place + 1.0 - low)
    terms = []
    for axis in range(3):
        slopes = np.diff(bezier, axis=3 - axis).reshape(len(numbers), -1)
        bounds = [slopes.min(axis=1), slopes.max(axis=1)] if len(numbers) else [np.zeros(0)] * 2
        terms.append(interval_product(bounds, [end[..., axis] for end in away]))
    return may_vanish(terms)


def _slopes(flat: np.ndarray, first: np.ndarray, stride: int, free: list[int]) -> list[np.ndarray]:
    """Return the least and the greatest difference along an axis at the corners that ``free`` strides lead to."""
    at = [first + np.dot(offsets, free) for offsets in itertools.product((0, 1), repeat=len(free))]
    found = np.array([flat[place + stride] - flat[place] for place in at])
    return [found.min(axis=0), found.max(axis=0)]


def may_vanish(terms: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return where the sum of intervals, given by their ends (N,), may hold 0, rounding included."""
    slack = ROUNDING * sum(np.maximum(-least, most) for least, most in terms)
    above = sum(least for least, _most in terms) > slack
    return ~(above | (sum(most for _least, most in terms) < -slack))


def interval_product(a: list[np.ndarray], b: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of a product of intervals."""
    ends = [x * y for x in a for y in b]
    return np.min(ends, axis=0), np.max(ends, axis=0)


def seen_from(scene: Scene, shape: int, values: np.ndarray, numbers: np.ndarray, eyes: Eyes) -> np.ndarray:
    """Return which items of a shape may hold a silhouette from some eye."""
    may = spline_may_show if is_smooth_grid(scene, shape) else may_show
    return may(values, numbers, *_in_voxels(scene, shape, values, eyes), eyes.distant)


def _in_voxels(scene: Scene, shape: int, values: np.ndarray, eyes: Eyes) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends (3,) of the box around eyes, in voxels of a shape."""
    linear, origin = pose(scene, shape)
    cells = np.array(values.shape[::-1]) - 1.0
    local = (eyes.corners if eyes.distant else eyes.corners - origin) @ np.linalg.inv(linear).T * cells
    return local.min(axis=0), local.max(axis=0)


def camera_eyes(scene: Scene, sensor: int) -> Eyes:
    """Return where a camera's rays come from."""
    view = camera_view(scene, sensor)
    if not view.finite:
        return Eyes(view.eye[None], True)
    square = np.array(list(itertools.product((-1.0, 1.0), repeat=2))) * view.radius
    return Eyes(view.eye + square @ view.pose[:3, :2].T, False)


def light_eyes(scene: Scene, kinds: frozenset[int] | None = None) -> list[Eyes] | None:
    """Return where each light is, of some kinds or (None) of all; None: one is everywhere."""
    return kept(scene, ("light eyes", kinds), lambda: _light_eyes(scene, kinds))


def _light_eyes(scene: Scene, kinds: frozenset[int] | None) -> list[Eyes] | None:
    found, b, values = [], scene.builder, scene.values.numpy()
    for number, e in enumerate(b.emitters):
        if kinds is not None and e.kind not in kinds:
            continue
        if e.kind in (c.EMITTER_AREA, c.EMITTER_DIRECTIONAL_AREA):
            own = [i for i, shape in enumerate(b.shapes) if shape.emitter == number]
            of_triangles = scene.points[b.indices[np.isin(b.face_shape, own)].reshape(-1)]
            # Of shapes without triangles the corners of the box around them.
            records = [b.shapes[i] for i in own if i in b.primitives]
            boxes = [scene.points[r.first_vertex : r.first_vertex + r.vertex_count] for r in records]
            corners = np.concatenate([of_triangles, *boxes]).astype(np.float64)
            box = np.array(list(itertools.product(*zip(corners.min(axis=0), corners.max(axis=0), strict=True))))
            found.append(Eyes(box, False))
        elif e.kind == c.EMITTER_POINT:
            found.append(Eyes(values[None, e.to_world : e.to_world + 3].astype(np.float64), False))
        elif e.kind in (c.EMITTER_CONSTANT, c.EMITTER_ENVMAP):
            return None
        else:
            matrix = values[e.to_world : e.to_world + 16].reshape(4, 4).astype(np.float64)
            distant = e.kind == c.EMITTER_DIRECTIONAL
            found.append(Eyes(matrix[None, :3, 2] if distant else matrix[None, :3, 3], distant))
    return found


def grid_items(scene: Scene, shapes: list[int], eyes: list[Eyes] | None, concave: bool = False) -> GridItems | None:
    """Return the items of some grids, those first that may show a silhouette to an eye (None: eyes are everywhere).

    ``concave`` as of ``items_of``. None: there are no items.
    """

    def find() -> GridItems | None:
        listed = []
        for shape in shapes:
            values = grid_values(scene, shape)
            numbers = _items_now(scene, shape, concave)
            seen = np.full(len(numbers), eyes is None)
            for e in eyes or []:
                seen |= seen_from(scene, shape, values, numbers, e)
            listed.append((shape, numbers, seen))
        return gathered(scene, listed)

    return copied(kept(scene, ("grid items", tuple(shapes), named(eyes), concave), find))


def facing_creases(scene: Scene, shapes: list[int], eyes: Eyes) -> GridItems | None:
    """Return the creases of some linear grids, concave ones included, that eyes may see from the front; None: none."""

    def find() -> GridItems | None:
        listed = []
        for shape in shapes:
            values, numbers = grid_values(scene, shape), _items_now(scene, shape, True)
            faces = may_face(values, numbers, *_in_voxels(scene, shape, values, eyes), eyes.distant)
            listed.append((shape, numbers[faces], np.zeros(int(faces.sum()), bool)))
        return gathered(scene, listed)

    return copied(kept(scene, ("facing creases", tuple(shapes), named([eyes])), find))


def _items_now(scene: Scene, shape: int, concave: bool) -> np.ndarray:
    """Return the items of a grid."""
    key = ("items of a grid", shape, concave)
    return kept(scene, key, lambda: items_of(grid_values(scene, shape), concave, is_smooth_grid(scene, shape)))


def named(eyes: list[Eyes] | None) -> Hashable:
    """Return what tells eyes from others."""
    return None if eyes is None else tuple((e.corners.tobytes(), e.distant) for e in eyes)


def copied(found: GridItems | None) -> GridItems | None:
    """Return a record of the same items, with members of its own."""
    if found is None:
        return None
    own = GridItems()
    own.items, own.aimed, own.share = found.items, found.aimed, found.share
    return own


def only(found: GridItems | None, creases: bool) -> GridItems | None:
    """Return the items that are creases, or those that are not; None: there are none."""
    if found is None:
        return None
    items = found.items.numpy()
    kept = ((items[:, 1] & 3) != int(VOXEL_ITEM)) == creases
    if not kept.any():
        return None
    left = GridItems()
    left.items = wp.array(items[kept], dtype=wp.vec2i, device=found.items.device)
    left.aimed = int(kept[: found.aimed].sum())
    left.share = found.share
    return left


def gathered(scene: Scene, listed: list[tuple[int, np.ndarray, np.ndarray]]) -> GridItems | None:
    """Return items, those first that are seen, of shapes with the numbers (N,) of theirs and which are seen (N,)."""
    shown, hidden = [], []
    for shape, numbers, seen in listed:
        record = scene.face_count + scene.builder.primitives.index(shape)
        pairs = np.stack([np.full(len(numbers), record), numbers], axis=1).astype(np.int32)
        shown.append(pairs[seen])
        hidden.append(pairs[~seen])
    if not sum(len(pairs) for pairs in (*shown, *hidden)):
        return None
    found = GridItems()
    found.items = wp.array(np.concatenate([*shown, *hidden]), dtype=wp.vec2i, device=scene.device)
    found.aimed = sum(len(pairs) for pairs in shown)
    found.share = 1.0
    return found

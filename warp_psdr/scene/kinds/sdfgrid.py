"""Shapes that are the zero set of a grid of signed distances (``sdfgrid*.py`` of ``kernels/primitive``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from warp_psdr.kernels.primitive.cubic_grid import CUBIC_GRID
from warp_psdr.kernels.primitive.linear_grid import LINEAR_GRID
from warp_psdr.options.words import words
from warp_psdr.scene.errors import SceneError, error
from warp_psdr.scene.files.volume_files import MOST_VALUES, read_vol
from warp_psdr.scene.kinds.kind import Geometry
from warp_psdr.scene.kinds.zero_set import ZeroSet
from warp_psdr.scene.layout import SHAPE_GRID, Layout

if TYPE_CHECKING:
    from warp_psdr.scene.plugins import Properties
    from warp_psdr.scene.scene import Scene

#: Bezier coefficients of a piece of a uniform cubic B-spline by its four values.
BEZIER = np.array([[1, 4, 1, 0], [0, 4, 2, 0], [0, 2, 4, 0], [0, 1, 4, 1]]) / 6.0
#: Rounding of the device's Bezier coefficients, over the greatest value; and voxels at a time.
ROUNDING, CHUNK = 1.0e-6, 65536


@dataclass(eq=False)
class SdfGrid(ZeroSet):
    """Signed distances at the nodes of a grid in [0, 1]^3, interpolated linearly."""

    plugin = "sdfgrid"
    name = "sdfgrid"
    device = LINEAR_GRID
    jumps = "the faces of voxels"
    outside_groups = ""
    instead = "extract its triangles (wp.MarchingCubes, skimage.measure.marching_cubes) and give them as a 'mesh'"
    cubic: ClassVar[bool] = False  #: the values are coefficients of a B-spline

    values: np.ndarray  #: (Z, Y, X, 1), of the nodes
    smooth: bool  #: shading normals are interpolated between voxels

    @classmethod
    def read(cls, props: Properties, to_world: np.ndarray) -> tuple[Geometry, np.ndarray]:
        """Take the values, and how its shading normals are found.

        Raises:
            ValueError: there are none, they are no grid, or not finite.
        """
        return _read(props), to_world

    @property
    def nodes(self) -> tuple[int, int, int]:
        """Number of the nodes along x, y and z."""
        z, y, x = self.values.shape[:3]
        return x, y, z

    @property
    def knows(self) -> frozenset[str]:
        """Smooth normals turn away from the viewer where mirrors and glass do not follow."""
        return words("mirror", "glass") if self.smooth else words("mirrors", "mirror", "glass")

    def parameters(self) -> dict[str, np.ndarray]:
        """Return the values of the nodes, (Z, Y, X, 1)."""
        return {"grid": self.values}

    def lay(self, layout: Layout, path: str, shape: int, pose: int) -> int:
        """Lay out the number of nodes, their values, and what rays walk by."""
        layout.add_values(np.array([*self.nodes, self.smooth]))
        offset = layout.add(f"{path}.grid", self.values, SHAPE_GRID, owner=shape)
        layout.hold(self, "values", offset)
        layout.add_values(walk_values(self.values, self.cubic))
        return pose

    def follow(self, scene: Scene, shape: int, state: Any) -> Any:
        """Let what rays walk by follow the values."""
        p = scene.parameters[f"{scene.description.shapes[shape].path}.grid"]
        values = scene.values[p.offset : p.offset + p.size].numpy()
        found = walk_values(values.reshape(p.shape), self.cubic)
        scene.values[p.offset + p.size : p.offset + p.size + found.size].assign(found)

    @classmethod
    def describe(cls, shapes: Sequence[tuple[str, Geometry]]) -> list[tuple[str, str, str]]:
        """Return one line about all of them."""
        grids = [geometry for _path, geometry in shapes if isinstance(geometry, SdfGrid)]
        sizes = [" x ".join(map(str, g.nodes)) + " cubic" * g.cubic for g in grids]
        return [("distance grids", ", ".join(sizes), "nodes along x, y, z; rays go from voxel to voxel of each")]


class CubicSdfGrid(SdfGrid):
    """The same of which the values are coefficients of a cubic B-spline."""

    name = "cubic sdfgrid"
    device = CUBIC_GRID
    jumps = ""
    cubic = True


def _read(props: Properties) -> SdfGrid:
    if props.has("face_normals"):
        raise error(props.where, f"'face_normals' on a '{props.type}'", "say 'normals': 'analytic'")
    cubic = props.string("interpolation", "linear", ("linear", "cubic")) == "cubic"
    normals = props.string("normals", "analytic" if cubic else "smooth", ("smooth", "analytic"))
    if cubic and normals == "smooth":
        problem = f"'smooth' normals on a cubic '{props.type}', whose own normals are smooth"
        raise error(props.where, problem, "leave out 'normals', or say 'analytic'")
    given = [key for key in ("filename", "grid") if props.has(key)]
    sources = {key: props.take(key) for key in ("filename", "grid")}
    if len(given) != 1:
        problem = f"got {' and '.join(given)}" if given else "there are no values"
        raise error(props.where, problem, "give one of 'filename' (a .vol file) and 'grid' (an array (Z, Y, X))")
    place, value = props.place(given[0]), sources[given[0]]
    values = _file(props, value, place) if given[0] == "filename" else _array(value)
    values = values[..., None] if values.ndim == 3 else values
    if values.ndim != 4 or values.shape[3] != 1 or min(values.shape[:3]) < 2:
        shape = f"the shape {values.shape}" if values.ndim else "no array of numbers"
        raise error(place, f"got {shape}", "give numbers (Z, Y, X) or (Z, Y, X, 1), 2 or more nodes along each axis")
    if values.size > MOST_VALUES:
        raise error(place, f"got {values.size} values", f"give at most {MOST_VALUES}")
    props.context.count(values.size, place)
    wrong = int((~np.isfinite(values)).sum())
    if wrong:
        raise error(place, f"{wrong} of {values.size} values are not finite", "give finite signed distances")
    if (values >= 0.0).all() or (values < 0.0).all():
        missing = "positive" if values[0, 0, 0, 0] < 0.0 else "negative"
        props.context.note(f"{place}: no value is {missing}, so the shape is empty")
    elif cubic and not is_passed(values[..., 0], True).any():
        props.context.note(f"{place}: cubic interpolation smooths away what differs in sign, so the shape is empty")
    kind = CubicSdfGrid if cubic else SdfGrid
    return kind(np.ascontiguousarray(values), normals == "smooth")


def _file(props: Properties, name: Any, place: str) -> np.ndarray:
    try:
        return read_vol(props.context.file(name, place))[0]
    except SceneError:
        raise
    except ValueError as problem:
        raise SceneError(f"{place}: {problem}") from None


def _array(value: Any) -> np.ndarray:
    try:
        values = np.asarray(value.numpy() if hasattr(value, "numpy") else value)
        return values.astype(np.float32) if values.dtype.kind in "iuf" else np.empty((), np.float32)
    except (TypeError, ValueError):
        return np.empty((), np.float32)


def reaches(values: np.ndarray, cubic: bool = False) -> np.ndarray:
    """Return of each voxel how many voxels it is away from one that the surface may pass, (Z, Y, X); 0 in those.

    Args:
        values: of the nodes, (Z, Y, X, 1).
        cubic: they are coefficients of a B-spline.
    """
    return _distances(is_passed(values[..., 0], cubic)).astype(np.float32)


def _distances(passed: np.ndarray) -> np.ndarray:
    """Return how many voxels each is away from one that is passed; their number along the longest axis if none is."""
    if not passed.any():
        return np.full(passed.shape, max(passed.shape), np.int32)
    from scipy.ndimage import distance_transform_cdt

    return distance_transform_cdt(~passed, metric="chessboard")


def walk_values(values: np.ndarray, cubic: bool) -> np.ndarray:
    """Return what rays walk by, flat: the reaches, and the block of voxels, (x, y, z), low and high, that they walk in.

    It holds all voxels that the surface may pass, and their neighbours; nothing, if there are none. Arguments as
    ``reaches``'s.
    """
    passed = is_passed(values[..., 0], cubic)
    walked = np.zeros(passed.size + 6, np.float32)
    walked[:-6] = _distances(passed).reshape(-1)
    block = walked[-6:].reshape(2, 3)
    if passed.any():
        for axis, count in enumerate(passed.shape):
            along = np.nonzero(passed.any(axis=tuple({0, 1, 2} - {axis})))[0]
            block[:, 2 - axis] = max(int(along[0]) - 1, 0), min(int(along[-1]) + 2, count)
    return walked


def is_passed(values: np.ndarray, cubic: bool = False) -> np.ndarray:
    """Return of each voxel whether its corners differ in sign; ``values`` of the nodes, (Z, Y, X).

    ``cubic``: whether the Bezier coefficients of its piece of a B-spline do, between which the piece lies.
    """
    if cubic:
        return _spline_passed(values)
    some = every = values < 0.0
    for axis in range(3):
        some, every = (
            join(ends[_part(axis, 0, -1)], ends[_part(axis, 1, None)])
            for join, ends in ((np.logical_or, some), (np.logical_and, every))
        )
    return some & ~every


def _part(axis: int, first: int, stop: int | None) -> tuple[slice, ...]:
    """Return the index of a part of a grid along one of its axes."""
    return (slice(None),) * axis + (slice(first, stop),)


def spline_values(values: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the 64 values (N, 4, 4, 4), by z, y, x, around voxels (N, 3), z, y, x; the border's go on behind it."""
    z, y, x = (np.clip(corners[:, k, None] + np.arange(-1, 3), 0, n - 1) for k, n in enumerate(values.shape))
    return values[z[:, :, None, None], y[:, None, :, None], x[:, None, None, :]].astype(np.float64)


def bezier_values(around: np.ndarray) -> np.ndarray:
    """Return the Bezier coefficients (N, 4, 4, 4) of pieces of splines with the values (N, 4, 4, 4)."""
    return np.einsum("nkji,ck,bj,ai->ncba", around, BEZIER, BEZIER, BEZIER, optimize=True)


def _spline_passed(values: np.ndarray) -> np.ndarray:
    passed = (_extreme(values, np.minimum) < 0.0) & (_extreme(values, np.maximum) >= 0.0)
    candidates = np.argwhere(passed)
    for start in range(0, len(candidates), CHUNK):
        rows = candidates[start : start + CHUNK]
        around = spline_values(values, rows)
        bezier = bezier_values(around).reshape(len(rows), -1)
        slack = ROUNDING * np.abs(around).max(axis=(1, 2, 3))
        passed[tuple(rows.T)] = (bezier.min(axis=1) < slack) & (bezier.max(axis=1) > -slack)
    return passed


def _extreme(values: np.ndarray, pick: np.ufunc) -> np.ndarray:
    """Return the least, or largest, of the 64 values around each voxel."""
    for axis in range(3):
        found = pick(values[_part(axis, 0, -1)], values[_part(axis, 1, None)])
        for own, other in ((_part(axis, 1, None), _part(axis, 0, -2)), (_part(axis, 0, -1), _part(axis, 2, None))):
            pick(found[own], values[other], out=found[own])
        values = found
    return values

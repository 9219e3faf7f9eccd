"""Shapes that are the zero set of a grid of signed distances: the reader (``kernels/primitive/sdfgrid.py``)."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from .bsdfs import BsdfDescription, model_of
from .description import Network, SdfGrid, ShapeDescription
from .errors import SceneError, error
from .exact import singular
from .layout import SHAPE_GRID, Parameter
from .transforms import transform_points
from .volume_files import MOST_VALUES, read_vol

if TYPE_CHECKING:
    from .plugins import Properties
    from .scene import Scene

#: The plugin.
SDFGRID = "sdfgrid"
#: Corners of its box.
CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)), np.float32)
#: What the errors offer.
INSTEAD = "extract its triangles (wp.MarchingCubes, skimage.measure.marching_cubes) and give them as a 'mesh'"
#: Bezier coefficients of a piece of a uniform cubic B-spline by its four values.
BEZIER = np.array([[1, 4, 1, 0], [0, 4, 2, 0], [0, 2, 4, 0], [0, 1, 4, 1]]) / 6.0
#: Rounding of the device's Bezier coefficients, over the greatest value; and voxels at a time.
ROUNDING, CHUNK = 1.0e-6, 65536
#: Textures that are read by texture coordinates.
_READ_UV = ("bitmap", "checkerboard")


def read_grid(props: Properties) -> SdfGrid:
    """Take the values of a ``sdfgrid`` and how its shading normals are found.

    Raises:
        ValueError: there are none, they are no grid, or not finite.
    """
    if props.has("face_normals"):
        raise error(props.where, f"'face_normals' on a '{SDFGRID}'", "say 'normals': 'analytic'")
    cubic = props.string("interpolation", "linear", ("linear", "cubic")) == "cubic"
    normals = props.string("normals", "analytic" if cubic else "smooth", ("smooth", "analytic"))
    if cubic and normals == "smooth":
        problem = f"'smooth' normals on a cubic '{SDFGRID}', whose own normals are smooth"
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
    return SdfGrid(np.ascontiguousarray(values), normals == "smooth", cubic)


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


def follow_grids(scene: Scene, changed: Iterable[Parameter], held: np.ndarray) -> None:
    """Let what rays walk by follow the grids that have changed; ``held``: the flat values on the host."""
    for p in changed:
        grid = scene.description.shapes[p.owner].grid if SHAPE_GRID in p.uses else None
        if grid is not None:
            found = walk_values(held[p.offset : p.offset + p.size].reshape(p.shape), grid.cubic)
            scene.values[p.offset + p.size : p.offset + p.size + found.size].assign(found)


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


def refuse_textures(props: Properties, bsdf: BsdfDescription, instead: str) -> None:
    """Raise for a material that reads texture coordinates, which there are none of.

    Raises:
        ValueError: with ``instead``.
    """
    for side in bsdf.sides:
        for name, texture in side.textures.items():
            if texture.kind in _READ_UV:
                problem = f"a '{texture.kind}' for '{name}' on a '{props.type}', which has no texture coordinates"
                raise error(props.where, problem, f"give a number or a colour, or {instead}")
        if any(side.textures.get(u) is not side.textures.get(v) for u, v in model_of(side).axes):
            problem = f"two roughnesses on a '{props.type}', which has no texture coordinates to align them with"
            raise error(props.where, problem, "give one 'alpha'")


def field_shape(
    props: Properties, held: SdfGrid | Network, to_world: np.ndarray, bsdf: BsdfDescription, instead: str
) -> ShapeDescription:
    """Return the shape that is the zero set of a grid or of a network, to which its sides are added.

    ``instead``: what an error offers.

    Raises:
        ValueError: its pose has no inverse, or its material reads texture coordinates.
    """
    reason = singular(to_world)
    if reason:
        raise error(props.where, reason, "give it an extent along all axes")
    refuse_textures(props, bsdf, instead)
    shape = ShapeDescription(
        path=props.path,
        kind=props.type,
        vertices=transform_points(to_world, CORNERS).astype(np.float32),
        faces=np.zeros((0, 3), np.int32),
        bsdf=bsdf,
        to_world=to_world.astype(np.float32),
        local_vertices=CORNERS,
        primitive=props.type,
    )
    if isinstance(held, SdfGrid):
        shape.grid = held
        shape.primitive = f"cubic {SDFGRID}" if held.cubic else SDFGRID
    else:
        shape.network = held
    return shape

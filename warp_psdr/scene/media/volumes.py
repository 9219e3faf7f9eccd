"""Volumes: constants and grids of voxels, which give the coefficients of media."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from warp_psdr.scene.description import VolumeDescription
from warp_psdr.scene.errors import ReportedError, SceneError, error
from warp_psdr.scene.files.nanovdb_files import read_nvdb
from warp_psdr.scene.files.volume_files import MOST_VALUES, read_vol
from warp_psdr.scene.materials.spectra import COLOR_TYPES, check_range, color
from warp_psdr.scene.media.super_grid import flake_areas
from warp_psdr.scene.plugins import Properties, category_of, unsupported_plugin

if TYPE_CHECKING:
    from warp_psdr.scene.context import Context

_FILTERS = ("trilinear", "nearest")
_WRAPS = ("clamp", "repeat", "mirror")


def volume(props: Properties, name: str, default: float, high: float, *, grids: bool) -> VolumeDescription:
    """Take a coefficient of a medium: a number, a colour, a ``constvolume`` of one, or a ``gridvolume``.

    Args:
        props: The medium.
        name: The coefficient.
        default: Its value when it is not given.
        high: Largest admissible value.
        grids: Whether it may vary; it then fills the unit cube of its ``to_world``.
    """
    parameter = f"{props.path}.{name}"
    unit = np.eye(4) if grids else None

    def read() -> VolumeDescription:
        value, place = props.take(name, default), props.place(name)
        if isinstance(value, dict):
            value, place = props.context.resolve(value, props.context.inside(props.where, name, value))
            if id(value) in props.context.broken:
                raise ReportedError(place)
            if value["type"] not in COLOR_TYPES:
                if category_of(value, place) != "volume":
                    raise unsupported_plugin(value["type"], place, "volume")
                inner = Properties(value, place, parameter, props.context)
                if inner.type == "gridvolume":
                    if not grids:
                        raise error(place, f"a grid in a '{props.type}' medium", "make the medium 'heterogeneous'")
                    return _grid(inner, name, high)
                return _constant(inner, name, high, grids=grids)
        numbers = color(value, place, props.context, high=high)
        check_range(numbers, place, 0.0, high, f"'{name}'")
        return VolumeDescription(f"{parameter}.value.value", numbers, unit)

    failed = VolumeDescription(f"{parameter}.value.value", np.full(1, default, np.float32), unit)
    return props.context.attempt(read, failed)


def _constant(props: Properties, name: str, high: float, *, grids: bool) -> VolumeDescription:
    value, place = props.take("value", 1.0), props.place("value")
    if isinstance(value, dict):
        value, place = props.context.resolve(value, props.context.inside(props.where, "value", value))
        if value.get("type") not in COLOR_TYPES:
            raise error(place, f"a '{value.get('type')}' in a 'constvolume'", "give a number or a colour")
    numbers = color(value, place, props.context, high=high)
    check_range(numbers, place, 0.0, high, f"'{name}'")
    matrix = props.transform("to_world") if grids else None
    props.finish()
    return VolumeDescription(f"{props.path}.value.value", numbers, matrix)


def _grid(props: Properties, name: str, high: float) -> VolumeDescription:
    values, matrix, place = _voxels(props, (1, 3), "(Z, Y, X), (Z, Y, X, 1) or (Z, Y, X, 3)")
    check_range(values, place, 0.0, high, f"'{name}'")
    most = props.number("max_value", np.inf, minimum=-np.inf) if props.has("max_value") else np.inf
    if values.max() > most:
        raise error(
            props.place("max_value"),
            f"got {most:g}, and the grid has values up to {values.max():g}, where tracking would be wrong",
            "leave it out",
        )
    return _placed(props, values, matrix)


def _placed(props: Properties, values: np.ndarray, matrix: np.ndarray) -> VolumeDescription:
    """Take how a grid is read, and finish its plugin."""
    filter_type = cast(Literal["trilinear", "nearest"], props.string("filter_type", "trilinear", _FILTERS))
    wrap = cast(Literal["clamp", "repeat", "mirror"], props.string("wrap_mode", "clamp", _WRAPS))
    props.finish()
    return VolumeDescription(f"{props.path}.data", values, matrix, filter_type, wrap)


def flakes(props: Properties) -> VolumeDescription:
    """Take the matrices of a ``sggx``: six numbers, as they are or in a text, or a ``gridvolume`` of six channels.

    Raises:
        ValueError: there are others, or a matrix is not positive definite.
    """
    if not props.has("S"):
        raise error(props.where, "there is no 'S'", "give S_xx, S_yy, S_zz, S_xy, S_xz, S_yz")
    given, place = props.take("S"), props.place("S")
    name = f"{props.path}.S"
    if isinstance(given, dict):
        given, place = props.context.resolve(given, props.context.inside(props.where, "S", given))
        if given.get("type") != "gridvolume":
            raise error(
                place, f"a '{given.get('type')}' for 'S'", "give six numbers, or a 'gridvolume' of six channels"
            )
        inner = Properties(given, place, name, props.context)
        values, matrix, place = _voxels(inner, (6,), "(Z, Y, X, 6): S_xx, S_yy, S_zz, S_xy, S_xz, S_yz")
        inner.ignore("max_value", reason="the largest projected area is computed")
        found = _placed(inner, values, matrix)
    else:
        try:
            plain = given.replace(",", " ").split() if isinstance(given, str) else given
            values = np.asarray(plain.numpy() if hasattr(plain, "numpy") else plain, dtype=np.float32)
        except (TypeError, ValueError):
            values = np.empty(0, np.float32)
        if values.shape != (6,):
            raise error(place, f"got {given!r}", "give six numbers: S_xx, S_yy, S_zz, S_xy, S_xz, S_yz")
        found = VolumeDescription(name, values)
    _most, problem = flake_areas(values)
    if problem:
        remedy = "give a symmetric, positive definite matrix, such as 1, 1, 1, 0, 0, 0 (where nothing is, too)"
        raise error(place, problem, remedy)
    return found


def _voxels(props: Properties, channels: tuple[int, ...], shapes: str) -> tuple[np.ndarray, np.ndarray, str]:
    """Take the values of a grid, where it is, and the place of its values; ``shapes``: of arrays, for messages."""
    given = [key for key in ("filename", "data", "grid") if props.has(key)]
    sources = {key: props.take(key) for key in ("filename", "data", "grid")}
    if len(given) != 1:
        problem = f"got {' and '.join(given)}" if given else "there are no values"
        raise error(
            props.where, problem, "give one of 'filename' (a .vol or .nvdb file) and 'data' (an array (Z, Y, X))"
        )
    place, value = props.place(given[0]), sources[given[0]]
    box = np.eye(4)
    if given[0] == "filename":
        values, box = _file(props.context, value, place)
    else:
        values = _array(value, place)
    values = _checked(values, place, channels, shapes)
    props.context.count(values.size, place)
    if not props.boolean("use_grid_bbox", False):
        box = np.eye(4)
    elif given[0] != "filename":
        props.context.note(f"{props.place('use_grid_bbox')} is ignored: an array has no box")
    props.ignore("accel", reason="grids are kept as 32-bit floats")
    props.boolean("raw", False)  # no colour of a medium is converted
    return values, props.transform("to_world") @ box, place


def _file(context: Context, name: Any, place: str) -> tuple[np.ndarray, np.ndarray]:
    ending = name.lower() if isinstance(name, str) else ""
    if ending.endswith(".vdb"):
        remedy = "nanovdb_convert makes a .nvdb file of it; or give its values as 'data', an array (Z, Y, X)"
        raise error(place, f"'{name}' is a .vdb file, which is not read", remedy)
    file = context.file(name, place)
    try:
        values, box = read_nvdb(file) if ending.endswith(".nvdb") else read_vol(file)
    except ValueError as problem:
        raise SceneError(f"{place}: {problem}") from None
    return values, box


def _array(value: Any, place: str) -> np.ndarray:
    try:
        values = np.asarray(value.numpy() if hasattr(value, "numpy") else value)
        values = values.astype(np.float32) if values.dtype.kind in "iuf" else np.empty(0, np.float32)
    except (TypeError, ValueError):
        values = np.empty(0, np.float32)
    return values


def _checked(given: np.ndarray, place: str, channels: tuple[int, ...], shapes: str) -> np.ndarray:
    values = given[..., None] if given.ndim == 3 else given
    if values.ndim != 4 or 0 in values.shape or values.shape[3] not in channels:
        shape = f"the shape {given.shape}" if given.ndim else "no array"
        raise error(place, f"got {shape}", f"give numbers {shapes}")
    if values.size > MOST_VALUES:
        raise error(place, f"got {values.size} values", f"give at most {MOST_VALUES}")
    return np.ascontiguousarray(values)

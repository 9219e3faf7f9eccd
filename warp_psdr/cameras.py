"""Cameras of photographs: sensor dictionaries from OpenCV's numbers, and from files of COLMAP and nerfstudio.

Each function returns what ``psdr.load_dict`` takes, with a film of one pixel per pixel of the photograph under a box
filter. Film positions count from the top left corner, in which OpenCV's count from the centre of the top left pixel.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

__all__ = ["from_colmap", "from_nerfstudio", "from_opencv"]

#: OpenCV's camera looks along +z with x to the right and y down, ours has x to the left and y up.
_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0])
#: OpenGL's, and so nerfstudio's, looks along -z with x to the right and y up.
_FROM_OPENGL = np.diag([-1.0, 1.0, -1.0])
#: Order of OpenCV's vector of coefficients, and of its fisheye's.
_DIST = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE = ("k1", "k2", "k3", "k4")
#: Largest difference from 1 of a rotation's products, and relative one of two focal lengths that are equal.
_ROTATION, _EQUAL = 1e-4, 1e-9
#: COLMAP's models by their numbers in binary files: name, and names of the parameters; f stands for fx and fy.
_COLMAP = {
    0: ("SIMPLE_PINHOLE", "f cx cy"),
    1: ("PINHOLE", "fx fy cx cy"),
    2: ("SIMPLE_RADIAL", "f cx cy k1"),
    3: ("RADIAL", "f cx cy k1 k2"),
    4: ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    6: ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    8: ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    9: ("RADIAL_FISHEYE", "f cx cy k1 k2"),
}
_UNDISTORT = "undistort the photographs (colmap image_undistorter)"


def from_opencv(
    K: Any,
    R: Any,
    t: Any,
    size: Sequence[int],
    dist: Any = None,
    *,
    fisheye: bool = False,
) -> dict[str, Any]:
    """Return the camera that OpenCV's calibration describes, as a sensor dictionary.

    Args:
        K: (3, 3) camera matrix, pixels; the centre of the top left pixel is (0, 0).
        R: (3, 3) rotation from the world to the camera, or (3,) a rotation vector (``cv2.Rodrigues``).
        t: (3,) translation: a point x of the world is at R x + t.
        size: width and height of the photograph, pixels.
        dist: OpenCV's vector of 4, 5 or 8 coefficients, of a fisheye 4. None: no distortion. Zeros give a lens whose
            coefficients are parameters, to be found.
        fisheye: ``dist`` is that of ``cv2.fisheye``.

    Returns:
        The dictionary of a ``perspective`` sensor for ``psdr.load_dict``.

    Raises:
        ValueError: shapes are wrong, R is no rotation, or ``dist`` has coefficients that are not supported.
    """
    matrix, rotation, move = _array("K", K, (3, 3)), np.asarray(R, np.float64), _array("t", t, (3,))
    turned = rotation.size == 3
    rotation = Rotation.from_rotvec(rotation.reshape(-1)).as_matrix() if turned else _array("R", R, (3, 3))
    if abs(rotation @ rotation.T - np.eye(3)).max() > _ROTATION or np.linalg.det(rotation) < 0.0:
        raise ValueError("from_opencv: R is no rotation; give the (3, 3) matrix or the (3,) vector of a pose")
    if abs(matrix[[1, 2, 2], [0, 0, 1]]).max() > 0.0 or matrix[2, 2] != 1.0 or min(matrix[0, 0], matrix[1, 1]) <= 0.0:
        raise ValueError(f"from_opencv: K is {matrix.tolist()}; expected [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]")
    coefficients = None
    if dist is not None or fisheye:
        coefficients = _coefficients(() if dist is None else np.asarray(dist, np.float64).reshape(-1).tolist(), fisheye)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T @ _FROM_OPENCV, -rotation.T @ move
    # Where the centre of a pixel has whole numbers, its corner is half a pixel less.
    center = (matrix[0, 2] + 0.5, matrix[1, 2] + 0.5)
    focal = (matrix[0, 0], matrix[1, 1])
    return _sensor(pose, size, focal, center, matrix[0, 1] / focal[0], coefficients, fisheye, "from_opencv")


def from_colmap(folder: str | PathLike[str]) -> dict[str, dict[str, Any]]:
    """Return the cameras of a COLMAP reconstruction: name of each photograph -> sensor dictionary.

    Args:
        folder: it holds ``cameras.bin`` and ``images.bin``, or ``cameras.txt`` and ``images.txt`` (``sparse/0``).

    Returns:
        The sensors in the order of the photographs' names.

    Raises:
        FileNotFoundError: the files are not there.
        ValueError: a model is not supported, or a file is damaged.
    """
    where = Path(folder)
    for suffix, cameras, images in ((".bin", _binary_cameras, _binary_images), (".txt", _text_cameras, _text_images)):
        files = [where / f"{name}{suffix}" for name in ("cameras", "images")]
        if all(file.is_file() for file in files):
            try:
                lenses, poses = cameras(files[0]), images(files[1])
            except (struct.error, IndexError, UnicodeDecodeError) as damage:
                raise ValueError(f"{where}: {files[0].name} or {files[1].name} ends too early") from damage
            return {name: _colmap_sensor(name, pose, lenses, camera) for name, pose, camera in sorted(poses)}
    raise FileNotFoundError(f"{where}: no cameras.bin and images.bin, nor .txt; give COLMAP's folder 'sparse/0'")


def from_nerfstudio(path: str | PathLike[str], size: Sequence[int] | None = None) -> dict[str, dict[str, Any]]:
    """Return the cameras of a ``transforms.json``: file name of each photograph -> sensor dictionary.

    The files of nerfstudio, instant-ngp and NeRF's synthetic scenes are read. Poses are those of the file, in whose
    world +z is up as a rule.

    Args:
        path: the file, or the folder that holds it.
        size: width and height of the photographs, for files that do not tell.

    Returns:
        The sensors in the order of the file.

    Raises:
        FileNotFoundError: the file is not there.
        ValueError: it is damaged, lacks numbers, or has a model that is not supported.
    """
    file = Path(path)
    file = file / "transforms.json" if file.is_dir() else file
    try:
        told = json.loads(file.read_text(encoding="utf-8"))
        return {frame["file_path"]: _frame({**told, **frame}, size, file) for frame in told["frames"]}
    except (json.JSONDecodeError, KeyError, TypeError) as damage:
        raise ValueError(f"{file}: not a transforms.json: {damage!r}") from damage


def _array(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return finite numbers of a shape; a column counts as a vector."""
    found = np.asarray(value, np.float64)
    if found.size == np.prod(shape) and len(shape) == 1:
        found = found.reshape(shape)
    if found.shape != shape or not np.isfinite(found).all():
        raise ValueError(f"from_opencv: {name} has the shape {found.shape}; expected {shape}, finite")
    return found


def _coefficients(given: Sequence[float], fisheye: bool) -> dict[str, float]:
    names = _FISHEYE if fisheye else _DIST
    counts = (0, 4) if fisheye else (0, 4, 5, 8)
    values = list(given)
    if not fisheye and len(values) in (12, 14) and not any(values[8:]):
        values = values[:8]
    if len(values) not in counts:
        expected = ", ".join(map(str, counts[1:]))
        raise ValueError(
            f"from_opencv: dist has {len(values)} numbers, expected {expected} (k1, k2, ...); thin prisms and tilted "
            "sensors are not supported: calibrate without, or undistort the photograph"
        )
    return dict(zip(names, values, strict=False))


def _sensor(
    pose: np.ndarray,
    size: Sequence[int],
    focal: tuple[float, float],
    center: tuple[float, float],
    skew: float,
    coefficients: dict[str, float] | None,
    fisheye: bool,
    where: str,
) -> dict[str, Any]:
    """Return the dictionary; ``center`` counts pixels from the corner of the film."""
    width, height = (int(n) for n in size)
    if min(width, height) < 1 or (width, height) != tuple(size):
        raise ValueError(f"{where}: the size is {size}; expected width and height in pixels")
    if not (min(focal) > 0.0 and np.isfinite([*focal, *center, skew]).all()):
        raise ValueError(f"{where}: focal lengths {focal} and principal point {center}; expected positive, finite ones")
    sensor: dict[str, Any] = {
        "type": "perspective",
        "to_world": pose,
        "fov": float(np.degrees(2.0 * np.arctan(0.5 * width / focal[0]))),
        "principal_point_offset_x": float(0.5 - center[0] / width),
        "principal_point_offset_y": float(0.5 - center[1] / height),
        "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
    }
    if abs(focal[1] / focal[0] - 1.0) > _EQUAL:
        sensor["pixel_aspect"] = float(focal[1] / focal[0])
    if skew != 0.0:
        sensor["skew"] = float(skew)
    if coefficients is not None:
        sensor |= {"distortion": "fisheye" if fisheye else "opencv", **coefficients}
    return sensor


# ---- COLMAP ----

_Lens = tuple[str, tuple[int, int], dict[str, float]]
_Pose = tuple[str, np.ndarray, int]


def _lens(model: str, size: tuple[int, int], values: Sequence[float], where: Path) -> _Lens:
    names = {name: parameters.split() for name, parameters in _COLMAP.values()}
    if model not in names:
        raise ValueError(
            f"{where}: the camera model {model} is not supported; {_UNDISTORT}; supported: {', '.join(names)}"
        )
    if len(values) != len(names[model]):
        raise ValueError(f"{where}: {model} with {len(values)} parameters; expected {len(names[model])}")
    return model, size, dict(zip(names[model], values, strict=True))


def _binary_cameras(file: Path) -> dict[int, _Lens]:
    data = file.read_bytes()
    (count,), at, found = struct.unpack_from("<Q", data), 8, {}
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        at += 24
        if model not in _COLMAP:
            _lens(f"number {model}", (width, height), (), file)
        name, parameters = _COLMAP[model]
        values = struct.unpack_from(f"<{len(parameters.split())}d", data, at)
        at += 8 * len(values)
        found[number] = _lens(name, (width, height), values, file)
    return found


def _binary_images(file: Path) -> list[_Pose]:
    data = file.read_bytes()
    (count,), at, found = struct.unpack_from("<Q", data), 8, []
    for _ in range(count):
        _number, *pose, camera = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64) if b"\0" in data[at + 64 :] else len(data)
        name = data[at + 64 : end].decode("utf-8")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points
        found.append((name, np.array(pose), camera))
    return found


def _lines(file: Path) -> Iterable[str]:
    return [line for line in file.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]


def _text_cameras(file: Path) -> dict[int, _Lens]:
    found = {}
    for line in filter(str.strip, _lines(file)):
        number, model, width, height, *values = _words(file, line, 4, -1)
        size, numbers = _numbers(file, line, [number, width, height]), _numbers(file, line, values)
        found[int(size[0])] = _lens(model, (int(size[1]), int(size[2])), numbers, file)
    return found


def _text_images(file: Path) -> list[_Pose]:
    # Behind each photograph a line lists its points; it may be empty.
    found = []
    for line in filter(str.strip, list(_lines(file))[::2]):
        *told, name = _words(file, line, 10, 9)
        numbers = _numbers(file, line, told)
        found.append((name.strip(), np.array(numbers[1:8]), int(numbers[8])))
    return found


def _words(file: Path, line: str, least: int, splits: int) -> list[str]:
    words = line.split(maxsplit=splits)
    if len(words) < least:
        raise ValueError(f"{file}: got the line {line!r}; expected {least} words or more")
    return words


def _numbers(file: Path, line: str, words: Sequence[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as damage:
        raise ValueError(f"{file}: got the line {line!r}; expected numbers: {damage}") from damage


def _colmap_sensor(name: str, pose: np.ndarray, lenses: dict[int, _Lens], camera: int) -> dict[str, Any]:
    if camera not in lenses:
        raise ValueError(f"{name}: the photograph's camera {camera} is not in the file of cameras")
    model, size, values = lenses[camera]
    w, x, y, z = pose[:4]
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = rotation.T @ _FROM_OPENCV, -rotation.T @ pose[4:]
    # COLMAP's principal point counts from the corner of the image, as ours.
    focal = (values.get("fx", values.get("f", 0.0)), values.get("fy", values.get("f", 0.0)))
    coefficients = {n: v for n, v in values.items() if n in _DIST} or None
    return _sensor(to_world, size, focal, (values["cx"], values["cy"]), 0.0, coefficients, "FISHEYE" in model, name)


# ---- nerfstudio ----


def _frame(told: dict[str, Any], size: Sequence[int] | None, file: Path) -> dict[str, Any]:
    """Return the sensor of a frame; ``told`` holds its numbers and those of all frames."""
    where = f"{file}, {told['file_path']}"
    model = str(told.get("camera_model", "OPENCV"))
    models = ("OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
    if model not in models:
        raise ValueError(f"{where}: the camera model {model} is not supported; supported: {', '.join(models)}")
    if size is None and not {"w", "h"} <= set(told):
        raise ValueError(f"{where}: it does not tell the size of the photographs; give from_nerfstudio(path, size)")
    width, height = (int(n) for n in (size if size is not None else (told["w"], told["h"])))
    if "fl_x" in told:
        across = float(told["fl_x"])
        focal = (across, float(told.get("fl_y", across)))
    elif "camera_angle_x" in told:
        across = 0.5 * width / np.tan(0.5 * float(told["camera_angle_x"]))
        up = 0.5 * height / np.tan(0.5 * float(told["camera_angle_y"])) if "camera_angle_y" in told else across
        focal = (across, up)
    else:
        raise ValueError(f"{where}: expected 'fl_x' or 'camera_angle_x'")
    fisheye = model == "OPENCV_FISHEYE"
    names = _FISHEYE if fisheye else ("k1", "k2", "p1", "p2", "k3")
    if not fisheye and float(told.get("k4", 0.0)) != 0.0:
        raise ValueError(f"{where}: 'k4' is of another series than OpenCV's; fit the camera without it")
    coefficients = {n: float(told[n]) for n in names if n in told}
    if not any(coefficients.values()):  # files tell zeros of cameras without distortion
        coefficients = {}
    lens = coefficients if coefficients or fisheye else None
    to_world = np.eye(4)
    to_world[:3] = np.asarray(told["transform_matrix"], np.float64)[:3]
    to_world[:3, :3] = to_world[:3, :3] @ _FROM_OPENGL
    center = (float(told.get("cx", 0.5 * width)), float(told.get("cy", 0.5 * height)))
    return _sensor(to_world, (width, height), focal, center, 0.0, lens, fisheye, where)

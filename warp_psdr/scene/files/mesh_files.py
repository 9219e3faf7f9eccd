"""Read mesh files without merging, splitting or reordering vertices.

glTF, STL, OFF and most PLY files go through trimesh's format readers, others through ``obj_files`` and ``ply_files``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from warp_psdr.scene.context import Context
from warp_psdr.scene.errors import SceneError, error
from warp_psdr.scene.files.obj_files import read_obj
from warp_psdr.scene.files.ply_files import read_text_ply
from warp_psdr.scene.files.serialized_files import read_serialized
from warp_psdr.scene.shapes.meshes import FaceMaterials, MeshData, fans, vertex_normals
from warp_psdr.scene.transforms import transform_normals, transform_points

T = TypeVar("T")
#: Component suffixes that group PLY properties into one attribute.
_SUFFIXES = ("xyzw", "rgba", "0123", "1234")
_COLOR_NAMES = {"r": 0, "g": 1, "b": 2, "a": 3, "red": 0, "green": 1, "blue": 2, "alpha": 3}
_REEXPORT = "export the mesh again"


def read_mesh(
    kind: str, file: Path, where: str, note: Any, index: int = 0, find: Callable[[str], Path] | None = None
) -> MeshData:
    """Read a mesh file; texture coordinates are as the file has them.

    Args:
        kind: "obj", "ply", "serialized", "gltf", "glb", "stl" or "off".
        file: An existing file.
        where: Place in the scene, for messages.
        note: Called with remarks for the user.
        index: Number of the mesh in the file ("serialized").
        find: Returns the existing file that a name in the file stands for, or raises; None: in or below its folder.

    Raises:
        ValueError: If the file, or one that it names, cannot be read.
        FileNotFoundError: If a file that it names does not exist.
    """
    readers = {"obj": read_obj, "ply": _read_ply}
    place = f"{where}, file '{file}'"
    if kind in ("gltf", "glb"):
        beside = Context(str(file), file.parent)
        return _read_gltf(file, place, find or (lambda name: beside.file(name, place)))
    if kind == "serialized":
        return read_serialized(file, index, place, note)
    if kind in readers:
        return readers[kind](file, place, note)
    from trimesh.exchange import off, stl

    def load(stream: BinaryIO) -> MeshData:
        values = off.load_off(stream) if kind == "off" else stl.load_stl(stream)
        # A text STL may hold several solids, or none.
        return _joined([_part(part, np.eye(4)) for part in values.get("geometry", {"": values}).values()])

    return _guarded(load, file, place)


def _guarded(load: Callable[[BinaryIO], T], file: Path, place: str) -> T:
    """Read a file with one of trimesh's readers, and turn whatever it raises into a message."""
    try:
        # NaN among whole numbers is an error; too large numbers become infinite, which the checks report.
        with file.open("rb") as stream, np.errstate(over="ignore", invalid="raise"):
            return load(stream)
    except (SceneError, FileNotFoundError):  # of a file that this one names
        raise
    except Exception as problem:
        reason = str(problem) or type(problem).__name__
        raise error(place, f"the file is damaged or of another format ({reason})", _REEXPORT) from None


def _read_ply(file: Path, place: str, note: Any) -> MeshData:
    from trimesh.exchange import ply

    def load(stream: BinaryIO) -> dict[str, Any]:
        return ply.load_ply(stream, fix_texture=False, skip_materials=True)["metadata"]["_ply_raw"]

    raw = read_text_ply(file) or _guarded(load, file, place)
    for element in ("vertex", "face"):
        if element not in raw:
            raise error(place, f"there is no element '{element}'", "only triangle or polygon meshes are supported")
    vertex, face = _columns(raw["vertex"], "vertex", place), _columns(raw["face"], "face", place)
    index_name = next((name for name in ("vertex_indices", "vertex_index") if name in face), None)
    if index_name is None:
        raise error(place, "the faces have no 'vertex_indices'", _REEXPORT)
    polygons = face.pop(index_name)
    counts = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    corners = np.concatenate(polygons).astype(np.int64) if len(polygons) else np.empty(0, dtype=np.int64)
    if any(name not in vertex for name in "xyz"):
        raise error(place, "the vertices lack x, y or z", _REEXPORT)
    data = MeshData(_stack([vertex.pop(name) for name in "xyz"], np.float64), fans(corners, counts))
    if all(name in vertex for name in ("nx", "ny", "nz")):
        data.normals = _stack([vertex.pop(name) for name in ("nx", "ny", "nz")], np.float64)
    for names in (("u", "v"), ("s", "t"), ("texture_u", "texture_v")):
        if all(name in vertex for name in names):
            data.texcoords = _stack([vertex.pop(name) for name in names], np.float64)
            break
    data.attributes = _ply_attributes(vertex, "vertex_", place, note)
    for name, values in _ply_attributes(face, "face_", place, note).items():
        data.attributes[name] = np.repeat(values, np.maximum(counts - 2, 0), axis=0)
    return data


def _columns(element: dict, name: str, place: str) -> dict[str, Any]:
    """Return the properties of a PLY element; raises if the file ends before all of them."""
    data = element.get("data")
    if element["length"] == 0 or data is None:
        return dict.fromkeys(element["properties"], np.empty(0))
    names = list(element["properties"])
    columns = {
        key: (data[key] if isinstance(data, dict) else data[key]["f1"] if data[key].dtype.names else data[key])
        for key in names
        if key in (data if isinstance(data, dict) else data.dtype.names)
    }
    short = [key for key in names if key not in columns or len(columns[key]) != element["length"]]
    lists = [key for key in names if key not in short and np.asarray(columns[key]).dtype.kind == "O"]
    lists = [key for key in lists if not key.startswith("vertex_ind")]
    if lists:
        raise error(place, f"property '{lists[0]}' of the {name} items is a list", "only vertex_indices may be one")
    if short:
        raise error(
            place,
            f"the file ends early: property '{short[0]}' of {element['length']} {name} items is cut off",
            _REEXPORT,
        )
    return columns


def _ply_attributes(columns: dict[str, Any], prefix: str, place: str, note: Any) -> dict[str, np.ndarray]:
    """Group properties as Mitsuba does: r, g, b -> "color"; a_x, a_y, a_z -> "a"; a_r, a_g, a_b -> "a_color"."""
    groups: dict[str, dict[int, np.ndarray]] = {}
    for name, values in columns.items():
        stem, _, suffix = name.rpartition("_")
        if name in _COLOR_NAMES:
            stem, position = "color", _COLOR_NAMES[name]
        elif stem and len(suffix) == 1 and any(suffix in letters for letters in _SUFFIXES):
            position = next(letters.index(suffix) for letters in _SUFFIXES if suffix in letters)
            position = position if not suffix.isdigit() or f"{stem}_0" in columns else int(suffix) - 1
            stem += "_color" if suffix in "rgba" else ""
        else:
            note(f"{place}: property '{name}' is ignored: its name has no component suffix such as _x, _r or _0")
            continue
        groups.setdefault(stem, {})[position] = values
    found = {}
    for stem, parts in groups.items():
        # The alpha of a colour is no part of it.
        color = stem == "color" or stem.endswith("_color")
        keys = [key for key in sorted(parts) if not color or key < 3]
        if keys not in ([0], [0, 1, 2]):
            note(f"{place}: attribute '{prefix}{stem}' is ignored: it has {len(keys)} components, expected 1 or 3")
            continue
        values = _stack([parts[key] for key in keys], np.float32)
        if parts[keys[0]].dtype.kind in "ui" and color:
            values /= np.iinfo(parts[keys[0]].dtype).max
            note(f"{place}: the whole-number colours of '{prefix}{stem}' were scaled to [0, 1]")
        found[f"{prefix}{stem}"] = values
    return found


def _stack(columns: list[np.ndarray], dtype: Any) -> np.ndarray:
    # What overflows becomes infinite, which the checks report; signalling NaN stays NaN.
    with np.errstate(over="ignore", invalid="ignore"):
        return np.stack([np.asarray(column).reshape(-1) for column in columns], axis=1).astype(dtype)


def _read_gltf(file: Path, place: str, find: Callable[[str], Path]) -> MeshData:
    """Read all meshes of a glTF file, placed by its nodes and joined; materials are left out."""
    from trimesh.exchange import gltf
    from trimesh.scene.transforms import SceneGraph

    from warp_psdr.scene.files.gltf_files import Buffers, geometry_only

    def load(stream: BinaryIO) -> MeshData:
        read = gltf.load_glb if file.suffix.lower() == ".glb" else gltf.load_gltf
        values = read(geometry_only(file), resolver=Buffers(find))
        graph = SceneGraph(base_frame=values.get("base_frame", "world"))
        for edge in values.get("graph", ()):
            graph.update(**edge)
        placed = [graph.get(node) for node in graph.nodes_geometry]
        parts = [(values["geometry"][name], np.asarray(matrix, dtype=np.float64)) for matrix, name in placed]
        return _joined([_part(part, matrix) for part, matrix in parts if len(part.get("faces", ()))])

    return _guarded(load, file, place)


def _joined(parts: list[MeshData]) -> MeshData:
    """Return one mesh of all parts; where only some have normals or texture coordinates, the others get some."""
    if not parts:
        return MeshData(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64))
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    data = MeshData(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts[:-1], strict=True)]),
    )
    if any(part.normals is not None for part in parts):
        data.normals = np.concatenate(
            [vertex_normals(p.vertices, p.faces) if p.normals is None else p.normals for p in parts]
        )
    if any(part.texcoords is not None for part in parts):
        data.texcoords = np.concatenate(
            [np.zeros((len(p.vertices), 2)) if p.texcoords is None else p.texcoords for p in parts]
        )
    if any(part.materials is not None for part in parts):
        none = [np.full(len(p.faces), -1) if p.materials is None else p.materials.faces for p in parts]
        data.materials = FaceMaterials(np.concatenate(none), [])
    return data


def _part(part: dict, matrix: np.ndarray) -> MeshData:
    """Return a mesh of trimesh's readers, moved by ``matrix``."""
    faces = np.asarray(part["faces"], dtype=np.int64).reshape(-1, 3)
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        # A mirrored node keeps its front side (glTF 2.0, section 3.7.4).
        faces = faces[:, ::-1]
    data = MeshData(transform_points(matrix, np.reshape(part["vertices"], (-1, 3))), faces)
    if part.get("vertex_normals") is not None:
        data.normals = transform_normals(matrix, part["vertex_normals"])
    uv = getattr(part.get("visual"), "uv", None)
    data.texcoords = None if uv is None else np.asarray(uv, dtype=np.float64)
    number = getattr(getattr(part.get("visual"), "material", None), "name", None)  # see ``geometry_only``
    if number is not None:
        data.materials = FaceMaterials(np.full(len(faces), int(number)), [])
    return data

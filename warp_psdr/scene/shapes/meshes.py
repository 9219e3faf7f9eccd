"""Triangle meshes: checks, repairs, vertex normals, and meshes given in place."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_psdr.scene.errors import error
from warp_psdr.scene.plugins import Properties

if TYPE_CHECKING:
    from warp_psdr.scene.description import ShapeDescription

#: Largest coordinate: products of four lengths must stay finite in float32.
_COORDINATE_MAX = 1e9
#: A triangle is flat when its area is below this share of its longest edge squared; float32 holds no such area.
_FLAT = 1e-9
#: Most triangles of a directional area light: each look-up goes through all of them.
PROJECTED_MAX = 1024
#: Largest deviation from a plane of its shape, relative.
FLAT = 1e-5
#: Bound on what one in-place array may hold; larger indices do not fit 32 bits.
_INDEX_MAX = 2**31 - 1


@dataclass(eq=False)
class FaceMaterials:
    """The materials that a mesh file names, as it was read."""

    faces: np.ndarray  #: (M,) number of each face's material, -1: none
    names: list[str]  #: of the materials
    files: list[str] = field(default_factory=list)  #: that hold them, where that is not the mesh file


@dataclass(eq=False)
class MeshData:
    """A mesh as it was read, object space."""

    vertices: np.ndarray  #: (N, 3)
    faces: np.ndarray  #: (M, 3)
    normals: np.ndarray | None = None  #: (N, 3), of any length
    texcoords: np.ndarray | None = None  #: (N, 2)
    attributes: dict[str, np.ndarray] = field(default_factory=dict)  #: "vertex_*": (N, C), "face_*": (M, C)
    face_normals: bool = False  #: the file asks for face normals
    materials: FaceMaterials | None = None  #: None: the file names none


def in_place(props: Properties) -> MeshData:
    """Take a mesh that a dictionary holds: ``vertices``, ``faces``, ``normals``, ``texcoords``, attributes.

    Raises:
        ValueError: If an array is missing, of a wrong shape or type, or its values do not fit.
    """
    for name in ("vertices", "faces"):
        if not props.has(name):
            raise error(props.where, f"a 'mesh' without '{name}'", f"give '{name}' of shape (N, 3)")
    # Positions stay in double precision until the scene's place is known (``origin``).
    data = MeshData(_array(props, "vertices", 3, dtype=np.float64), _indices(props))
    count = len(data.vertices)
    if props.has("normals"):
        data.normals = _array(props, "normals", 3, count)
    if props.has("texcoords"):
        data.texcoords = _array(props, "texcoords", 2, count)
    for name in [key for key in props.node if str(key).startswith(("vertex_", "face_")) and key != "face_normals"]:
        data.attributes[name] = _array(props, name, None, count if name.startswith("vertex_") else len(data.faces))
    for name in ("normals", "texcoords", "vertex_*", "face_*"):
        props.take(name)
    return data


def fans(corners: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Cut polygons, given as consecutive runs of ``corners``, into triangle fans in order, shape (M, 3)."""
    if (counts == 3).all():
        return corners.reshape(-1, 3)
    triangles = np.maximum(counts - 2, 0)
    start = np.repeat(np.cumsum(counts) - counts, triangles)
    step = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack([corners[start], corners[start + step + 1], corners[start + step + 2]], axis=1)


def check(data: MeshData, where: str) -> None:
    """Raise if a mesh cannot be rendered.

    Raises:
        ValueError: If it is empty, holds NaN or infinity, or has indices out of range.
    """
    count = len(data.vertices)
    if count == 0 or len(data.faces) == 0:
        raise error(
            where,
            f"the mesh is empty ({count} vertices, {len(data.faces)} faces)",
            "give at least three vertices and one face, or remove the shape",
        )
    for name, array in (("vertex positions", data.vertices), ("normals", data.normals), ("texcoords", data.texcoords)):
        if array is not None and not np.isfinite(array).all():
            bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
            raise error(
                where,
                f"{len(bad)} of {len(array)} {name} hold NaN or infinity (the first at index {bad[0]})",
                "repair the mesh in the program that made it",
            )
    for name, array in data.attributes.items():
        if not np.isfinite(array).all():
            raise error(where, f"attribute '{name}' holds NaN or infinity", "give finite values")
    for name, array in (
        ("vertex coordinate", data.vertices),
        ("texture coordinate", data.texcoords),
        ("coordinate of a normal", data.normals),
    ):
        largest = 0.0 if array is None else np.abs(array).max()
        if largest > _COORDINATE_MAX:
            raise error(where, f"a {name} is {largest:g}", f"scale it to below {_COORDINATE_MAX:g}")
    low, high = int(data.faces.min()), int(data.faces.max())
    if low < 0 or high >= count:
        bad = np.flatnonzero((data.faces < 0).any(axis=1) | (data.faces >= count).any(axis=1))
        raise error(
            where,
            f"face {bad[0]} has a vertex index out of range: {data.faces[bad[0]].tolist()}",
            f"indices go from 0 to {count - 1}",
        )


def drop_flat_triangles(data: MeshData, where: str) -> int:
    """Remove the triangles without area, and their attributes; vertices stay. Returns how many.

    Raises:
        ValueError: If none is left.
    """
    corners = data.vertices.astype(np.float64)[data.faces]
    edges = corners - np.roll(corners, 1, axis=1)
    double_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    keep = double_area > 2.0 * _FLAT * (edges**2).sum(axis=2).max(axis=1)
    dropped = int(len(keep) - keep.sum())
    if dropped == len(keep):
        raise error(where, f"all {dropped} triangles have zero area", "check the vertices and to_world")
    if dropped:
        data.faces = np.ascontiguousarray(data.faces[keep])
        for name, values in data.attributes.items():
            if name.startswith("face_"):
                data.attributes[name] = np.ascontiguousarray(values[keep])
    return dropped


def check_flat(shape: ShapeDescription, where: str) -> None:
    """Refuse a shape that a directional area light cannot have.

    Raises:
        ValueError: If it is not flat, or has more triangles than a look-up goes through.
    """
    reason = "it is sampled by orthogonal projection onto one plane; "
    count = len(shape.faces)
    if count > PROJECTED_MAX:
        raise error(where, f"a 'directionalarea' of {count} triangles", f"{reason}give at most {PROJECTED_MAX}")
    p0, p1, p2 = (shape.vertices[shape.faces[:, k]].astype(np.float64) for k in range(3))
    normals = np.cross(p1 - p0, p2 - p0)
    total = normals.sum(axis=0)
    length = float(np.linalg.norm(total))
    heights = (shape.vertices[shape.faces.reshape(-1)] - p0[0]) @ (total / max(length, np.finfo(float).tiny))
    areas = np.linalg.norm(normals, axis=1).sum()
    size = float(np.ptp(shape.vertices, axis=0).max())
    if length < (1.0 - FLAT) * areas or np.abs(heights).max() > FLAT * size:
        raise error(where, "a 'directionalarea' on a shape that is not flat", f"{reason}give a rectangle or a disk")


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit vertex normals, float64, shape (N, 3): face normals weighted by the angle at the vertex.

    The weighting is that of G. Thürmer and C. Wüthrich, "Computing vertex normals from polygonal facets" (1998), as
    Mitsuba's. Vertices without a face get (1, 0, 0).
    """
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    normals = np.zeros((len(vertices), 3))
    face = _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    for i in range(3):
        a = _unit(corners[:, (i + 1) % 3] - corners[:, i])
        b = _unit(corners[:, (i + 2) % 3] - corners[:, i])
        # Of a pair of unit vectors; accurate for small and large angles alike (Kahan).
        angle = 2.0 * np.arctan2(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
        np.add.at(normals, faces[:, i], face * angle[:, None])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(lengths > 1e-12, normals / np.maximum(lengths, 1e-12), [1.0, 0.0, 0.0])


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), np.finfo(np.float64).tiny)


def _array(
    props: Properties, name: str, columns: int | None, rows: int | None = None, dtype: type = np.float32
) -> np.ndarray:
    """Take a float array of shape (rows, columns); a flat one is folded."""
    value, place = _plain(props, name), props.place(name)
    wanted = f"({'N' if rows is None else rows}, {'1 or 3' if columns is None else columns})"
    if value.dtype.kind not in "fiu":
        raise error(place, f"got an array of type {value.dtype}", f"give numbers of shape {wanted}")
    if value.ndim == 1 and columns is not None and value.size % columns == 0:
        value = value.reshape(-1, columns)
    elif value.ndim == 1 and columns is None and rows:
        value = value.reshape(rows, -1) if value.size % rows == 0 else value
    fits = value.ndim == 2 and (value.shape[1] == columns if columns is not None else value.shape[1] in (1, 3))
    if not fits or (rows is not None and len(value) != rows):
        raise error(place, f"the array has shape {value.shape}", f"expected {wanted}")
    with np.errstate(over="ignore"):  # what overflows becomes infinite, which the checks report
        return np.ascontiguousarray(value, dtype=dtype)


def _indices(props: Properties) -> np.ndarray:
    value, place = _plain(props, "faces"), props.place("faces")
    if value.dtype.kind not in "iu":
        raise error(place, f"got an array of type {value.dtype}", "give whole numbers of shape (M, 3)")
    if value.ndim == 1 and value.size % 3 == 0:
        value = value.reshape(-1, 3)
    if value.ndim != 2 or value.shape[1] != 3:
        raise error(place, f"the array has shape {value.shape}", "expected (M, 3): triangles")
    if value.size and value.max() > _INDEX_MAX:
        raise error(place, f"a vertex index is {value.max()}", f"indices go up to {_INDEX_MAX}")
    return np.ascontiguousarray(value, dtype=np.int32)


def _plain(props: Properties, name: str) -> np.ndarray:
    value: Any = props.take(name)
    try:
        array = np.array(value.numpy() if hasattr(value, "numpy") else value)
    except (TypeError, ValueError):
        raise error(props.place(name), "the rows differ in length", "give a rectangular array") from None
    # An empty list has no type of its own.
    return array.astype(np.int32).reshape(-1, 3) if array.size == 0 else array

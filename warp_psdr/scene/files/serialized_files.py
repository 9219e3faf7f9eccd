"""Read Mitsuba's ``serialized`` meshes: several of them in a file, each compressed by itself.

A mesh starts with two uint16, 0x041C and the version; a zlib stream follows, little endian. Versions 3 and 4 hold flags
(uint32), in version 4 a name that ends with a zero byte, the numbers of vertices and triangles (uint64), arrays of
positions, normals, texture coordinates and colours, as the flags say and in their precision, and three uint32 a
triangle. Version 5, of Mitsuba after 3.9.1, holds records of 8 float32 a vertex (position, normal, texture coordinates)
and 4 uint32 a triangle, and attributes by name. The file ends with the offsets of its meshes (uint32 in version 3,
uint64 after) and their number (uint32).

Sizes are checked before memory is taken: deflate makes at most 1032 bytes of one.
"""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from warp_psdr.scene.errors import error
from warp_psdr.scene.shapes.meshes import MeshData

MAGIC = 0x041C
VERSIONS = (3, 4, 5)
#: Flags of versions 3 and 4.
NORMALS, TEXCOORDS, COLORS, FACE_NORMALS, DOUBLE = 0x0001, 0x0002, 0x0008, 0x0010, 0x2000
#: Flags of version 5 that differ.
TANGENTS_5, TEXCOORDS_5 = 0x0002, 0x0004
#: Most bytes that deflate makes of one.
_EXPANSION = 1032
#: Bytes that are read at once.
_CHUNK = 1 << 20
#: Letters of a name, and attributes, that are read: more than any program writes.
_NAME_MAX, _ATTRIBUTES_MAX = 1 << 12, 1 << 8
_REEXPORT = "export the mesh again"


def read_serialized(file: Path, index: int, place: str, note: Any) -> MeshData:
    """Read one mesh of a file.

    Args:
        file: An existing file.
        index: Number of the mesh in it, from 0.
        place: Place in the scene, for messages.
        note: Called with remarks for the user.

    Returns:
        The mesh, object space, colours as the attribute "vertex_color".

    Raises:
        ValueError: If the file cannot be read, lies about its sizes, or has no such mesh.
    """
    with file.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        version = _version(stream, place)
        if index:
            stream.seek(_offset(stream, size, version, index, place))
            version = _version(stream, place)
        inflated = _Inflated(stream, size - stream.tell(), place)
        (flags,) = inflated.unpack("<I")
        return (_packed if version == 5 else _arrays)(inflated, version, flags, place, note)


def _version(stream: BinaryIO, place: str) -> int:
    head = stream.read(4)
    magic, version = struct.unpack("<HH", head) if len(head) == 4 else (0, 0)
    if magic != MAGIC:
        raise error(place, "this is no serialized mesh (it does not start with 0x041C)", _REEXPORT)
    if version not in VERSIONS:
        raise error(place, f"the file has version {version} of the format", "versions 3, 4 and 5 are read")
    return version


def _offset(stream: BinaryIO, size: int, version: int, index: int, place: str) -> int:
    """Return where a mesh starts, from the table at the end of the file."""
    width = 4 if version == 3 else 8
    stream.seek(max(size - 4, 0))
    (count,) = struct.unpack("<I", stream.read(4))
    table = size - 4 - width * count
    if table < 4:
        raise error(place, f"the file names {count} meshes, for which it is too short", _REEXPORT)
    if index >= count:
        raise error(place, f"'shape_index' is {index}", f"the file holds meshes 0 to {count - 1}")
    stream.seek(table + width * index)
    offset = int.from_bytes(stream.read(width), "little")
    if offset > table - 4:
        raise error(place, f"mesh {index} starts at byte {offset}, behind the last mesh's end", _REEXPORT)
    return offset


class _Inflated:
    """A zlib stream of which as much is unpacked as is read.

    Args:
        stream: The file, where the stream starts.
        size: Bytes that are left of the file.
        place: Place in the scene, for messages.
    """

    def __init__(self, stream: BinaryIO, size: int, place: str):
        self._stream = stream
        self._most = size * _EXPANSION
        self._place = place
        self._inflate = zlib.decompressobj()

    def read(self, count: int, what: str = "header") -> bytes:
        """Return the next bytes.

        Raises:
            ValueError: There are fewer, or cannot be as many, or they are damaged.
        """
        if count > self._most:
            raise error(
                self._place, f"the file is too short for the {what} that it announces ({count} bytes)", _REEXPORT
            )
        parts, left = [], count
        try:
            while left:
                packed = self._inflate.unconsumed_tail or self._stream.read(_CHUNK)
                part = self._inflate.decompress(packed, left)
                if not part and (self._inflate.eof or not packed):
                    raise error(self._place, f"the file ends early, in the {what}", _REEXPORT)
                parts.append(part)
                left -= len(part)
        except zlib.error as problem:
            raise error(self._place, f"the {what} cannot be unpacked ({problem})", _REEXPORT) from None
        self._most -= count
        return b"".join(parts)

    def unpack(self, form: str) -> tuple:
        """Return numbers; see ``struct``."""
        return struct.unpack(form, self.read(struct.calcsize(form)))

    def array(self, rows: int, columns: int, dtype: str, what: str) -> np.ndarray:
        """Return an array of shape (rows, columns)."""
        data = self.read(rows * columns * np.dtype(dtype).itemsize, what)
        return np.frombuffer(data, dtype).reshape(rows, columns)

    def name(self) -> str:
        """Return a text whose length stands before it."""
        (length,) = self.unpack("<I")
        if length > _NAME_MAX:
            raise error(self._place, f"a name has {length} letters", _REEXPORT)
        return self.read(length, "names").decode("utf-8", "replace")


def _arrays(inflated: _Inflated, version: int, flags: int, place: str, note: Any) -> MeshData:
    """Read what follows the flags in versions 3 and 4."""
    if version == 4:
        for _ in range(_NAME_MAX):
            if inflated.read(1, "name") == b"\0":
                break
        else:
            raise error(place, f"the mesh's name has more than {_NAME_MAX} letters", _REEXPORT)
    vertices, faces = inflated.unpack("<QQ")
    number = "<f8" if flags & DOUBLE else "<f4"

    def floats(columns: int, what: str, flag: int = 0, dtype: type = np.float64) -> np.ndarray | None:
        if flag and not flags & flag:
            return None
        with np.errstate(over="ignore", invalid="ignore"):  # the checks report what overflows
            return inflated.array(vertices, columns, number, what).astype(dtype)

    positions = floats(3, "vertex positions")
    assert positions is not None
    normals = floats(3, "normals", NORMALS)
    texcoords = floats(2, "texture coordinates", TEXCOORDS)
    colors = floats(3, "colours", COLORS, np.float32)
    data = MeshData(positions, inflated.array(faces, 3, "<u4", "faces").astype(np.int64), normals, texcoords)
    if colors is not None:
        data.attributes["vertex_color"] = colors
    if flags & FACE_NORMALS:
        note(f"{place}: the mesh's own wish for face normals is ignored, as by Mitsuba 3; 'face_normals' asks for them")
    return data


def _packed(inflated: _Inflated, version: int, flags: int, place: str, note: Any) -> MeshData:
    """Read what follows the flags in version 5."""
    if flags & TANGENTS_5:
        raise error(place, "the mesh holds tangents", "write it without them")
    inflated.name()
    vertices, faces, points, groups = inflated.unpack("<QQQQ")
    if max(points, groups) > vertices:
        raise error(place, f"{vertices} vertices are said to be {max(points, groups)} points", _REEXPORT)
    records = inflated.array(vertices, 8, "<f4", "vertices").astype(np.float64)
    corners = inflated.array(faces, 4, "<u4", "faces").astype(np.int64)
    if corners[:, 3].any():
        note(f"{place}: the faces' own materials are ignored; the shape's bsdf is used")
    for count, what in ((points, "points"), (groups, "groups of normals")):
        if count:  # which vertices are one point: found by their positions here
            inflated.read(4 * vertices, what)
    data = MeshData(records[:, :3], corners[:, :3])
    if flags & NORMALS:
        data.normals = records[:, 3:6]
    if flags & TEXCOORDS_5:
        data.texcoords = records[:, 6:8]
    (attributes,) = inflated.unpack("<I")
    if attributes > _ATTRIBUTES_MAX:
        raise error(place, f"the mesh has {attributes} attributes", f"at most {_ATTRIBUTES_MAX} are read")
    for _ in range(attributes):
        name = inflated.name()
        coded, channels = inflated.unpack("<BI")
        values = inflated.array(faces if name.startswith("face_") else vertices, channels, "<f4", f"'{name}'")
        if coded & 1 or channels not in (1, 3) or not name.startswith(("vertex_", "face_")):
            why = "it holds coefficients of spectra" if coded & 1 else f"it has {channels} components"
            note(f"{place}: attribute '{name}' is ignored: {why}")
            continue
        data.attributes[name] = values
    data.face_normals = bool(flags & FACE_NORMALS)
    return data

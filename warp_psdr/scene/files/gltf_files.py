"""glTF files without what is not read, their sizes checked and their buffers found, for trimesh's reader.

That reader makes every array that an accessor declares, whether data follow or not, places a mesh as often as nodes
name it, decodes pictures of materials, and in some versions follows URIs to any file of the machine. glTF 2.0, sections
3.6.1 (buffers), 3.6.2 (accessors) and 4.4 (binary files).
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

#: Numbers of all accessors, and of all placed meshes: 2 GB as float32.
_NUMBERS_MAX = 1 << 29
#: Components of an accessor's items.
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MAGIC, _JSON = b"glTF", b"JSON"
#: Bytes in front of the JSON of a binary file: magic, version, length; length and kind of the chunk.
_HEAD = struct.Struct("<4sIII4s")
#: Bytes in front of another chunk: length and kind.
_CHUNK_HEAD = 8


def geometry_only(file: Path) -> io.BytesIO:
    """Return a ``.gltf`` or ``.glb`` file without pictures.

    Raises:
        ValueError: If the file is malformed, or asks for more memory than geometry can take.
    """
    version, text, rest = _split(file)
    text = json.dumps(_geometry(json.loads(text))).encode()
    if version is None:
        return io.BytesIO(text)
    text += b" " * (-len(text) % 4)
    total = _HEAD.size + len(text) + len(rest)
    return io.BytesIO(_HEAD.pack(_MAGIC, version, total, len(text), _JSON) + text + rest)


def _split(file: Path) -> tuple[int | None, bytes, bytes]:
    """Return the version of a binary file (None: it is text), its JSON, and the chunks behind."""
    data = file.read_bytes()
    if file.suffix.lower() != ".glb":
        return None, data, b""
    magic, version, _, length, kind = _HEAD.unpack_from(data)
    if magic != _MAGIC or kind != _JSON:
        raise ValueError("it does not start as binary glTF does")
    return version, data[_HEAD.size : _HEAD.size + length], data[_HEAD.size + length :]


def json_and_chunk(file: Path) -> tuple[bytes, bytes]:
    """Return the JSON of a file, and the bytes of a binary one's first chunk behind it.

    Raises:
        ValueError: If the file is malformed.
    """
    _, text, rest = _split(file)
    return text, rest[_CHUNK_HEAD:]


def _geometry(tree: Any) -> dict:
    """Return the tree without pictures, materials reduced to their numbers, which are their names."""
    if not isinstance(tree, dict):
        raise ValueError("it is no glTF tree")
    sizes = [_size(accessor) for accessor in tree.get("accessors", [])]
    meshes = [_mesh_size(mesh, sizes) for mesh in tree.get("meshes", [])]
    placed = sum(meshes[node["mesh"]] for node in tree.get("nodes", []) if "mesh" in node)
    if max(sum(sizes), sum(meshes), placed) > _NUMBERS_MAX:
        raise ValueError(f"it holds more than {_NUMBERS_MAX} numbers, repetitions included; make it smaller")
    kept = {name: value for name, value in tree.items() if name not in ("images", "textures", "samplers")}
    return kept | {"materials": [{"name": str(i)} for i in range(len(tree.get("materials", [])))]}


def _size(accessor: dict) -> int:
    if "bufferView" not in accessor:
        raise ValueError("an accessor has no buffer view; compressed and sparse meshes are not supported")
    count = accessor["count"]
    if not isinstance(count, int) or count < 0:
        raise ValueError(f"an accessor has {count!r} items")
    return count * _COMPONENTS[accessor["type"]]


def _mesh_size(mesh: dict, sizes: list[int]) -> int:
    used = [i for part in mesh["primitives"] for i in (*part["attributes"].values(), part.get("indices", 0))]
    return sum(sizes[i] for i in used)


class Buffers:
    """The files that buffers name, by URI: what trimesh's readers take for a resolver.

    Args:
        find: Returns the existing file that a name stands for, or raises.
    """

    def __init__(self, find: Callable[[str], Path]):
        self._find = find
        self._read: dict[Path, bytes] = {}

    def __getitem__(self, uri: str) -> bytes:
        """Return the content of a file; each is read once, however often and under whatever names it is asked for.

        Raises:
            ValueError: If the file may not be read, or the URI holds data in another form than base64.
            FileNotFoundError: If there is no such file.
        """
        if uri.startswith("data:"):
            raise ValueError("a buffer's data URI is not in base64")
        file = self._find(unquote(uri)).resolve()
        if file not in self._read:
            self._read[file] = file.read_bytes()
        return self._read[file]

    get = __getitem__

"""glTF files without what is not read, their sizes checked and their buffers found, for trimesh's reader.

That reader makes every array that an accessor declares, whether data follow or not, places a mesh as often as nodes
name it, decodes pictures of materials, and in some versions follows URIs to any file of the machine. glTF 2.0, sections
3.6.1.2 (URIs of buffers), 3.6.2 (accessors) and 4.4 (binary files).
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


def geometry_only(file: Path, find: Callable[[str], Path]) -> tuple[io.BytesIO, dict[str, bytes]]:
    """Return a ``.gltf`` or ``.glb`` file without pictures, and the files that its buffers name, by URI.

    Args:
        file: An existing file.
        find: Returns the existing file that a name stands for, or raises.

    Raises:
        ValueError: If the file is malformed, asks for more memory than geometry can take, or names a file that may not
            be read.
        FileNotFoundError: If there is no file of a buffer.
    """
    data = file.read_bytes()
    if file.suffix.lower() != ".glb":
        tree = _geometry(json.loads(data))
        return io.BytesIO(json.dumps(tree).encode()), _beside(tree, find)
    magic, version, _, length, kind = _HEAD.unpack_from(data)
    if magic != _MAGIC or kind != _JSON:
        raise ValueError("it does not start as binary glTF does")
    rest = data[_HEAD.size + length :]
    tree = _geometry(json.loads(data[_HEAD.size : _HEAD.size + length]))
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    total = _HEAD.size + len(text) + len(rest)
    stream = io.BytesIO(_HEAD.pack(magic, version, total, len(text), kind) + text + rest)
    return stream, _beside(tree, find)


def _beside(tree: dict, find: Callable[[str], Path]) -> dict[str, bytes]:
    """Return the contents of the files that buffers name, by URI; each file is read once, however often it is named."""
    found: dict[str, bytes] = {}
    read: dict[Path, bytes] = {}
    for buffer in tree.get("buffers", []):
        uri = buffer.get("uri")
        if uri is None or uri in found:
            continue
        if uri.startswith("data:"):
            if ";base64," not in uri:
                raise ValueError("a buffer's data URI is not in base64")
            continue  # part of the file itself
        file = find(unquote(uri)).resolve()
        if file not in read:
            read[file] = file.read_bytes()
        found[uri] = read[file]
    return found


def _geometry(tree: Any) -> dict:
    """Return the tree without pictures, materials reduced to their number."""
    if not isinstance(tree, dict):
        raise ValueError("it is no glTF tree")
    sizes = [_size(accessor) for accessor in tree.get("accessors", [])]
    meshes = [_mesh_size(mesh, sizes) for mesh in tree.get("meshes", [])]
    placed = sum(meshes[node["mesh"]] for node in tree.get("nodes", []) if "mesh" in node)
    if max(sum(sizes), sum(meshes), placed) > _NUMBERS_MAX:
        raise ValueError(f"it holds more than {_NUMBERS_MAX} numbers, repetitions included; make it smaller")
    kept = {name: value for name, value in tree.items() if name not in ("images", "textures", "samplers")}
    return kept | {"materials": [{} for _ in tree.get("materials", [])]}


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

"""Read text PLY files whose faces have equally many corners as arrays; trimesh's reader parses every line by itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from warp_psdr.scene.files.obj_files import parse_numbers

#: Longest header: more than any program writes.
_HEADER_MAX = 1 << 16
#: Properties that may be lists.
_LISTS = ("vertex_indices", "vertex_index")
#: NumPy's types of PLY's.
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4"},
    **{"uint32": "u4", "float32": "f4", "float64": "f8"},
}


def read_text_ply(file: Path) -> dict[str, Any] | None:
    """Return the elements of a file as trimesh's reader does: name -> {"length", "properties", "data"}.

    Args:
        file: An existing file.

    Returns:
        None for files in binary, with lists of different lengths, or with anything wrong, which are left to trimesh.
    """
    with file.open("rb") as stream:
        head, end, first = stream.read(_HEADER_MAX).partition(b"end_header")
        if not end or b"format ascii" not in head:
            return None
        line, newline, rest = first.partition(b"\n")
        if line.strip() or not newline:
            return None
        body = rest + stream.read()
    elements = _elements(head.decode("latin-1"))
    if elements is None:
        return None
    numbers = parse_numbers(body, np.float64)
    if numbers is None:
        return None
    found, at = {}, 0
    for name, length, properties in elements:
        width = 0
        for is_list, _ in properties.values():
            # Where all lists have the length of the first, so has this one.
            if is_list and (length == 0 or at + width >= len(numbers) or not 0 <= numbers[at + width] < 1 << 16):
                return None
            width += 1 + (int(numbers[at + width]) if is_list else 0)
        rows = numbers[at : at + length * width]
        if width == 0 or len(rows) != length * width:
            return None
        data = _columns(rows.reshape(length, width), properties)
        if data is None:
            return None
        names = {key: kind for key, (_, kind) in properties.items()}
        found[name] = {"length": length, "properties": names, "data": data}
        at += length * width
    return found if at == len(numbers) else None


def _elements(head: str) -> list[tuple[str, int, dict[str, tuple[bool, str]]]] | None:
    """Return (name, length, property -> (whether it is a list, type)) of each element; None: something is wrong."""
    found: list[tuple[str, int, dict[str, tuple[bool, str]]]] = []
    for line in head.splitlines():
        words = line.split()
        if len(words) == 3 and words[0] == "element" and words[2].isdigit():
            found.append((words[1], int(words[2]), {}))
        elif found and len(words) == 3 and words[0] == "property" and words[1] in _TYPES:
            found[-1][2][words[2]] = False, _TYPES[words[1]]
        elif found and len(words) == 5 and words[4] in _LISTS and words[3] in _TYPES:
            found[-1][2][words[4]] = True, _TYPES[words[3]]
        elif words and words[0] in ("element", "property"):
            return None
    return found


def _columns(rows: np.ndarray, properties: dict[str, tuple[bool, str]]) -> dict[str, np.ndarray] | None:
    """Return the values of each property, (N,) or (N, corners); None: lists differ in length, or types do not fit."""
    data, column = {}, 0
    for name, (is_list, kind) in properties.items():
        if not is_list:
            values, column = rows[:, column], column + 1
        else:
            corners = int(rows[0, column])
            if (rows[:, column] != corners).any():
                return None
            values, column = rows[:, column + 1 : column + 1 + corners], column + 1 + corners
        with np.errstate(over="ignore", invalid="ignore"):  # checked in the next line, and by the checks of meshes
            data[name] = values.astype(kind)
        if kind[0] != "f" and not np.array_equal(data[name], values):
            return None
    return data

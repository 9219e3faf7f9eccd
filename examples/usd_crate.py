"""Reads arrays of a binary USD file ("crate", versions 0.7 to 0.9) without USD: what the bunny's file needs.

A crate's values are fields of specs, and a spec has a path. Its tables are whole numbers, coded as differences and then
compressed by LZ4, as is the list of names. The layout is that of OpenUSD's ``pxr/usd/usd/crateFile.cpp``,
``integerCoding.cpp`` and ``fastCompression.cpp``.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

_MAGIC, _VERSIONS = b"PXR-USDC", ((0, 7), (0, 8), (0, 9))
#: Of a value's 64 bits: whether it is an array, stands in the bits themselves, is compressed; and where it is.
_ARRAY, _INLINED, _COMPRESSED, _PLACE = 1 << 63, 1 << 62, 1 << 61, (1 << 48) - 1
#: Arrays of fewer items are not compressed.
_LEAST_COMPRESSED = 16


class Crate:
    """A binary USD file.

    Args:
        file: Its name.

    Raises:
        ValueError: It is no such file, or of another version.
    """

    def __init__(self, file: str | Path):
        self._data = Path(file).read_bytes()
        if self._data[:8] != _MAGIC or tuple(self._data[8:10]) not in _VERSIONS:
            raise ValueError(f"'{file}' is no binary USD file of version 0.7 to 0.9")
        (toc,) = struct.unpack_from("<q", self._data, 16)
        (count,) = struct.unpack_from("<Q", self._data, toc)
        sections = [struct.unpack_from("<16sqq", self._data, toc + 8 + 32 * i) for i in range(count)]
        self._starts = {name.rstrip(b"\0").decode(): start for name, start, _ in sections}
        self._values = self._read()

    def array(self, path: str, dtype: type, columns: int) -> np.ndarray:
        """Return the array of a property, such as "/root/bunny.points", shape (N, columns).

        Raises:
            KeyError: There is no such property.
        """
        value = self._values[path]
        if not value & _ARRAY or value & _INLINED:
            raise KeyError(f"{path} is no array")
        at = value & _PLACE
        (count,) = struct.unpack_from("<Q", self._data, at)
        if value & _COMPRESSED and count >= _LEAST_COMPRESSED:
            return self._numbers(at + 8, count)[0].astype(dtype).reshape(-1, columns)
        return np.frombuffer(self._data, dtype, count * columns, at + 8).reshape(-1, columns).copy()

    def _read(self) -> dict[str, int]:
        """Return the default value of every property, by its path."""
        at = self._starts["TOKENS"]
        _, size, packed = struct.unpack_from("<QQQ", self._data, at)
        tokens = [name.decode() for name in _unpacked(self._data[at + 24 : at + 24 + packed], size).split(b"\0")]
        at, count = self._count("FIELDS")
        names, at = self._numbers(at, count)
        (packed,) = struct.unpack_from("<Q", self._data, at)
        values = np.frombuffer(_unpacked(self._data[at + 8 : at + 8 + packed], 8 * count), "<u8")
        sets = self._numbers(*self._count("FIELDSETS"))[0]
        at, count = self._count("PATHS")
        at += 8  # the number once more
        index, at = self._numbers(at, count)
        element, at = self._numbers(at, count)
        jump, _ = self._numbers(at, count)
        paths = _paths(index.tolist(), element.tolist(), jump.tolist(), tokens)
        at, count = self._count("SPECS")
        owners, at = self._numbers(at, count)
        first, _ = self._numbers(at, count)
        found = {}
        for owner, start in zip(owners.tolist(), first.tolist(), strict=True):
            end = start + int(np.argmax(sets[start:] < 0))
            for field in sets[start:end].tolist():
                if tokens[names[field]] == "default":
                    found[paths[owner]] = int(values[field])
        return found

    def _count(self, section: str) -> tuple[int, int]:
        """Return where a section's first table is, and how many items it has."""
        at = self._starts[section]
        return at + 8, struct.unpack_from("<Q", self._data, at)[0]

    def _numbers(self, at: int, count: int) -> tuple[np.ndarray, int]:
        """Return coded whole numbers, and where they end."""
        (packed,) = struct.unpack_from("<Q", self._data, at)
        end = at + 8 + packed
        # The most common difference; two bits an item; what these bits name: nothing, or 8, 16 or 32 bits.
        data = _unpacked(self._data[at + 8 : end], 4 + -(-count // 4) + 4 * count)
        bits = np.frombuffer(data, np.uint8, -(-count // 4), 4)
        codes = ((bits[:, None] >> np.array([0, 2, 4, 6], np.uint8)) & 3).reshape(-1)[:count]
        widths = np.array([0, 1, 2, 4])[codes]
        places = 4 + len(bits) + np.cumsum(widths) - widths
        steps = np.full(count, struct.unpack_from("<i", data)[0], np.int64)
        raw = np.frombuffer(data + b"\0\0\0", np.uint8)
        for width, kind in ((1, "<i1"), (2, "<i2"), (4, "<i4")):
            chosen = np.flatnonzero(widths == width)
            read = raw[places[chosen, None] + np.arange(width)]
            steps[chosen] = np.ascontiguousarray(read).view(kind).reshape(-1)
        return np.cumsum(steps), end


def _paths(index: list[int], element: list[int], jump: list[int], tokens: list[str]) -> dict[int, str]:
    """Return the paths of a tree that is stored depth first."""
    found: dict[int, str] = {}
    waiting: list[tuple[int, str | None]] = [(0, None)]
    while waiting:
        i, parent = waiting.pop()
        while True:
            name = tokens[abs(element[i])]
            path = "" if parent is None else f"{parent}{'.' if element[i] < 0 else '/'}{name}"
            found[index[i]] = path
            # -2: a leaf, -1: children, 0: a sibling next, else: children next, and a sibling so much further.
            if jump[i] > 0:
                waiting.append((i + jump[i], parent))
            if jump[i] == -2:
                break
            parent = parent if jump[i] == 0 else path
            i += 1
    return found


def _unpacked(packed: bytes, size: int) -> bytes:
    """Return bytes that USD has compressed: one block of LZ4, or several with their sizes."""
    if packed[0] == 0:
        return _block(packed[1:])
    parts, at = [], 1
    for _ in range(packed[0]):
        (length,) = struct.unpack_from("<i", packed, at)
        parts.append(_block(packed[at + 4 : at + 4 + length]))
        at += 4 + length
    return b"".join(parts)[:size]


def _block(packed: bytes) -> bytes:
    """Return the bytes of a block of LZ4."""
    out, i = bytearray(), 0

    def length(first: int) -> int:
        nonlocal i
        total = first
        while first == 15:
            more = packed[i]
            i += 1
            total += more
            if more < 255:
                break
        return total

    while i < len(packed):
        token = packed[i]
        i += 1
        literal = length(token >> 4)
        out += packed[i : i + literal]
        i += literal
        if i >= len(packed):  # the last one has literals alone
            break
        back = packed[i] | packed[i + 1] << 8
        i += 2
        count = length(token & 15) + 4
        start = len(out) - back
        for k in range(count) if back < count else ():
            out.append(out[start + k])
        if back >= count:
            out += out[start : start + count]
    return bytes(out)

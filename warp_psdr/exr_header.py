"""The sizes that an EXR file declares, read before its pixels: OpenEXR allocates what a header says.

F. Kainz, R. Bogart, P. Stanczyk, P. Hillman, "OpenEXR File Layout": a magic number, a version with flags, one header a
part (name, type and length of each attribute; an empty name ends it, an empty header ends those of several parts), and
the offsets of the chunks, eight bytes each.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

__all__ = ["declared_values"]

_MAGIC = b"\x76\x2f\x31\x01"
#: Flags of the version field.
_DEEP, _MULTI_PART = 0x800, 0x1000
#: Longest name, parts, and bytes of an attribute (a preview picture): more than any program writes.
_NAME_MAX, _PARTS_MAX, _ATTRIBUTE_MAX = 255, 256, 1 << 26
#: Rows of a chunk, at most: those of the compression DWAB.
_CHUNK_ROWS = 256


def declared_values(file: Path) -> int:
    """Return how many pixel values all channels of all parts have together.

    Raises:
        ValueError: If the header is malformed, or declares more rows than a file of this length can hold.
    """
    size = file.stat().st_size
    with file.open("rb") as stream:
        magic, version = _unpack(stream, "<4sI")
        if magic != _MAGIC:
            raise ValueError("it does not start as EXR files do")
        if version & _DEEP:
            raise ValueError("deep images are not supported")
        total = 0
        for part in range(_PARTS_MAX):
            header = _header(stream)
            if part and not header:
                break
            total += _values(header, size)
            if not version & _MULTI_PART:
                break
    return total


def _values(header: dict[str, bytes], size: int) -> int:
    """Return the number of values of a part."""
    window = header.get("dataWindow", b"")
    if len(window) != 16:
        raise ValueError("it has no dataWindow")
    left, top, right, bottom = struct.unpack("<4i", window)
    width, height = right - left + 1, bottom - top + 1
    if width < 1 or height < 1:
        raise ValueError(f"it declares {width} x {height} pixels")
    if "tiles" not in header and 8 * -(-height // _CHUNK_ROWS) > size:
        raise ValueError(f"it declares {height} rows in {size} bytes")
    return width * height * max(_channel_count(header.get("channels", b"")), 1)


def _channel_count(channels: bytes) -> int:
    """Return the number of channels: each a name that a zero ends, and 16 bytes; an empty name ends the list."""
    count, at = 0, 0
    while at < len(channels) and channels[at]:
        at = channels.find(b"\0", at) + 17
        if at < 17:
            break
        count += 1
    return count


def _header(stream: BinaryIO) -> dict[str, bytes]:
    """Return the attributes of the next part that are needed here."""
    found = {}
    while name := _name(stream):
        _name(stream)  # its type
        (length,) = _unpack(stream, "<i")
        if not 0 <= length <= _ATTRIBUTE_MAX:
            raise ValueError(f"attribute '{name}' has {length} bytes")
        data = stream.read(length)
        if len(data) != length:
            raise ValueError("it ends within its header")
        if name in ("dataWindow", "channels", "tiles"):
            found[name] = data
    return found


def _name(stream: BinaryIO) -> str:
    name = bytearray()
    while (letter := stream.read(1)) != b"\0":
        name += letter
        if not letter or len(name) > _NAME_MAX:
            raise ValueError("a name in its header has no end")
    return name.decode("latin-1")


def _unpack(stream: BinaryIO, layout: str) -> tuple:
    data = stream.read(struct.calcsize(layout))
    if len(data) != struct.calcsize(layout):
        raise ValueError("it ends within its header")
    return struct.unpack(layout, data)

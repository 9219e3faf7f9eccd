"""Files of grids: Mitsuba's ``.vol``, version 3, as ``mitsuba.VolumeGrid`` writes them.

``VOL``, the version, then little-endian: the encoding (1: float32), the voxels along x, y, z, the channels, the box
that the grid fills (low x, y, z, high x, y, z), and the values with channels fastest, then x, y, z.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

_HEADER = struct.Struct("<3sBiiiii6f")
_VERSION, _FLOAT32 = 3, 1
#: Encodings of the format, for messages.
_ENCODINGS = {2: "float16", 3: "uint8", 4: "quantised directions"}
#: Most values of a grid.
MOST_VALUES = 1 << 28


def read_vol(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the values of a ``.vol`` file, (Z, Y, X, C) float32, and the matrix from the unit cube to its box.

    Sizes are checked against the file's length before memory is taken.

    Raises:
        ValueError: it is none, of another version or encoding, or its sizes disagree with its length.
    """
    length = file.stat().st_size
    with file.open("rb") as stream:
        header = stream.read(_HEADER.size)
        if len(header) < _HEADER.size or header[:3] != b"VOL":
            raise ValueError(f"'{file.name}' is no .vol file: it does not start with 'VOL' and a header of 48 bytes")
        _magic, version, encoding, nx, ny, nz, channels, *box = _HEADER.unpack(header)
        if version != _VERSION:
            raise ValueError(
                f"'{file.name}' has version {version} of the format; write version 3 (mi.VolumeGrid.write)"
            )
        if encoding != _FLOAT32:
            known = _ENCODINGS.get(encoding, f"encoding {encoding}, or another byte order")
            raise ValueError(f"'{file.name}' holds {known}; write little-endian float32 (mi.VolumeGrid.write)")
        if min(nx, ny, nz) < 1 or channels < 1:
            raise ValueError(
                f"'{file.name}' has {nx} x {ny} x {nz} voxels of {channels} channels; give 1 or more of each"
            )
        count = nx * ny * nz * channels
        if count > MOST_VALUES:
            raise ValueError(
                f"'{file.name}' declares {nx} x {ny} x {nz} voxels of {channels} channels; at most {MOST_VALUES} "
                "values are read: give fewer voxels"
            )
        if length != _HEADER.size + 4 * count:
            raise ValueError(
                f"'{file.name}' has {length} bytes, and {nx} x {ny} x {nz} voxels of {channels} channels take "
                f"{_HEADER.size + 4 * count}: it is cut off, or its header is wrong; write it again"
            )
        low, high = np.array(box[:3]), np.array(box[3:])
        if not (np.isfinite(box).all() and (high > low).all()):
            raise ValueError(
                f"'{file.name}' has the box {box}; give one whose ends are finite and above its beginnings"
            )
        values = np.fromfile(stream, "<f4", count).astype(np.float32, copy=False).reshape(nz, ny, nx, channels)
    matrix = np.eye(4)
    matrix[:3, :3] = np.diag(high - low)
    matrix[:3, 3] = low
    return values, matrix

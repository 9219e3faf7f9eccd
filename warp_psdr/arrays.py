"""NumPy's array files (``.npy``) and archives of them (``.npz``) from anywhere: numbers only, never pickles.

NumPy's own reader allocates what a header declares before it looks at how much follows, unpacks whatever an archive
holds, and takes archives and pickles where it is asked for an array.
"""

from __future__ import annotations

import io
import math
import os
import zipfile
from pathlib import Path

import numpy as np

__all__ = ["parse_array", "read_archive", "read_array"]

#: Largest text of a header, bytes: one of numbers takes some 80.
_HEADER_MAX = 4096
#: How entries of archives may be packed: as ``numpy.savez`` and ``numpy.savez_compressed`` do it.
_PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def parse_array(data: bytes) -> np.ndarray:
    """Return the array that the bytes of a ``.npy`` file hold.

    Raises:
        ValueError: If they are damaged, hold anything but numbers, or are more or fewer than the header says.
    """
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"version {version} of the format is not for numbers")
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(stream, max_header_size=_HEADER_MAX)
        if dtype.kind not in "biuf":
            raise ValueError(f"an array of {dtype} holds no numbers")
        start = stream.tell()
        if any(size < 0 for size in shape) or math.prod(shape) * dtype.itemsize != len(data) - start:
            raise ValueError(f"an array of shape {shape} is longer or shorter than the {len(data) - start} bytes of it")
        values = np.frombuffer(data, dtype=dtype, offset=start)
        # A copy, since the bytes cannot be written to.
        return values.reshape(shape, order="F" if fortran else "C").copy()
    except Exception as problem:  # the header is read as Python's literals, which fail in many ways
        raise ValueError(str(problem) or type(problem).__name__) from None


def read_array(path: str | os.PathLike[str]) -> np.ndarray:
    """Read a ``.npy`` file.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no array of numbers, or damaged.
    """
    file = Path(path)
    if not os.path.isfile(file):
        raise FileNotFoundError(f"{file} does not exist")
    try:
        return parse_array(file.read_bytes())
    except ValueError as problem:
        raise ValueError(f"{file} is no array of numbers ({problem}); save it with numpy.save") from None


def read_archive(path: str | os.PathLike[str], most: int) -> dict[str, np.ndarray]:
    """Read the arrays of a ``.npz`` file by name, compressed or not.

    Args:
        path: An existing file.
        most: Bytes of all arrays together, unpacked.

    Raises:
        ValueError: If it is no archive of numbers, damaged, or larger.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            if any(entry.compress_type not in _PACKINGS for entry in entries):
                raise ValueError("it is packed otherwise than by numpy.savez or numpy.savez_compressed")
            declared = sum(entry.file_size for entry in entries)
            if declared > most:
                raise ValueError(f"its arrays take {declared} bytes, and at most {most} are read")
            return {entry.filename.removesuffix(".npy"): parse_array(_unpacked(archive, entry)) for entry in entries}
    except Exception as problem:  # a damaged archive fails in many ways
        raise ValueError(str(problem) or type(problem).__name__) from None


def _unpacked(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    """Return as many bytes of an entry as it declares, whatever it would unpack to; verifies its checksum."""
    with archive.open(entry) as file:
        return file.read(entry.file_size)

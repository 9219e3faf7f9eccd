"""Checkpoints: NumPy archives without pickle, written so that a crash leaves the previous one whole.

A checkpoint is an uncompressed ``.npz`` of named arrays and a header, a JSON object that says what the file is and
holds the caller's own values. Each file is written beside its final name, flushed to the disk and renamed over the old
one.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from warp_psdr.arrays import parse_array
from warp_psdr.files import write_atomic

__all__ = ["load", "save"]

FORMAT = "warp_psdr checkpoint"
VERSION = 1
#: Entry of the archive that holds the header, JSON in UTF-8 as bytes.
HEADER = "__header__"


def save(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
    """Write a checkpoint atomically.

    Args:
        path: File to write or replace; its folder exists.
        arrays: Arrays of numbers, any shape.
        values: Further values that JSON can express.

    Raises:
        TypeError: If an array holds objects, or a value is not expressible in JSON.
        ValueError: If a name is taken by the header.
        OSError: If the file cannot be written; then the previous checkpoint is untouched.
    """
    stored = {}
    for name, array in arrays.items():
        stored[name] = np.ascontiguousarray(array) if np.ndim(array) else np.asarray(array)
        if stored[name].dtype.kind not in "biuf":
            raise TypeError(f"checkpoint array {name!r}: got dtype {stored[name].dtype}, expected numbers")
    if HEADER in stored:
        raise ValueError(f"checkpoint array {HEADER!r}: the name is taken by the header; choose another")
    header = json.dumps({"format": FORMAT, "version": VERSION, "values": dict(values)}).encode()
    stored[HEADER] = np.frombuffer(header, dtype=np.uint8)

    def write(file: BinaryIO) -> None:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for name, array in stored.items():
                # Names may be anything: they are never used as file names. The fixed date makes equal contents equal
                # bytes.
                with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as entry:
                    np.lib.format.write_array(entry, array, allow_pickle=False)

    write_atomic(path, write)


def load(path: str | os.PathLike[str]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read a checkpoint.

    Returns:
        The arrays and the values that were saved.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is truncated, damaged, of a newer version, or no checkpoint at all.
    """
    path = Path(path)
    if not os.path.isfile(path):
        raise FileNotFoundError(f"checkpoint {path} does not exist")
    with path.open("rb") as file:
        try:
            stored = _entries(file)
            header = json.loads(stored.pop(HEADER).tobytes())
            if header["format"] != FORMAT:
                raise ValueError(f"its format is {header['format']!r}")
            version, values = header["version"], dict(header["values"])
        except KeyError as error:
            raise ValueError(
                f"{path} is not a checkpoint of warp_psdr: it lacks {error}; choose another file"
            ) from error
        except Exception as error:  # a damaged archive fails in many ways
            raise ValueError(
                f"{path} is no checkpoint of warp_psdr, or a truncated or damaged one ({error}); remove it to start "
                "again"
            ) from error
    if version != VERSION:
        raise ValueError(
            f"{path}: got version {version} of the format, expected {VERSION}; use the release that wrote it"
        )
    return stored, values


def _entries(file: BinaryIO) -> dict[str, np.ndarray]:
    """Return the arrays of an archive by name; together they are no larger than the file."""
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise ValueError("it is compressed, which no checkpoint is")
        # Entries of a crafted archive may all lie in the same place.
        if sum(entry.file_size for entry in entries) > os.fstat(file.fileno()).st_size:
            raise ValueError("its entries overlap")
        # Reading an entry verifies its checksum.
        return {entry.filename.removesuffix(".npy"): parse_array(archive.read(entry)) for entry in entries}

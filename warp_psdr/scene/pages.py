"""The values of a scene on the CPU, whose large arrays lie in memory once: the description holds the same pages.

Both map one file without a name. The system copies a page when one of them writes to it, so that edits of the scene do
not change the description that others load from, nor the other way round.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from typing import IO, TYPE_CHECKING

import numpy as np
import warp as wp

if TYPE_CHECKING:
    from warp_psdr.scene.layout import Layout

#: Bytes of the smallest array that is shared: mappings keep their file open, of which a process has a thousand or so.
LEAST = 1 << 21


def flat_values(layout: Layout, device: wp.Device) -> wp.array:
    """Return the flat array of a scene on its device; the layout forgets the values.

    On the CPU, the fields of the description that hold large arrays hold views of copied pages from then on.
    """
    if not device.is_cpu:
        return wp.array(np.concatenate(layout.release()), dtype=wp.float32, device=device)
    large = [held for held in layout.held if _shareable(getattr(held.holder, held.field))]
    if not large:
        return wp.array(np.concatenate(layout.release()), dtype=wp.float32, device=device, copy=False)
    with _file() as file:
        for chunk in layout.release():
            file.write(chunk.data)
        file.flush()
        described = _mapped(file)
        for held in large:
            shape = getattr(held.holder, held.field).shape
            view = described[held.offset : held.offset + int(np.prod(shape))].reshape(shape)
            setattr(held.holder, held.field, view)
        return wp.array(_mapped(file), dtype=wp.float32, device=device, copy=False)


def _shareable(array: np.ndarray) -> bool:
    return array.dtype == np.float32 and array.nbytes >= LEAST


def _file() -> IO[bytes]:
    """Open an empty file without a name, which is memory where the system has such files."""
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create("warp_psdr"), "w+b")
    return tempfile.TemporaryFile()


def _mapped(file: IO[bytes]) -> np.ndarray:
    """Return the numbers of a file, float32, flat; what is written to them is copied before, and seen here alone."""
    return np.frombuffer(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY), np.float32)

"""Files that appear under their name only when they are complete and on the disk."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary name in the same folder, and rename what was written there when the block ends without an error.

    Raises:
        OSError: If the file cannot be written; then what was there before is untouched.
    """
    path = Path(path)
    # One fixed name: what a killed process leaves behind is overwritten by the next, so leftovers cannot pile up. The
    # suffix stays, for writers that go by it.
    temporary = path.with_name(f".{path.name}.tmp{path.suffix}")
    try:
        yield temporary
        with open(temporary, "r+b") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def write_atomic(path: str | os.PathLike[str], write: Callable[[BinaryIO], object]) -> None:
    """Let ``write`` fill a binary file that appears when it is complete; see ``atomic_path``."""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        write(file)


def _sync_folder(folder: Path) -> None:
    """Flush a folder's list of names, without which a power cut can undo a rename."""
    if not hasattr(os, "O_DIRECTORY"):  # Windows neither needs nor offers this
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

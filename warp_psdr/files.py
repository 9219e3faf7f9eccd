"""Files that appear under their name only when they are complete and on the disk."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary name in the same folder, and rename what was written there when the block ends without an error.

    Raises:
        OSError: If the file cannot be written (the disk is full, the folder read-only, ...); then what was there before
            is untouched.
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
    except BaseException as problem:
        with contextlib.suppress(OSError):  # the folder may be read-only
            temporary.unlink(missing_ok=True)
        if isinstance(problem, OSError) and problem.errno is not None:
            reason = f"{problem.strerror}; it was not written, and a former one is untouched"
            raise OSError(problem.errno, reason, str(path)) from problem
        raise
    _sync_folder(path.parent)


def write_atomic(path: str | os.PathLike[str], write: Callable[[BinaryIO], object]) -> None:
    """Let ``write`` fill a binary file that appears when it is complete; see ``atomic_path``."""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        write(file)


@contextlib.contextmanager
def held(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Keep other processes from holding the same folder; a process that dies lets go of it.

    Raises:
        ValueError: If another process holds it, or another thread.
        OSError: If no file can be made in it.
    """
    with tempfile.TemporaryFile(dir=folder):
        pass  # now, rather than after an hour's work
    if fcntl is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(
                f"{folder} is being written to by another run; wait for its end, stop it, or choose another folder"
            ) from None
        except OSError:
            pass  # a network file system without locks
        yield
    finally:
        os.close(descriptor)


def _sync_folder(folder: Path) -> None:
    """Flush a folder's list of names, without which a power cut can undo a rename."""
    if not hasattr(os, "O_DIRECTORY"):  # Windows neither needs nor offers this
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

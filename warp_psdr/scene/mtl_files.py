"""The pictures that a Wavefront MTL file gives to the materials of a mesh; nothing else of it is read."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from .errors import SceneError

#: Bytes that are looked at, of files that take some hundred a material.
_BYTES_MAX = 1 << 20
#: The picture of the diffuse reflectance.
_KEYWORD = b"map_kd"


def pictures(libraries: Iterable[str], find: Callable[[str], Path]) -> tuple[str, ...]:
    """Return the names of the pictures, each once, as they stand in the files.

    Args:
        libraries: What follows ``mtllib``: a name, or several. Files that are not there, or may not be read, are left
            out, for nothing depends on them.
        find: Returns the existing file that a name stands for, or raises.
    """
    found: dict[str, None] = {}
    for library in libraries:
        for file in _files(library, find):
            with file.open("rb") as stream:
                lines = stream.read(_BYTES_MAX).splitlines()
            for words in (line.split() for line in lines):
                if len(words) > 1 and words[0].lower() == _KEYWORD:
                    found[words[-1].decode("utf-8", errors="replace")] = None  # options stand before the name
    return tuple(found)


def _files(library: str, find: Callable[[str], Path]) -> list[Path]:
    """Return the files of a line: of one name, in which there may be spaces, or else of several."""
    for names in ([library], library.split()):
        files = []
        for name in names:
            try:
                files.append(find(name))
            except (SceneError, FileNotFoundError):
                continue
        if files:
            return files
    return []

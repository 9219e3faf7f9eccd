"""The pictures of the materials that an OBJ file names; nothing else is read of them here."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from warp_psdr.scene.errors import SceneError

#: Bytes that are looked at, of a mesh, whose first lines name its materials, and of each file of materials.
_BYTES_MAX = 1 << 20
#: Files of materials that are looked into.
_FILES_MAX = 16
_LIBRARY = re.compile(rb"^[ \t]*mtllib[ \t]+([^\r\n]+)", re.MULTILINE)
#: The picture of the diffuse reflectance.
_PICTURE = b"map_kd"
#: Letters of a name that are repeated in a remark.
_NAME_MAX = 200


def first_picture(file: Path, find: Callable[[str], Path]) -> str:
    """Return the name of a picture of the materials of a mesh; empty: they have none.

    Args:
        file: An existing OBJ file.
        find: Returns the existing file that a name in it stands for, or raises. Files of materials that are not there,
            or may not be read, are left out, for nothing depends on them.
    """
    for library in _LIBRARY.findall(_start(file))[:_FILES_MAX]:
        for materials in _files(_text(library).strip(), find):
            for words in map(bytes.split, _start(materials).splitlines()):
                if len(words) > 1 and words[0].lower() == _PICTURE:
                    return _text(words[-1])[:_NAME_MAX]  # options stand before the name
    return ""


def _start(file: Path) -> bytes:
    with file.open("rb") as stream:
        return stream.read(_BYTES_MAX)


def _text(data: bytes) -> str:
    return data.decode("utf-8", errors="replace")


def _files(library: str, find: Callable[[str], Path]) -> list[Path]:
    """Return the files of a line: of one name, in which there may be spaces, or else of several."""
    for names in ([library], library.split()[:_FILES_MAX]):
        files = []
        for name in names:
            try:
                files.append(find(name))
            except (SceneError, FileNotFoundError):
                continue
        if files:
            return files
    return []

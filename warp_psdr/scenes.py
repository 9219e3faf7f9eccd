"""Scene files that come with the library, by their names: ``psdr.load_file(psdr.scenes.cornell_box)``."""

from __future__ import annotations

from pathlib import Path

__all__ = ["cornell_box"]

_HERE = Path(__file__).resolve().parent
# Wheels hold the repository's folder ``scenes`` beside this file.
_FOLDER = next(folder for folder in (_HERE / "scene_files", _HERE.parent / "scenes") if folder.is_dir())

#: The Cornell box; ``resolution``, ``spp`` and ``max_depth`` are its ``$parameters``.
cornell_box = _FOLDER / "cornell_box.xml"

"""Materials of MTL and glTF files as scattering models of a scene dictionary: what both formats share."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from warp_psdr.image_io import read_image, read_picture
from warp_psdr.scene.context import Context
from warp_psdr.scene.errors import OutsideError


@dataclass(eq=False)
class Images:
    """The pictures of one mesh file; each is read once.

    Attributes:
        context: Where files are looked up and notes are kept.
        place: The mesh file, for messages.
    """

    context: Context
    place: str
    _read: dict[tuple[str, bool], np.ndarray | None] = field(default_factory=dict)

    def file(self, name: str, *, raw: bool) -> np.ndarray | None:
        """Return the picture of a name that the mesh file holds, (H, W, C); None, and a note, if there is none.

        Raises:
            ValueError: If the name leaves the mesh's folder.
        """
        key = (name, raw)
        if key not in self._read:
            self._read[key] = self._load(name, raw)
        return self._read[key]

    def _load(self, name: str, raw: bool) -> np.ndarray | None:
        try:
            return read_image(self.path(name), raw=raw)
        except FileNotFoundError:
            self.context.note(f"{self.place}: there is no picture '{name}'; the material is used without it")
        except OutsideError:
            raise
        except ValueError as problem:
            self.context.note(f"{self.place}: {problem}; the material is used without it")
        return None

    def path(self, name: str) -> Path:
        """Return the file of a name, written with either slash.

        Raises:
            ValueError: If the name leaves the mesh's folder.
            FileNotFoundError: If there is no such file.
        """
        return self.context.file(name.replace("\\", "/"), self.place)

    def stream(self, data: BinaryIO, name: str, *, raw: bool) -> np.ndarray | None:
        """Return a picture that the mesh file itself holds; None, and a note, if it cannot be read."""
        key = (name, raw)
        if key not in self._read:
            try:
                self._read[key] = read_picture(data, name, raw=raw)
            except ValueError as problem:
                self.context.note(f"{self.place}: {problem}; the material is used without it")
                self._read[key] = None
        return self._read[key]


def bitmap(values: np.ndarray, *, to_uv: np.ndarray | None = None, wrap: str = "repeat") -> dict[str, Any]:
    """Return a texture of linear values, shape (H, W, 1 or 3)."""
    values = np.ascontiguousarray(values, dtype=np.float32)
    # Floats are taken as they are; ``raw`` says it to those who read the dictionary.
    texture = {"type": "bitmap", "bitmap": values, "raw": True, "wrap_mode": wrap}
    return texture if to_uv is None else texture | {"to_uv": to_uv}


def rgb(values: Any) -> dict[str, Any]:
    """Return a linear colour."""
    return {"type": "rgb", "value": [float(value) for value in values]}


def color_of(image: np.ndarray) -> np.ndarray:
    """Return the colours of a picture without its alpha, shape (H, W, 1 or 3)."""
    return image[..., : 1 if image.shape[2] <= 2 else 3]


def covered(bsdf: dict[str, Any], opacity: Any) -> dict[str, Any]:
    """Return a model with holes; ``opacity``: a number or a texture."""
    return {"type": "mask", "opacity": opacity, "nested": bsdf}


def turned(bsdf: dict[str, Any], normals: dict[str, Any]) -> dict[str, Any]:
    """Return a model whose normal a texture turns."""
    return {"type": "normalmap", "normalmap": normals, "nested": bsdf}


def two_sided(bsdf: dict[str, Any]) -> dict[str, Any]:
    """Return a model that both sides have."""
    return {"type": "twosided", "nested": bsdf}

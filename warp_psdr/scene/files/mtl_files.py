"""Materials of Wavefront MTL files.

``Kd`` and ``map_Kd`` are the base colour, ``d`` or ``Tr`` and ``map_d`` the opacity, ``Ke`` what it emits, ``norm`` its
normal map. ``Ks`` and ``Ns`` become a gloss over the base colour, by the usual equality of Phong's exponent and
Beckmann's slope, alpha^2 = 2 / (Ns + 2); a material whose ``Ks`` is 0 is diffuse. ``Pr`` and ``Pm`` are roughness and
metalness themselves. What is said of surfaces by other words is noted and left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warp_psdr.scene.errors import error
from warp_psdr.scene.files.material_files import Images, bitmap, color_of, covered, rgb, turned, two_sided

#: Options of a map and how many values follow them at most; numbers only where it is three.
_OPTIONS = {
    **{"-o": 3, "-s": 3, "-t": 3, "-mm": 2},
    **dict.fromkeys(("-blendu", "-blendv", "-bm", "-boost", "-cc", "-clamp", "-imfchan", "-texres", "-type"), 1),
}
_NUMBERS = ("Kd", "Ks", "Ke", "Ns", "d", "Tr", "Pr", "Pm")
_MAPS = {"map_Kd": False, "map_d": True, "map_Ke": False, "map_Pr": True, "map_Pm": True, "norm": True}
#: What says nothing about the light that a surface scatters, or what others say as well.
_SILENT = ("Ka", "map_Ka", "illum", "Ni", "Tf", "sharpness")
#: Bytes of a file: more than any list of materials takes.
_BYTES_MAX = 1 << 26


@dataclass(eq=False)
class Surface:
    """What is looked up for a material: its model and its light."""

    bsdf: dict[str, Any]
    emitter: dict[str, Any] | None = None


@dataclass(eq=False)
class _Map:
    """A picture that an MTL file names, and where it lies in the texture's plane."""

    name: str
    scale: np.ndarray = field(default_factory=lambda: np.ones(2))
    offset: np.ndarray = field(default_factory=lambda: np.zeros(2))
    wrap: str = "repeat"

    def texture(self, values: np.ndarray) -> dict[str, Any]:
        """Return the texture of its values; MTL counts v from the bottom, a bitmap from its first row."""
        to_uv = None
        if (self.scale != 1.0).any() or self.offset.any():
            (su, sv), (ou, ov) = self.scale, self.offset
            to_uv = np.array([[su, 0.0, ou], [0.0, sv, 1.0 - sv - ov], [0.0, 0.0, 1.0]])
        return bitmap(values, to_uv=to_uv, wrap=self.wrap)


def read_mtl(file: Path, images: Images) -> dict[str, Surface]:
    """Return the materials of a file by their names.

    Args:
        file: An existing file.
        images: Reads the pictures that it names.

    Raises:
        ValueError: If a value cannot be read, or a picture lies outside of the mesh's folder.
    """
    place = f"'{file}'"
    if file.stat().st_size > _BYTES_MAX:
        raise error(place, f"a list of materials of more than {_BYTES_MAX} bytes", "make it smaller")
    found: dict[str, dict[str, Any]] = {}
    current: dict[str, Any] = {}
    for number, (word, rest) in _lines(file):
        if word == "newmtl":
            current = found.setdefault(rest, {})
        elif word in _NUMBERS:
            current[word] = _numbers(rest, f"{place}, line {number}")
        elif word in _MAPS:
            current[word] = _map(rest)
        elif word not in _SILENT:
            images.context.note(f"{place}: '{word}' is ignored")
    return {name: _surface(values, images) for name, values in found.items()}


def _lines(file: Path) -> Iterator[tuple[int, tuple[str, str]]]:
    for number, line in enumerate(file.read_bytes().decode("utf-8", errors="replace").splitlines(), start=1):
        word, _, rest = line.strip().replace("\t", " ").partition(" ")
        if word and not word.startswith("#"):
            yield number, (word, rest.strip())


def _numbers(text: str, place: str) -> np.ndarray:
    try:
        values = np.array([float(word) for word in text.split()[:3]])
    except ValueError:
        values = np.empty(0)
    if not len(values) or not np.isfinite(values).all() or (values < 0.0).any():
        raise error(place, f"got '{text}'", "write one number from 0 on, or three")
    return values


def _map(text: str) -> _Map:
    words = text.split()
    found = _Map("")
    i = 0
    while i < len(words) and words[i] in _OPTIONS:
        option, values = words[i], []
        i += 1
        while i < len(words) and len(values) < _OPTIONS[option] and (_OPTIONS[option] == 1 or _is_number(words[i])):
            values.append(words[i])
            i += 1
        plane = np.array([float(value) for value in values[:2]]) if option in ("-s", "-o") else np.empty(0)
        if len(plane) == 2 and option == "-s":
            found.scale = plane
        elif len(plane) == 2:
            found.offset = plane
        elif option == "-clamp" and values == ["on"]:
            found.wrap = "clamp"
    found.name = " ".join(words[i:])
    return found


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def _surface(values: dict[str, Any], images: Images) -> Surface:
    """Return the model of a material's lines."""

    def number(name: str, default: float) -> float:
        return float(values[name].mean()) if name in values else default

    def picture(name: str) -> tuple[_Map, np.ndarray] | None:
        said = values.get(name)
        image = None if said is None else images.file(said.name, raw=_MAPS[name])
        return None if said is None or image is None else (said, image)

    def single(name: str) -> dict[str, Any] | None:
        found = picture(name)
        return None if found is None else found[0].texture(color_of(found[1]).mean(axis=2, keepdims=True))

    kd = np.broadcast_to(values.get("Kd", np.full(3, 0.5)), 3)
    colored = picture("map_Kd")
    # As programs that write MTL files have it, a picture stands in for the colour; black beside it means nothing.
    base = rgb(np.minimum(kd, 1.0)) if colored is None else colored[0].texture(color_of(colored[1]))
    if any(name in values for name in ("Pr", "Pm", "map_Pr", "map_Pm")) or number("Ks", 0.0) > 0.0:
        alpha = np.sqrt(2.0 / (number("Ns", 10.0) + 2.0))
        bsdf: dict[str, Any] = {
            "type": "principled",
            "base_color": base,
            "roughness": single("map_Pr") or min(number("Pr", float(np.sqrt(alpha))), 1.0),
            "metallic": single("map_Pm") or min(number("Pm", 0.0), 1.0),
            "specular": min(number("Ks", 0.5), 1.0),
        }
    else:
        bsdf = {"type": "diffuse", "reflectance": base}
    normals = picture("norm")
    if normals is not None and normals[1].shape[2] >= 3:
        bsdf = turned(bsdf, normals[0].texture(normals[1][..., :3]))
    bsdf = two_sided(bsdf)
    opacity: Any = min(number("d", 1.0 - min(number("Tr", 0.0), 1.0)), 1.0)
    holes = picture("map_d")
    if holes is not None:
        said, image = holes
        alpha_channel = image[..., -1:] if image.shape[2] in (2, 4) else image.mean(axis=2, keepdims=True)
        opacity = said.texture(alpha_channel * opacity)
    if holes is not None or opacity < 1.0:
        bsdf = covered(bsdf, opacity)
    return Surface(bsdf, _light(values, picture("map_Ke")))


def _light(values: dict[str, Any], shining: tuple[_Map, np.ndarray] | None) -> dict[str, Any] | None:
    if shining is not None:
        return {"type": "area", "radiance": shining[0].texture(color_of(shining[1]))}
    radiance = np.broadcast_to(values.get("Ke", np.zeros(3)), 3)
    return {"type": "area", "radiance": rgb(radiance)} if radiance.any() else None

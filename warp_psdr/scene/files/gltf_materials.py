"""Materials of glTF files as ``principled`` models: glTF 2.0, section 3.9.

Metalness is the blue channel and roughness the green one of one picture; base colour and light are sRGB, the others are
numbers. Of the extensions ``KHR_materials_ior``, ``KHR_materials_emissive_strength`` and ``KHR_texture_transform``
(without rotations) are read; what others say is noted and left out. Occlusion maps are left out: light is traced.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from warp_psdr.scene.errors import error
from warp_psdr.scene.files.gltf_files import json_and_chunk
from warp_psdr.scene.files.material_files import Images, bitmap, color_of, covered, rgb, turned, two_sided
from warp_psdr.scene.files.mtl_files import Surface

_READ = ("KHR_materials_ior", "KHR_materials_emissive_strength")
_WRAPS = {33071: "clamp", 33648: "mirror", 10497: "repeat"}


def read_gltf_materials(file: Path, images: Images) -> list[tuple[str, Surface]]:
    """Return the materials of a ``.gltf`` or ``.glb`` file with their names, in the file's order.

    Args:
        file: An existing file.
        images: Reads the pictures that it names.

    Raises:
        ValueError: If a material is malformed, or a picture lies outside of the mesh's folder.
    """
    text, chunk = json_and_chunk(file)
    reader = _Reader(json.loads(text), chunk, images)
    try:
        parts = [part for mesh in reader.listed("meshes") for part in mesh["primitives"]]
        if any("COLOR_0" in part["attributes"] for part in parts):
            reader.note("its colours of vertices are ignored")
        return [(str(material.get("name", "")), reader.surface(material)) for material in reader.listed("materials")]
    except (AttributeError, IndexError, KeyError, TypeError) as problem:
        raise error(images.place, f"a material is malformed ({problem!r})", "export the mesh again") from None


class _Reader:
    """A file's tree and the bytes that come with it."""

    def __init__(self, tree: dict, chunk: bytes, images: Images):
        self.tree, self.chunk, self.images = tree, chunk, images

    def listed(self, name: str) -> list[dict]:
        return self.tree.get(name, [])

    def surface(self, material: dict) -> Surface:
        """Return the model of a material, and its light."""
        extensions = material.get("extensions", {})
        for name in extensions:
            if name not in _READ:
                self.note(f"'{name}' is ignored")
        pbr = material.get("pbrMetallicRoughness", {})
        factor = np.clip(pbr.get("baseColorFactor", [1.0] * 4), 0.0, 1.0)
        base, opacity = rgb(factor[:3]), factor[3]
        found = self.texture(pbr, "baseColorTexture", raw=False)
        alpha: Any = float(opacity)
        if found is not None:
            image, options = found
            base = bitmap(factor[:3] * color_of(image), **options)
            if image.shape[2] in (2, 4):
                alpha = image[..., -1:] * opacity
        bsdf = {"type": "principled", "base_color": base, **self.gloss(pbr)}
        index = extensions.get("KHR_materials_ior", {}).get("ior", 1.5)
        if index > 1.0:
            bsdf["eta"] = float(index)
        normals = self.texture(material, "normalTexture", raw=True)
        if normals is not None:
            n = 2.0 * color_of(normals[0]) - 1.0
            n = n * [(scale := material["normalTexture"].get("scale", 1.0)), scale, 1.0]
            n /= np.maximum(np.linalg.norm(n, axis=2, keepdims=True), 1e-12)
            bsdf = turned(bsdf, bitmap(0.5 * n + 0.5, **normals[1]))
        if material.get("doubleSided", False):
            bsdf = two_sided(bsdf)
        mode = material.get("alphaMode", "OPAQUE")
        if mode == "MASK":
            alpha = np.asarray(alpha >= material.get("alphaCutoff", 0.5), dtype=np.float32)
        if mode != "OPAQUE" and np.min(alpha) < 1.0:
            textured = found is not None and np.ndim(alpha) == 3
            bsdf = covered(bsdf, bitmap(alpha, **found[1]) if found and textured else float(np.min(alpha)))
        return Surface(bsdf, self.light(material, extensions))

    def gloss(self, pbr: dict) -> dict[str, Any]:
        """Return metalness and roughness."""
        metallic, roughness = pbr.get("metallicFactor", 1.0), pbr.get("roughnessFactor", 1.0)
        found = self.texture(pbr, "metallicRoughnessTexture", raw=True)
        if found is None or found[0].shape[2] < 3:
            return {"metallic": float(metallic), "roughness": float(roughness)}
        image, options = found
        return {
            "metallic": bitmap(metallic * image[..., 2:3], **options),
            "roughness": bitmap(roughness * image[..., 1:2], **options),
        }

    def light(self, material: dict, extensions: dict) -> dict[str, Any] | None:
        strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        factor = strength * np.asarray(material.get("emissiveFactor", [0.0] * 3), dtype=np.float64)
        if not factor.any():
            return None
        found = self.texture(material, "emissiveTexture", raw=False)
        radiance = rgb(factor) if found is None else bitmap(factor * color_of(found[0]), **found[1])
        return {"type": "area", "radiance": radiance}

    def texture(self, owner: dict, name: str, *, raw: bool) -> tuple[np.ndarray, dict[str, Any]] | None:
        """Return a picture, and where it lies in the texture's plane; None if there is none."""
        if name not in owner:
            return None
        said = owner[name]
        moved = said.get("extensions", {}).get("KHR_texture_transform", {})
        if moved.get("texCoord", said.get("texCoord", 0)) != 0:
            self.note(f"'{name}' is ignored: it has texture coordinates of its own, and those of set 0 are read")
            return None
        if moved.get("rotation", 0.0):
            self.note(f"the rotation of '{name}' is ignored")
        listed = self.listed("textures")[said["index"]]
        image = self.image(listed["source"], raw) if "source" in listed else None
        if image is None:
            if "source" not in listed:
                self.note(f"'{name}' is ignored: its picture is neither PNG nor JPEG")
            return None
        sampler = self.listed("samplers")[listed["sampler"]] if "sampler" in listed else {}
        options: dict[str, Any] = {"wrap": _WRAPS.get(sampler.get("wrapS", 10497), "repeat")}
        if moved.get("scale") or moved.get("offset"):
            (su, sv), (ou, ov) = moved.get("scale", [1.0, 1.0]), moved.get("offset", [0.0, 0.0])
            options["to_uv"] = np.array([[su, 0.0, ou], [0.0, sv, ov], [0.0, 0.0, 1.0]])
        return image, options

    def image(self, number: int, raw: bool) -> np.ndarray | None:
        """Return a picture: a file, text in the tree, or bytes of a buffer."""
        said = self.listed("images")[number]
        if "uri" in said and not said["uri"].startswith("data:"):
            return self.images.file(unquote(said["uri"]), raw=raw)
        data = _decoded(said["uri"], self.images.place) if "uri" in said else self.view(said["bufferView"])
        return self.images.stream(io.BytesIO(data), f"picture {number} of {self.images.place}", raw=raw)

    def view(self, number: int) -> bytes:
        """Return the bytes of a buffer's view."""
        view = self.listed("bufferViews")[number]
        buffer = self.listed("buffers")[view["buffer"]]
        start = view.get("byteOffset", 0)
        if "uri" not in buffer:
            data = self.chunk
        elif buffer["uri"].startswith("data:"):
            data = _decoded(buffer["uri"], self.images.place)
        else:
            data = self.images.path(unquote(buffer["uri"])).read_bytes()
        return data[start : start + view["byteLength"]]

    def note(self, text: str) -> None:
        self.images.context.note(f"{self.images.place}: {text}")


def _decoded(uri: str, place: str) -> bytes:
    """Return the bytes that a text holds, ``data:...;base64,...``."""
    try:
        return base64.b64decode(uri.partition(",")[2], validate=True)
    except binascii.Error as problem:
        raise error(place, f"a picture cannot be decoded ({problem})", "export the mesh again") from None

"""Bring plugins of scene files before version 2.0 to today's names, as Mitsuba 3 does (``parser.cpp``)."""

from __future__ import annotations

import re
from typing import Any

from warp_psdr.image_io import srgb_to_linear
from warp_psdr.scene.errors import error
from warp_psdr.scene.files.xml_parser import Element
from warp_psdr.scene.plugins import Node
from warp_psdr.scene.transforms import Transform

Version = tuple[int, ...]
#: First version whose names are today's.
CURRENT: Version = (2, 0, 0)
#: Texture coordinates were scaled and moved by parameters of their own.
_UV = ("uscale", "vscale", "uoffset", "voffset")


def version_of(element: Element) -> Version:
    """Return the version that a file's root element names.

    Raises:
        ValueError: If it names none, or one that is not known.
    """
    text = element.attributes.get("version", "")
    if not re.fullmatch(r"[0-3](\.\d{1,4}){0,2}", text):
        got = f"version '{text}'" if text else "no version"
        raise error(element.where, f"the scene has {got}", 'write version="3.0.0", or that of the Mitsuba it is for')
    return (*(int(part) for part in text.split(".")), 0, 0)[:3]


def underscored(name: str) -> str:
    """Return a camelCase name in today's form: ``toWorld`` becomes ``to_world``."""
    return re.sub(r"(?<=[a-z])[A-Z]+", lambda match: "_" + match[0].lower(), name)


def upgrade_element(element: Element) -> None:
    """Rename an element whose tag or attributes differ: ``<lookAt>``, ``<srgb>``, ``<blackbody temperature=...>``."""
    if element.tag == "transform":
        for step in element.children:
            step.tag = step.tag.lower()
    elif element.tag == "srgb":
        element.tag = "rgb"
        if "#" not in (text := element.attributes.get("value", "")):
            element.attributes["value"] = " ".join(_decoded(token) for token in re.split(r"[\s,]+", text.strip()))
    elif element.tag == "blackbody":
        given = element.attributes
        element.tag = "spectrum"
        kelvin = given.pop("temperature", "").strip().removesuffix("K")
        given["type"] = "blackbody"
        element.children.append(Element("float", {"name": "temperature", "value": kelvin}, element.where))


def upgrade(node: Node) -> None:
    """Rename a plugin's parameters that camelCase alone does not explain."""
    if node.get("type") == "diffuse" and "diffuse_reflectance" in node:
        node["reflectance"] = node.pop("diffuse_reflectance")
    if any(name in node for name in _UV):
        scale_u, scale_v, offset_u, offset_v = (_number(node, name, float(name.endswith("scale"))) for name in _UV)
        matrix: Any = Transform.scale([scale_u, scale_v, 1.0]) @ Transform.translate([offset_u, offset_v, 0.0])
        node["to_uv"] = matrix.matrix


def _decoded(token: str) -> str:
    """Return a number's text, decoded from sRGB; other texts stay, for the reader of colours to refuse."""
    try:
        return repr(float(srgb_to_linear(float(token))))
    except ValueError:
        return token


def _number(node: Node, name: str, default: float) -> float:
    value = node.pop(name, default)
    if not isinstance(value, float):
        raise error(node.where, f"'{name}' is {value!r}", "write a number")
    return value

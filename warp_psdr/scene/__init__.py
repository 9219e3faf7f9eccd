"""Scenes: from Mitsuba 3 files and dictionaries to a validated description."""

from warp_psdr.scene.description import (
    BsdfDescription,
    EmitterDescription,
    FilmDescription,
    SceneDescription,
    SensorDescription,
    ShapeDescription,
    TextureDescription,
)
from warp_psdr.scene.files.dictionary import describe_dict
from warp_psdr.scene.files.xml import describe_file, describe_string
from warp_psdr.scene.transforms import Transform

__all__ = [
    "BsdfDescription",
    "EmitterDescription",
    "FilmDescription",
    "SceneDescription",
    "SensorDescription",
    "ShapeDescription",
    "TextureDescription",
    "Transform",
    "describe_dict",
    "describe_file",
    "describe_string",
]

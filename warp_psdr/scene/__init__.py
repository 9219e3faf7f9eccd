"""Scenes: from Mitsuba 3 files and dictionaries to a validated description."""

from .description import (
    BsdfDescription,
    EmitterDescription,
    FilmDescription,
    SceneDescription,
    SensorDescription,
    ShapeDescription,
    TextureDescription,
)
from .dictionary import describe_dict
from .transforms import Transform
from .xml import describe_file, describe_string

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

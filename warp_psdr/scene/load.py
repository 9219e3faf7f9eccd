"""Load scenes: from Mitsuba 3 files, text and dictionaries to records on a device."""

from __future__ import annotations

import importlib
import warnings
from typing import TYPE_CHECKING

import warp as wp

if TYPE_CHECKING:
    from warp_psdr.scene.description import SceneDescription
    from warp_psdr.scene.scene import Scene

#: Notes on a scene that are warned of one by one; ``scene.description.notes`` has all.
MOST_WARNINGS = 20


class SceneWarning(UserWarning):
    """What is ignored, repaired or doubtful in a scene."""


def load_file(
    path, *, device: str | wp.Device | None = None, allow_outside=False, max_collisions=1e7, **defaults
) -> Scene:
    """Load a Mitsuba 3 scene file.

    Args:
        path: an XML file of version 3.x.
        device: Warp device, "cpu" or "cuda:0"; None: Warp's current one, which is a GPU where Warp finds one.
        allow_outside: where the files that the scene names may lie beside the scene's own folder and those below it: a
            folder (and below), several, or True: anywhere, for scenes that you trust. Wherever a name leads to, by
            "..", as an absolute name or by a symbolic link, other files are refused.
        max_collisions: how many tentative collisions a flight through a medium may take, about 10 ns each. One dense
            voxel in thin smoke can cost hours; such media are refused, unless this is raised.
        **defaults: values for the file's ``$parameters``.

    Returns:
        The scene.

    Raises:
        FileNotFoundError: the file, or one that it names, does not exist.
        ValueError: the file is malformed or uses what is not supported; the message names the place and the remedy.
            A medium takes more than ``max_collisions``.

    Warns:
        SceneWarning: something in the scene is ignored, repaired or doubtful.
    """
    from warp_psdr.scene.files.xml import describe_file

    return _load(describe_file(path, allow_outside=allow_outside, **defaults), device, max_collisions)


def load_string(
    xml: str,
    *,
    device: str | wp.Device | None = None,
    base=None,
    allow_outside=None,
    max_collisions=1e7,
    **defaults,
) -> Scene:
    """Load a Mitsuba 3 scene from XML text; see ``load_file``.

    Without ``base``, file names start from the current folder and, the text being the program's own, may lead anywhere.
    ``base`` stands for the scene's folder, which the names may then not leave. For text of strangers give ``base``, or
    ``allow_outside=False``.
    """
    from warp_psdr.scene.files.xml import describe_string

    if allow_outside is None:
        allow_outside = base is None
    return _load(describe_string(xml, base=base, allow_outside=allow_outside, **defaults), device, max_collisions)


def load_dict(scene: dict, *, device: str | wp.Device | None = None, max_collisions=1e7) -> Scene:
    """Load a scene from Mitsuba 3's dictionary form (plain Python and NumPy values).

    Relative file names start from the current folder; the names are the program's own, so any file may be named. See
    ``load_file``.
    """
    from warp_psdr.scene.files.dictionary import describe_dict

    return _load(describe_dict(scene), device, max_collisions)


def _load(description: SceneDescription, device: str | wp.Device | None, max_collisions: float = 1e7) -> Scene:
    """Build a scene, and warn of its notes at the line that loads it."""
    from warp_psdr.scene.scene import Scene

    if isinstance(max_collisions, bool) or not isinstance(max_collisions, int | float) or not max_collisions > 0.0:
        raise ValueError(f"max_collisions: got {max_collisions!r}, expected a positive number")
    description.max_collisions = float(max_collisions)
    scene = Scene(description, device, (_image_ahead,))
    notes = scene.description.notes
    for note in notes[:MOST_WARNINGS]:
        warnings.warn(note, SceneWarning, stacklevel=3)
    if len(notes) > MOST_WARNINGS:
        more = f"{len(notes) - MOST_WARNINGS} more remarks on the scene: see scene.description.notes"
        warnings.warn(more, SceneWarning, stacklevel=3)
    return scene


def _image_ahead(scene: Scene) -> None:
    """Begin to compile the image's kernel, where those of the scene are not in the cache, either.

    By name: ``estimate`` lies above the scene, and loads most of the device code.
    """
    importlib.import_module("warp_psdr.estimate.compile").image_ahead(scene)

"""State of one load: named objects, what has been built, where files are looked up, and the notes for the user."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from warp_psdr.scene.errors import (
    LimitError,
    OutsideError,
    ReportedError,
    SceneError,
    did_you_mean,
    error,
    limit,
    listing,
    missing_file,
)

T = TypeVar("T")
#: Where a scene may read files beside its own folder: nowhere, below these folders, or anywhere.
Outside = bool | str | os.PathLike[str] | Iterable[str | os.PathLike[str]]
#: Numbers of all images and meshes of a scene: the device counts them with 32 bits.
_NUMBERS_MAX = 2**31 - 1
#: References that lead to each other, and remarks: more than anybody follows, or reads.
_CHAIN_MAX, _NOTES_MAX = 64, 1000
#: Problems of one scene: more than anybody reads.
_PROBLEMS_MAX = 50


class FileName(str):
    """A text from a scene file that knows the folder of that file, where a relative file name starts.

    Args:
        text: The text.
        folder: The folder; None when the scene is no file.
    """

    __slots__ = ("folder",)

    folder: Path | None

    def __new__(cls, text: str, folder: Path | None) -> FileName:
        """Return the text with its folder."""
        value = super().__new__(cls, text)
        value.folder = folder
        return value


class Context:
    """One load in progress.

    Args:
        source: File name or "dict", for messages.
        base: Folder that relative file names start from.
        allow_outside: Where files may lie that are not below ``base``: True: anywhere, False: nowhere, or below these
            folders.

    Raises:
        TypeError: If ``allow_outside`` is none of these.
    """

    def __init__(self, source: str, base: Path, allow_outside: Outside = False):
        self.source = source
        self.base = base
        self.roots = _roots(base, allow_outside)
        self._numbers = 0
        #: Triangles of all instances so far.
        self.instanced = 0
        #: Paths of the shapes without triangles in groups that have an instance.
        self.placed_shapes: set[str] = set()
        self.search_paths: list[Path] = []
        self.notes: list[str] = []
        self.named: dict[str, dict] = {}
        #: What is subtracted from all positions; see ``origin``.
        self.origin = np.zeros(3)
        self._built: dict[Any, tuple[dict, Any]] = {}
        self._open: list[int] = []
        self._attached: dict[int, tuple[object, str]] = {}
        #: Area lights that stand in the scene itself, with their places.
        self.area_lights: list[tuple[object, str]] = []
        #: What keeps the scene from being used, reported together when all of it is known.
        self.problems: list[SceneError | FileNotFoundError] = []
        #: ``id`` of the dictionaries whose problems are reported: they are not built, and nothing is said of what lacks
        #: them.
        self.broken: set[int] = set()

    def fresh(self) -> Context:
        """Return the same load as it is now, to build everything in it once more."""
        copy = Context(self.source, self.base)
        copy.roots, copy.search_paths = self.roots, list(self.search_paths)
        copy.notes, copy.named = list(self.notes), dict(self.named)
        return copy

    def report(self, problem: SceneError | FileNotFoundError) -> None:
        """Keep a problem, to go on and find the others.

        Raises:
            ValueError: If there are too many, or this one ends the load.
        """
        if isinstance(problem, LimitError):
            raise problem
        if isinstance(problem, ReportedError) or str(problem) in map(str, self.problems):
            return
        self.problems.append(problem)
        if len(self.problems) >= _PROBLEMS_MAX:
            self.raise_problems()

    def attempt(self, make: Callable[[], T], otherwise: T) -> T:
        """Return ``make()``; if that cannot be, report the problem and return ``otherwise``."""
        try:
            return make()
        except (SceneError, FileNotFoundError) as problem:
            self.report(problem)
            return otherwise

    def raise_problems(self) -> None:
        """Raise what was reported.

        Raises:
            ValueError: With all problems and their places.
            FileNotFoundError: If the problems are missing files only.
        """
        if not self.problems:
            return
        if len(self.problems) == 1:
            raise self.problems[0]
        missing = all(isinstance(problem, FileNotFoundError) for problem in self.problems)
        kind = FileNotFoundError if missing else SceneError
        count = f"{len(self.problems)} problems" if len(self.problems) < _PROBLEMS_MAX else "many problems, such as"
        raise kind("\n  - ".join([f"{self.source}: {count}:", *map(str, self.problems)]))

    def note(self, text: str) -> None:
        """Keep a remark for the user, once; the first thousand of them."""
        if len(self.notes) < _NOTES_MAX and text not in self.notes:
            self.notes.append(text)
            if len(self.notes) == _NOTES_MAX:
                self.notes.append("further remarks are left out")

    def inside(self, where: str, key: str, value: Any) -> str:
        """Return the place of a nested dictionary: its line in a file, or its keys."""
        return getattr(value, "where", "") or f"{where}[{key!r}]"

    def resolve(self, node: dict, where: str) -> tuple[dict, str]:
        """Follow references to the plugin that they name; returns it with its place."""
        seen: list[str] = []
        while node.get("type") == "ref":
            name = node.get("id")
            if not isinstance(name, str) or name not in self.named:
                hint = did_you_mean(str(name), self.named)
                known = listing(f"'{n}'" for n in self.named) or "none"
                raise error(where, f"reference to unknown id '{name}'{hint}", f"known ids: {known}")
            if name in seen:
                raise error(where, f"circular reference {' -> '.join([*seen, name])}", "break the cycle")
            seen.append(name)
            if len(seen) > _CHAIN_MAX:
                raise error(where, f"more than {_CHAIN_MAX} references in a chain", "refer to the plugin itself")
            node = self.named[name]
            where = getattr(node, "where", "") or where
        return node, where

    def build(self, node: dict, where: str, variant: str, make: Callable[[], T], *, shared: bool) -> T:
        """Return ``make()`` for a node.

        Args:
            node: A plugin's dictionary.
            where: Its place, for messages.
            variant: What is made of it.
            make: Makes it.
            shared: Whether a reference led here: all references to a node give one object, while a Python dictionary
                that stands in several places gives one object for each.

        Raises:
            ValueError: If the node contains itself.
        """
        key = (id(node), variant)
        if shared and key in self._built:
            return self._built[key][1]
        if id(node) in self._open:
            raise error(where, f"circular reference: this '{node.get('type')}' contains itself", "break the cycle")
        self._open.append(id(node))
        try:
            result = make()
        finally:
            self._open.pop()
        # The node is kept with the result: its id() must not be given to another object meanwhile.
        self._built.setdefault(key, (node, result))
        return result

    def attach(self, light: object, shape: str, where: str) -> None:
        """Remember the shape of an area light, which has one.

        Raises:
            ValueError: If the light belongs to another shape.
        """
        other = self._attached.setdefault(id(light), (light, shape))[1]
        if other != shape:
            problem = f"the emitter of '{shape}' is that of '{other}'"
            raise error(where, problem, "give every shape an emitter of its own")

    def is_attached(self, light: object) -> bool:
        """Return whether an area light belongs to a shape."""
        return id(light) in self._attached

    def file(self, name: Any, where: str) -> Path:
        """Return the existing file that a scene names.

        Relative names start from the folder of the file that they stand in, then from the scene's folder, then from its
        ``<path>`` folders. Wherever that leads, by "..", an absolute name or a symbolic link, the file has to lie in
        the scene's folder or below it, or where ``allow_outside`` says.

        Raises:
            ValueError: If the name is no text or leads out of the scene's folder.
            FileNotFoundError: If there is no such file.
        """
        candidates = self._candidates(name, where)
        for candidate in candidates:
            if os.path.isfile(candidate):
                return candidate
        if any(os.path.isdir(candidate) for candidate in candidates):
            raise error(where, f"'{name}' is a folder", "name a file in it")
        looked = listing(f"'{candidate.parent}'" for candidate in candidates)
        raise missing_file(where, name, f"looked in {looked}; check the name or add a <path> folder")

    def folder(self, name: Any, where: str) -> Path:
        """Return the existing folder that a scene names; see ``file``.

        Raises:
            ValueError: If the name is no text or leaves the scene's folder.
            FileNotFoundError: If there is no such folder.
        """
        for candidate in self._candidates(name, where):
            if os.path.isdir(candidate):
                return candidate
        raise missing_file(where, name, "a <path> names an existing folder; check the name")

    def _candidates(self, name: Any, where: str) -> list[Path]:
        """Return where a name may stand, in the order of search."""
        if not isinstance(name, (str, Path)) or not str(name) or "\0" in str(name):
            raise error(where, f"got {name!r} for a file name", "give a file name")
        folders = [getattr(name, "folder", None) or self.base, self.base, *self.search_paths]
        # An absolute name stays what it is.
        candidates = list(dict.fromkeys(folder / Path(name) for folder in folders))
        if self.roots is None:
            return candidates
        inside = [candidate for candidate in candidates if _is_inside(candidate, self.roots)]
        if not inside:
            problem = error(
                where,
                f"'{name}' leaves the scene's folder '{self.base}'",
                "move the file below it, or name its folder, or a folder of both, when loading: "
                "allow_outside=folder (--allow-outside FOLDER), or allow_outside=True for scenes that you trust",
            )
            raise OutsideError(str(problem))
        return inside

    def count(self, numbers: int, where: str) -> None:
        """Count the values of an image or a mesh.

        Raises:
            ValueError: If the scene has more than the device can count.
        """
        self._numbers += numbers
        if self._numbers > _NUMBERS_MAX:
            raise limit(
                where, f"the scene holds more than {_NUMBERS_MAX} values by here", "use smaller images or meshes"
            )


def _roots(base: Path, outside: Outside) -> list[Path] | None:
    """Return the folders below which files may lie, links followed; None: anywhere."""
    if outside is True:
        return None
    if outside is False:
        outside = ()
    names = [outside] if isinstance(outside, str | os.PathLike) else outside
    try:
        return [Path(folder).resolve() for folder in (base, *names)]
    except TypeError:
        raise TypeError(f"allow_outside: got {outside!r}, expected True, False, a folder or folders") from None


def _is_inside(path: Path, roots: list[Path]) -> bool:
    """Return whether a path, its links followed, lies below one of the folders.

    What is read later is what is there then: this is no protection from somebody who can write to the folder meanwhile.
    """
    try:
        real = path.resolve()
    except (OSError, RuntimeError, ValueError):  # circles, and names that no file can have
        return False
    return any(real.is_relative_to(root) for root in roots)

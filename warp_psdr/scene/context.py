"""State of one load: named objects, what has been built, where files are looked up, and the notes for the user."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from .errors import did_you_mean, error, listing, missing_file

T = TypeVar("T")


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
        base: Folder that relative file names start from; None: the current folder.
        allow_outside: Whether a relative name may climb out of ``base`` with "..".
    """

    def __init__(self, source: str, base: Path | None, allow_outside: bool = False):
        self.source = source
        self.base = base
        self.allow_outside = allow_outside
        self.search_paths: list[Path] = []
        self.notes: list[str] = []
        self.named: dict[str, dict] = {}
        #: What is subtracted from all positions; see ``origin``.
        self.origin = np.zeros(3)
        self._built: dict[Any, tuple[dict, Any]] = {}
        self._open: list[int] = []

    def fresh(self) -> Context:
        """Return the same load as it is now, to build everything in it once more."""
        copy = Context(self.source, self.base, self.allow_outside)
        copy.search_paths = list(self.search_paths)
        copy.notes, copy.named = list(self.notes), dict(self.named)
        return copy

    def note(self, text: str) -> None:
        """Keep a remark for the user, once."""
        if text not in self.notes:
            self.notes.append(text)

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

    def file(self, name: Any, where: str) -> Path:
        """Return the existing file that a scene names.

        Relative names start from the folder of the file that they stand in, then from the scene's folder, then from its
        ``<path>`` folders. They may not climb out of the scene's folder with "..", unless the load was started with
        ``allow_outside=True``; absolute names may.

        Raises:
            ValueError: If the name is no text or leaves the scene's folder.
            FileNotFoundError: If there is no such file.
        """
        candidates = self._candidates(name, where)
        for candidate in candidates:
            if candidate.is_file():
                return candidate
        if any(candidate.is_dir() for candidate in candidates):
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
            if candidate.is_dir():
                return candidate
        raise missing_file(where, name, "a <path> names an existing folder; check the name")

    def _candidates(self, name: Any, where: str) -> list[Path]:
        """Return where a name may stand, in the order of search."""
        if not isinstance(name, (str, Path)) or not str(name) or "\0" in str(name):
            raise error(where, f"got {name!r} for a file name", "give a file name")
        path = Path(name)
        if path.is_absolute():
            return [path]
        base = self.base or Path.cwd()
        folders = list(dict.fromkeys([getattr(name, "folder", None) or base, base, *self.search_paths]))
        candidates = [folder / path for folder in folders]
        if self.allow_outside or self.base is None:
            return candidates
        inside = [
            candidate
            for folder, candidate in zip(folders, candidates, strict=True)
            if _is_inside(candidate, base) or (not _is_inside(folder, base) and _is_inside(candidate, folder))
        ]
        if not inside:
            raise error(
                where,
                f"'{name}' leaves the scene's folder '{base}'",
                "move the file below it, give an absolute name, or load with allow_outside=True",
            )
        return inside


def _is_inside(path: Path, folder: Path) -> bool:
    """Return whether a path stays below a folder once ".." is taken out; links are not followed."""
    return Path(os.path.normpath(path)).is_relative_to(os.path.normpath(folder))

"""Read Mitsuba 3 scene files (XML) into the dictionary form, with the place of everything for messages."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from warp_psdr.scene.context import Context, FileName, Outside
from warp_psdr.scene.description import SceneDescription
from warp_psdr.scene.errors import SceneError, did_you_mean, error, limit, listing, missing_file
from warp_psdr.scene.files.dictionary import describe
from warp_psdr.scene.files.upgrade import CURRENT, Version, underscored, upgrade, upgrade_element, version_of
from warp_psdr.scene.files.xml_parser import Element, parse
from warp_psdr.scene.files.xml_values import PROPERTY_TAGS, attributes, read_property, read_transform
from warp_psdr.scene.plugins import PLUGINS, Node

#: Files that include each other without end differ in name at most this often.
_INCLUDE_DEPTH = 15
#: Inclusions of files altogether, and ``<path>`` folders, in each of which every file is looked for.
_INCLUDES_MAX, _PATHS_MAX = 1000, 100
#: Elements of a scene, counted each time that a file is included: each takes some 300 bytes and its texts.
_ELEMENTS_MAX = 1_000_000
#: Letters of an attribute once its parameters are filled in: parameters made of parameters grow without bound.
_LETTERS_MAX = 1 << 16
#: Parameters of a scene: each is looked for in every attribute with a dollar sign.
_PARAMETERS_MAX = 1000
#: What is often given in place of a scene.
_MESHES = (".obj", ".ply", ".gltf", ".glb", ".stl", ".off", ".serialized")
_OTHER_TAGS = ("transform", "ref", "include", "alias", "default", "path")


def describe_file(path: str | os.PathLike[str], *, allow_outside: Outside = False, **defaults: Any) -> SceneDescription:
    """Return the description of a Mitsuba 3 scene file.

    Relative file names start from the file that names them, then from the scene file's folder, then from its ``<path>``
    folders. Whatever they are, relative, absolute or symbolic links, the files have to lie in the scene file's folder
    or below it, so that a scene from somebody else reads nothing but what came with it.

    Args:
        path: An XML file of version 3.x, or an older one, whose names are brought up to date as Mitsuba 3 does it.
        allow_outside: Further folders in or below which files may lie (one, or several), for example the folder that
            holds both ``scenes/`` and ``textures/``; True: anywhere, for scenes that you trust.
        **defaults: Values for the file's ``$parameters``; they take precedence over ``<default>``.

    Raises:
        FileNotFoundError: If the file, or one that it names, does not exist.
        ValueError: If the file is malformed or uses what is not supported; the message names the file and the line.
    """
    file = Path(path)
    if not os.path.isfile(file):
        what = "it is a folder" if os.path.isdir(file) else "check the name"
        raise missing_file("load_file", file, f"{what}; expected a Mitsuba scene (.xml)")
    if file.suffix.lower() in _MESHES:
        raise error(
            f"load_file: '{file}'",
            "it is a mesh, and no scene",
            f"put it in one: psdr.load_dict({{'type': 'scene', 'mesh': psdr.load_mesh({file.name!r}), ...}})",
        )
    context = Context(str(file), file.resolve().parent, allow_outside)
    return _describe(file.read_bytes(), file.name, file.resolve(), context, defaults)


def describe_string(
    xml: str, *, base: str | os.PathLike[str] | None = None, allow_outside: Outside = False, **defaults: Any
) -> SceneDescription:
    """Return the description of a Mitsuba 3 scene given as XML text; see ``describe_file``.

    Args:
        xml: The text.
        base: Stands for the scene file's folder; default: the current one.
        allow_outside: Further folders, or True.
        **defaults: Values for the text's ``$parameters``.

    Raises:
        TypeError: If ``xml`` is no text.
        FileNotFoundError: If a file that the scene names does not exist.
        ValueError: If the text is malformed or uses what is not supported; the message names the line.
    """
    if not isinstance(xml, str):
        raise TypeError(f"a scene's text is a str; got {type(xml).__name__}")
    context = Context("string", Path.cwd() if base is None else Path(base), allow_outside)
    return _describe(xml.encode("utf-8"), "string", None, context, defaults)


def _describe(data: bytes, label: str, file: Path | None, context: Context, defaults: dict) -> SceneDescription:
    reader = _Reader(context, defaults)
    root = reader.parse(data, label)
    version = version_of(root)
    if root.tag != "scene":
        raise error(root.where, "the outermost element is no <scene>", 'write <scene version="3.0.0">')
    scene = Node({"type": "scene"}, root.where, "scene")
    reader.fill(scene, root, file, version, top=True)
    context.attempt(reader.check_unused, None)
    reader.register_aliases()
    return describe(scene, root.where, context)


class _Reader:
    """Turns elements into dictionaries; keeps the ``$parameters``, ids and files of one load.

    Args:
        context: The load in progress.
        defaults: The user's values for ``$parameters``.
    """

    def __init__(self, context: Context, defaults: dict[str, Any]):
        self.context = context
        self.given = set(defaults)
        self.parameters = {name: _text(value) for name, value in defaults.items()}
        self.used: set[str] = set()
        self.ids: dict[str, str] = {}
        self.aliases: list[tuple[str, str, str]] = []
        self._unnamed: dict[str | int, int] = {}
        self._including: list[Path] = []
        self._includes = 0
        self._elements_left = _ELEMENTS_MAX
        self._longest_first: list[str] = []

    def parse(self, data: bytes, label: str) -> Element:
        """Return the root element of a file.

        Raises:
            ValueError: If the XML is malformed, or all files together have too many elements.
        """
        root, count = parse(data, label, self._elements_left)
        self._elements_left -= count
        return root

    def fill(self, node: Node, element: Element, file: Path | None, version: Version, *, top: bool) -> None:
        """Add an element's children to its dictionary; problems are reported.

        Args:
            node: The dictionary.
            element: The element.
            file: Where the element stands; None: in a text.
            version: Of that file.
            top: Whether the element is the scene.
        """
        if file is not None and not self._including:
            self._including.append(file)
        for child in element.children:
            try:
                self._substitute(child)
                self._child(node, child, file, version, top=top)
            except (SceneError, FileNotFoundError) as problem:
                self.context.report(problem)
                if not top:
                    self.context.broken.add(id(node))

    def _child(self, node: Node, child: Element, file: Path | None, version: Version, *, top: bool) -> None:
        old = version < CURRENT
        if old:
            upgrade_element(child)
        if child.tag == "default":
            name, value = attributes(child, "name", "value").values()
            self.parameters.setdefault(name, value)
            if len(self.parameters) > _PARAMETERS_MAX:
                raise limit(child.where, f"more than {_PARAMETERS_MAX} parameters", "write values instead")
        elif child.tag == "alias":
            source, target = attributes(child, "id", "as").values()
            self._claim(target, child.where)
            self.aliases.append((source, target, child.where))
        elif child.tag == "path":
            self._search_path(child, file, top=top)
        elif child.tag == "include":
            self._include(node, child, file, top=top)
        elif child.tag == "ref":
            values = attributes(child, "id", optional=("name",))
            self._set(node, child, Node({"type": "ref", "id": values["id"]}, child.where), top=top, old=old)
        elif child.tag == "transform":
            name = attributes(child, "name")["name"]
            for step in child.children:
                self._substitute(step)
            self._assign(node, name, read_transform(child, self.context.note), child.where, old=old)
        elif child.tag in PROPERTY_TAGS and not (child.tag == "spectrum" and "type" in child.attributes):
            name, value = read_property(child)
            if isinstance(value, str) and file is not None:
                value = FileName(value, file.parent)
            elif isinstance(value, Node) and "filename" in value:
                value["filename"] = FileName(value["filename"], _folder(file))
            self._assign(node, name, value, child.where, old=old)
        else:
            self._plugin(node, child, file, version, top=top)

    def _plugin(self, node: Node, child: Element, file: Path | None, version: Version, *, top: bool) -> None:
        tag = "texture" if child.tag == "spectrum" else child.tag
        if tag not in PLUGINS or tag == "scene":
            known = [*(name for name in PLUGINS if name != "scene"), *PROPERTY_TAGS, *_OTHER_TAGS]
            hint = did_you_mean(tag, known)
            raise error(child.where, f"the element <{tag}> is not supported{hint}", f"supported: {listing(known)}")
        values = attributes(child, "type", optional=("id", "name"), also=("version",))
        plugin = Node({"type": values["type"]}, child.where, tag)
        if values.get("id"):
            self._claim(values["id"], child.where)
            plugin["id"] = values["id"]
        self.fill(plugin, child, file, version, top=False)
        if version < CURRENT:
            upgrade(plugin)
        self._set(node, child, plugin, top=top, old=version < CURRENT)

    def _set(self, node: Node, child: Element, value: Node, *, top: bool, old: bool) -> None:
        """Store a nested plugin under its name; in the scene the id is the name, elsewhere the name is the slot."""
        name = child.attributes.get("name", "")
        if top:
            name = child.attributes.get("id", "") if child.tag != "ref" else name
            while not name or (name in node and child.tag not in node):
                number = self._unnamed.get(child.tag, 0)
                self._unnamed[child.tag] = number + 1
                name = f"{child.tag}_{number}"
                name = "" if name in node or name in self.ids else name
        elif not name:
            number = self._unnamed.get(id(node), 0)
            while f"_arg_{number}" in node:
                number += 1
            self._unnamed[id(node)] = number + 1
            name = f"_arg_{number}"
        self._assign(node, name, value, child.where, old=old and not top)

    def _assign(self, node: Node, name: str, value: Any, where: str, *, old: bool) -> None:
        name = underscored(name) if old else name
        if name in node:
            raise error(where, f"'{name}' is given twice in {node.where}", "remove one of the two")
        node[name] = value

    def _claim(self, name: str, where: str) -> None:
        if name in self.ids:
            raise error(where, f"the id '{name}' is taken by {self.ids[name]}", "give every element an id of its own")
        self.ids[name] = where

    def _substitute(self, element: Element) -> None:
        """Replace ``$name`` in an element's attributes, longest names first; a backslash keeps the dollar sign."""
        if len(self._longest_first) != len(self.parameters):
            self._longest_first = sorted(self.parameters, key=len, reverse=True)
        for key, text in element.attributes.items():
            if "$" not in text:
                continue
            # A private-use character stands for an escaped dollar sign meanwhile.
            text = text.replace("\\$", "\ue000")
            for name in self._longest_first:
                if f"${name}" in text:
                    text = text.replace(f"${name}", self.parameters[name])
                    self.used.add(name)
                if len(text) > _LETTERS_MAX:
                    problem = f"the attribute '{key}' has more than {_LETTERS_MAX} letters with its parameters"
                    raise limit(element.where, problem, "write it shorter")
            if "$" in text:
                unknown = "".join(c if c.isalnum() or c == "_" else " " for c in text.split("$", 1)[1]).split(" ")[0]
                known = listing(f"${name}" for name in self.parameters) or "none"
                raise error(
                    element.where,
                    f'undefined parameter ${unknown} in {key}="{element.attributes[key]}"'
                    f"{did_you_mean(unknown, self.parameters)}",
                    f'write <default name="{unknown}" value="..."/> before it, or pass it when loading; known: {known}',
                )
            element.attributes[key] = text.replace("\ue000", "$")

    def _search_path(self, child: Element, file: Path | None, *, top: bool) -> None:
        name = attributes(child, "value")["value"]
        if not top:
            raise error(child.where, "a <path> inside a plugin", "move it directly into <scene>")
        self.context.search_paths.insert(0, self.context.folder(FileName(name, _folder(file)), child.where))
        if len(self.context.search_paths) > _PATHS_MAX:
            raise limit(child.where, f"more than {_PATHS_MAX} <path> folders", "keep those that are needed")

    def _include(self, node: Node, child: Element, file: Path | None, *, top: bool) -> None:
        values = attributes(child, "filename", optional=("name",))
        found = self.context.file(FileName(values["filename"], _folder(file)), child.where).resolve()
        if found in self._including or len(self._including) > _INCLUDE_DEPTH:
            chain = " -> ".join(path.name for path in (*self._including, found))
            raise error(child.where, f"circular <include>: {chain}", "remove one of the includes")
        self._includes += 1
        if self._includes > _INCLUDES_MAX:
            raise limit(child.where, f"more than {_INCLUDES_MAX} files are included", "put them into one")
        root = self.parse(found.read_bytes(), found.name)
        self._including.append(found)
        self._substitute(root)
        if root.tag == "scene":
            self.fill(node, root, found, version_of(root), top=top)
        else:
            if "name" in values:
                root.attributes["name"] = values["name"]
            version = version_of(root) if "version" in root.attributes else CURRENT
            self._child(node, root, found, version, top=top)
        self._including.pop()

    def check_unused(self) -> None:
        """Raise if the user gave values for parameters that the file does not use.

        Raises:
            ValueError: With the parameters that it has.
        """
        unused = sorted(self.given - self.used)
        if unused:
            known = listing(sorted(set(self.parameters) - set(unused))) or "none"
            raise SceneError(
                f"{self.context.source}: the scene does not use the parameter '{unused[0]}'"
                f"{did_you_mean(unused[0], set(self.parameters) - set(unused))}; its parameters are: {known}"
            )

    def register_aliases(self) -> None:
        """Make aliases known to references; those of unknown ids are reported."""
        for source, target, where in self.aliases:
            if source not in self.ids:
                known = listing(f"'{name}'" for name in self.ids)
                problem = f"alias of unknown id '{source}'{did_you_mean(source, self.ids)}"
                self.context.report(error(where, problem, f"ids: {known}"))
                continue
            self.context.named[target] = Node({"type": "ref", "id": source}, where)


def _folder(file: Path | None) -> Path | None:
    return None if file is None else file.parent


def _text(value: Any) -> str:
    """Return a user's value as it would stand in the file."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (list, tuple)):
        return " ".join(_text(item) for item in value)
    return str(value)

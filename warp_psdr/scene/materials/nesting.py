"""How deep plugins are nested in each other, and how often one stands in another, references followed.

A reference is a few letters of a file, and what it names counts wherever it is named: twenty materials, each a blend of
the one before with itself, are a million.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from warp_psdr.scene.errors import SceneError, error, limit
from warp_psdr.scene.plugins import category_of

if TYPE_CHECKING:
    from warp_psdr.scene.context import Context

#: Plugins in each other: more than any scene needs, and few enough for readers that call themselves.
DEPTH_MAX = 64
#: Dictionaries of a scene, counted wherever they stand.
DICTIONARIES_MAX = 1_000_000
#: Plugins of a category in one of that category, counted wherever references lead to them.
_PARTS_MAX = {"bsdf": 64, "shape": 1_000_000}
_OTHER_PARTS_MAX = 1000


@dataclass
class _Open:
    """A plugin whose nested ones are being looked at."""

    node: dict
    where: str
    category: str
    nested: Iterator[tuple[dict, str]]
    depth: int = 1  #: of the plugins in it, with itself
    parts: int = 1  #: plugins of its category in it, with itself


def check_nesting(scene: dict, where: str, context: Context) -> None:
    """Look at every plugin of a scene once; one that contains itself is reported, and not built.

    Args:
        scene: The scene's dictionary; it contains itself nowhere, references aside.
        where: Its place, for messages.
        context: The load in progress, which knows all names.

    Raises:
        ValueError: If plugins are nested too deeply, or too many are nested in one.
    """
    known: dict[int, _Open] = {}
    stack = [_opened(scene, where, context)]
    entered = {id(scene)}
    while stack:
        top = stack[-1]
        node, place = next(top.nested, (None, ""))
        if node is None:
            stack.pop()
            entered.discard(id(top.node))
            known[id(top.node)] = top
            if stack:
                _count(stack[-1], top)
        elif id(node) in entered:
            context.broken.add(id(node))
            context.report(
                error(place, f"circular reference: this '{node.get('type')}' contains itself", "break the cycle")
            )
        elif id(node) in known:
            _count(top, known[id(node)])
        else:
            stack.append(_opened(node, place, context))
            entered.add(id(node))


def _opened(node: dict, where: str, context: Context) -> _Open:
    try:
        category = category_of(node, where)
    except SceneError:  # reported where the plugin is read
        category = ""
    return _Open(node, where, category, _nested(node, where, context))


def _nested(node: dict, where: str, context: Context) -> Iterator[tuple[dict, str]]:
    """Go through the dictionaries in one, references followed, with their places."""
    for key, value in node.items():
        if isinstance(value, dict):
            try:
                yield context.resolve(value, context.inside(where, key, value))
            except SceneError:  # reported where the reference is read
                continue


def _count(outer: _Open, inner: _Open) -> None:
    """Count a plugin in another.

    Raises:
        ValueError: If that is too deep, or too much.
    """
    outer.depth = max(outer.depth, inner.depth + 1)
    if outer.depth > DEPTH_MAX and outer.category != "scene":
        raise limit(outer.where, f"plugins are nested more than {DEPTH_MAX} deep, references included", "nest fewer")
    if outer.category and outer.category == inner.category:
        outer.parts += inner.parts
        most = _PARTS_MAX.get(outer.category, _OTHER_PARTS_MAX)
        if outer.parts > most:
            raise limit(
                outer.where,
                f"more than {most} {outer.category} plugins are nested in one, each counted wherever references lead "
                "to it",
                "nest fewer",
            )

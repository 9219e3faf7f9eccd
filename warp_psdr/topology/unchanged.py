"""Derived facts about a scene, kept until one of its values changes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

T = TypeVar("T")

#: Bytes of the most values of which a copy is kept.
MOST = 1 << 24


def kept(scene: Scene, key: Hashable, find: Callable[[], T]) -> T:
    """Return what ``find()`` returns, from the first call with this key at the scene's present values.

    All values are compared with those of the last call, unless they are ``at_rest``: some .2 ms for half a million.

    Args:
        scene: the scene.
        key: names what is found, and all that it depends on besides values. Nothing else may change the result.
        find: what finds it. Errors are not kept.

    Returns:
        The same object for all these calls: callers must not change it.
    """
    found = _found_now(scene) if scene.__dict__.get("_at_rest") is None else scene.__dict__["_at_rest"]
    if key not in found:
        found[key] = find()
    return found[key]


@contextmanager
def at_rest(scene: Scene) -> Iterator[None]:
    """Compare values here alone: until the block ends none changes."""
    before = scene.__dict__.get("_at_rest")
    scene.__dict__["_at_rest"] = _found_now(scene) if before is None else before
    try:
        yield
    finally:
        scene.__dict__["_at_rest"] = before


def _found_now(scene: Scene) -> dict[Hashable, Any]:
    """Return what is known at the present values."""
    mark = _mark(scene.values.numpy())
    held: tuple[bytes, dict[Hashable, Any]] | None = scene.__dict__.get("_found")
    if held is None or held[0] != mark:
        held = scene.__dict__["_found"] = (mark, {})
    return held[1]


def _mark(values: np.ndarray) -> bytes:
    """Return by what values are known again: their bytes, or, of many, a digest."""
    return values.tobytes() if values.nbytes <= MOST else hashlib.sha256(values.data).digest()

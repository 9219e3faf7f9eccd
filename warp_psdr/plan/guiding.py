"""What guiding has built for a scene: where it is kept, and what the plan says of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.options.guiding import Method

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


def kept(scene: Scene) -> dict:
    """Return what is kept on a scene: keys that begin with the method -> built structures."""
    return scene.__dict__.setdefault("_guiding", {})


def describe(scene: Scene, method: Method) -> str:
    """Say what a method has built for a scene."""
    found = [g for key, g in kept(scene).items() if key[0] == method]
    if not found:
        return "built with the first gradient"
    leaves, memory = sum(g.leaf_count for g in found), sum(g.memory for g in found)
    return f"{leaves} leaves, {memory / 1e6:.1f} MB; guiding.reset(scene) forgets them"

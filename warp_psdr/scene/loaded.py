"""What a call does with the scene that it is given: nothing else is taken, and edits are followed."""

from __future__ import annotations

from typing import Any


def check_loaded(scene: Any) -> None:
    """Let a scene follow its edits, and refuse what is none: a dictionary, for example, or the name of a file.

    Raises:
        TypeError: it names the call that makes a scene of it.
    """
    from warp_psdr.scene.scene import Scene

    if isinstance(scene, Scene):
        scene.settle()
        return
    remedy = "psdr.load_dict(...)" if isinstance(scene, dict) else "psdr.load_file(...) or psdr.load_dict(...)"
    raise TypeError(f"scene: got {type(scene).__name__}, expected what {remedy} returns")

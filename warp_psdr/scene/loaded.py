"""What a call does when it is given something else than a loaded scene."""

from __future__ import annotations

from typing import Any


def check_loaded(scene: Any) -> None:
    """Refuse what is no scene: a dictionary, for example, or the name of a file.

    Raises:
        TypeError: it names the call that makes a scene of it.
    """
    from warp_psdr.scene.scene import Scene

    if isinstance(scene, Scene):
        return
    remedy = "psdr.load_dict(...)" if isinstance(scene, dict) else "psdr.load_file(...) or psdr.load_dict(...)"
    raise TypeError(f"scene: got {type(scene).__name__}, expected what {remedy} returns")

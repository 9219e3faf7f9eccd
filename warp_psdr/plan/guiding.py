"""Guiding in the plan: where a scene keeps its structures, and what the plan prints of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from warp_psdr.options.guiding import Method
from warp_psdr.plan import choice

if TYPE_CHECKING:
    from warp_psdr.plan.motion import Motion
    from warp_psdr.scene.scene import Scene


def kept(scene: Scene) -> dict:
    """Return what is kept on a scene: keys that begin with the method -> built structures."""
    return scene.__dict__.setdefault("_guiding", {})


@dataclass(eq=False)
class Automatic:
    """What is known of a request whose boundary method is left to the plan (``estimate/guiding/automatic.py``).

    Attributes:
        on: whether its gradients may be guided.
        spent: samples of the gradients so far, about.
        paid: what they cost, in samples of gradients.
        kernels: how many a pilot and a structure need besides those of a gradient; -1: not counted yet.
        plain: (seed, checksum of the scene's values) of the calls that were not guided.
        decided: whether there was a pilot.
        method: what guides; None: nothing.
        said: why.
    """

    on: bool = True
    spent: float = 0.0
    paid: float = 0.0
    kernels: int = -1
    plain: set[tuple] = field(default_factory=set)
    decided: bool = False
    method: Method | None = None
    said: str = "once gradients have cost what compiling a pilot's kernels does, if it says that it pays"


def automatic(scene: Scene, moves: Motion, sensor: int, max_depth: int) -> Automatic:
    """Return what is known of a request: what moves, seen by a sensor, at a depth."""
    every = scene.__dict__.setdefault("_automatic", {})
    found = every.setdefault((moves, sensor, max_depth), Automatic())
    found.on = scene.__dict__.get("_guides", True)
    return found


def set_automatic(scene: Scene, on: bool) -> None:
    """Let ``"auto"`` change how repeated gradients of a scene are sampled, as it does by default, or not.

    That is guiding (``boundary="auto"``) and the choice of an interior method (``interior="auto"``). Both depend on the
    calls before; without them equal seeds and values give equal bits whatever was computed before. Fits
    (``psdr.fit``), which resume with equal bits, do not guide, and keep the choice in their checkpoints.
    """
    if not isinstance(on, bool):
        raise ValueError(f"on: got {on!r}, expected True or False")
    scene.__dict__["_guides"] = on
    choice.set_on(scene, on)


def reset(scene: Scene) -> None:
    """Forget what guiding has built for a scene, what pilots said of it, and which interior methods they chose."""
    kept(scene).clear()
    scene.__dict__.pop("_automatic", None)
    choice.reset(scene)


def describe(scene: Scene, method: Method) -> str:
    """Say what a method has built for a scene."""
    found = [g for key, g in kept(scene).items() if key[0] == method]
    if not found:
        return "built with the first gradient"
    leaves, memory = sum(g.leaf_count for g in found), sum(g.memory for g in found)
    return f"{leaves} leaves, {memory / 1e6:.1f} MB; guiding.reset(scene) forgets them"

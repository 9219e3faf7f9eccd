"""What lies behind more mirrors and glass in a row than are searched: its share of the image, and what the plan says.

A plan traces no path, so the first gradient of a scene before a camera measures the share
(``estimate/boundary/long_chains.py``). Later plans know it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.kernels.boundary.specular.specular_chain import MAX_CHAIN

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Largest share of the image's light that gradients leave the edges out of.
LARGEST_SHARE = 0.01


def possible(max_depth: int) -> bool:
    """Whether paths may be longer than a chain that is searched."""
    return not 0 < max_depth <= MAX_CHAIN


def known(scene: Scene) -> dict[tuple[int, int], float]:
    """Return the shares that were measured, by the number of the camera and max_depth."""
    return scene.__dict__.setdefault("_long_chains", {})


def describe(scene: Scene, sensor: int, max_depth: int) -> list[tuple[str, str, str]]:
    """Return the plan's line on what is left out; empty: nothing is."""
    if not possible(max_depth):
        return []
    share = known(scene).get((sensor, max_depth))
    said = "the first gradient measures its share" if share is None else f"{share:.2%} of the image's light"
    return [("long chains", f"edges behind {MAX_CHAIN} or more mirrors and panes in a row are left out", said)]


def refuse(share: float) -> None:
    """Refuse a gradient that would leave out too much.

    Raises:
        ValueError: the share is above ``LARGEST_SHARE``.
    """
    if share > LARGEST_SHARE:
        raise ValueError(
            f"{share:.1%} of the image's light comes by way of {MAX_CHAIN} or more mirrors, panes or masks in a row, "
            f"and discontinuities are searched through fewer; set max_depth to {MAX_CHAIN} or less; or say "
            "PathIntegrator(boundary=None) to get the interior term alone"
        )

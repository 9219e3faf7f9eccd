"""What the plan says of participating media, and which derivatives in scenes with media it refuses."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.kernels import constants as c
from warp_psdr.options import interior

if TYPE_CHECKING:
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.scene.scene import Scene

PHASE_NAMES = {c.PHASE_ISOTROPIC: "isotropic", c.PHASE_HG: "hg"}


def describe(scene: Scene, config: PathConfig) -> list[tuple[str, str, str]]:
    """Return the plan's lines on the media of a scene; none where there are none."""
    if config.media is None:
        return []
    bounds = sum(sides[0] != c.NO_INTERFACE for sides in scene.builder.sides)
    phases = ", ".join(PHASE_NAMES[kind] for kind in config.media.phases)
    several = f"{len(scene.builder.media)} homogeneous"
    chromatic = "colours: one channel is drawn, all weigh" if config.media.chromatic else "grey: no channel is drawn"
    return [
        ("media", several, f"bounded by {bounds} shapes; null lobes do not count as depth, collisions do"),
        ("phase functions", phases, "those of the media"),
        ("extinction", "by channel" if config.media.chromatic else "grey", chromatic),
    ]


def refuse(config: PathConfig, method: interior.Method, names: list[str]) -> None:
    """Refuse what there is not in scenes with media: derivatives, and light tracing.

    Raises:
        ValueError: with what to do instead.
    """
    if config.media is None:
        return
    if isinstance(method, interior.LightTracing):
        raise ValueError(
            "interior.LightTracing() has no paths through participating media; use interior.Replay(), or leave them out"
        )
    if names:
        raise ValueError(
            f"derivatives by {', '.join(names)}: a scene with participating media has images only; request nothing, or "
            "leave the media out"
        )

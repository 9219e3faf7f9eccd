"""What light tracing calls for: the paths from the camera that are left beside those from the lights."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from warp_psdr.kernels.bsdf.dispatch import has_delta_lobes
from warp_psdr.kernels.constants import METERS
from warp_psdr.kernels.scattering import samples_lights

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.plan.plan import Plan


@dataclass(frozen=True)
class LightTracing:
    """The two passes of light tracing.

    Attributes:
        camera: what paths from the camera compile: the light that is seen, and what is seen by a delta lobe.
        wanted: which derivatives they compute; None: they have none, or primal only.
        joins: whether light paths have vertices that can be joined to the camera.
    """

    camera: PathConfig
    wanted: GradientRequest | None
    joins: bool

    @property
    def line(self) -> tuple[str, str, str]:
        """What the plan says of it."""
        left = "lights, and what mirrors and glass show" if self.camera.scatter else "the lights that it sees"
        return "light paths", "joined to the camera", f"the camera itself draws {left}"


def passes(config: PathConfig, wanted: GradientRequest | None) -> LightTracing:
    """Return the passes for what a scene needs.

    Raises:
        ValueError: the sensor has no film that a point could be joined to.
    """
    if config.camera in METERS:
        raise ValueError(
            "interior.LightTracing() joins points to a film: a 'perspective', 'thinlens' or 'orthographic' camera; a "
            "meter has none. Use interior.Replay()"
        )
    joins = config.scatter and samples_lights(config)
    if config.scatter and has_delta_lobes(config.bsdfs):
        return LightTracing(replace(config, delta_first=True), wanted, joins)
    camera = replace(config, scatter=False, bsdfs=("diffuse",), material=(), tangent=False, through=False)
    seen = wanted is not None and bool(wanted.radiance or wanted.lights or wanted.to_uv)
    return LightTracing(camera, replace(wanted, material=()) if wanted is not None and seen else None, joins)


def refuse_light_paths(plan: Plan, who: str) -> None:
    """Raise if a plan has light paths, for who spreads samples over pixels.

    Raises:
        ValueError: with what to do instead.
    """
    if plan.light is not None:
        raise ValueError(
            f"{who} draws samples of pixels, and the paths of interior.LightTracing() belong to none; call psdr.render "
            "with spp and seeds of your own, or use interior.Replay()"
        )

"""What light tracing calls for: the paths from the camera that are left beside those from the lights."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from warp_psdr.kernels.bsdf.dispatch import has_delta_lobes
from warp_psdr.kernels.constants import DELTA_LIGHTS, EMITTER_CONSTANT, EMITTER_ENVMAP, METERS
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
    if wanted is not None:
        environment = {EMITTER_CONSTANT, EMITTER_ENVMAP} & set(config.lights)
        of_lights = (config.area and (wanted.radiance or wanted.to_uv)) or (environment and wanted.lights)
        wanted = replace(wanted, material=()) if of_lights else None
    return LightTracing(camera, wanted, joins)


def refused_by_light_tracing(config: PathConfig, wanted: GradientRequest) -> str:
    """Return why light tracing cannot compute derivatives; empty: it can."""
    if wanted.geometry:
        return (
            "interior.LightTracing() differentiates what moves no vertices of its paths: materials, textures, "
            "radiances, intensities and poses of lights. What moves shapes, normals, texture coordinates or the "
            "camera, or turns rays, as the index of refraction of glass does, takes interior.Replay()"
        )
    if "pose" in wanted.lights and DELTA_LIGHTS & set(config.lights) and has_delta_lobes(config.bsdfs):
        return (
            "interior.LightTracing() cannot move a point, spot, projector or directional light in a scene with "
            "mirrors, glass or masks, behind which its rays would move too; request its intensity, or use "
            "interior.Replay()"
        )
    return ""


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

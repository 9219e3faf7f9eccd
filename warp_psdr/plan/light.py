"""What light paths call for: the paths from the camera beside them, and what is refused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from warp_psdr.kernels.bsdf.dispatch import has_delta_lobes, models_of
from warp_psdr.kernels.constants import (
    CAMERA_RADIANCEMETER,
    DELTA_LIGHTS,
    EMITTER_CONSTANT,
    EMITTER_ENVMAP,
    LOBE_DELTA_TRANSMISSION,
)
from warp_psdr.kernels.scattering import samples_lights
from warp_psdr.options import interior

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.plan.plan import Plan


@dataclass(frozen=True)
class LightTracing:
    """The two passes of light tracing, or of bidirectional paths.

    Attributes:
        method: which of the two.
        paths: what the light paths compile.
        camera: what paths from the camera compile: the light that is seen, and what is seen by a delta lobe.
        wanted: which derivatives they compute; None: they have none, or primal only.
        joins: whether light paths have vertices that can be joined to the camera.
    """

    method: interior.Method
    paths: PathConfig
    camera: PathConfig
    wanted: GradientRequest | None
    joins: bool

    @property
    def connected(self) -> bool:
        """Whether one pass draws both kinds of paths, joined to each other."""
        return self.paths.connections == "all"

    @property
    def line(self) -> tuple[str, str, str]:
        """What the plan says of it."""
        if isinstance(self.method, interior.Bidirectional):
            ways = "each path by all ways to draw it"
            if self.connected:
                return "light paths", "joined to the camera and to its paths", ways
            ways = ways if self.joins else "there are none: nothing can be joined"
            return "light paths", "weighted with those from the camera", ways
        left = "lights, and what mirrors and glass show" if self.camera.scatter else "the lights that it sees"
        return "light paths", "joined to the camera", f"the camera itself draws {left}"


def passes(config: PathConfig, wanted: GradientRequest | None, method: interior.Method, max_depth: int) -> LightTracing:
    """Return the passes for what a scene needs.

    Raises:
        ValueError: no point can be joined to the sensor, lights are hidden, or paths are too long to be kept.
    """
    name = type(method).__name__
    if config.camera == CAMERA_RADIANCEMETER:
        raise ValueError(
            f"interior.{name}() joins points to a film, or to the shape of an 'irradiancemeter'; the one ray of a "
            "'radiancemeter' meets none of them. Use interior.Replay()"
        )
    joins = config.scatter and samples_lights(config)
    if isinstance(method, interior.Bidirectional):
        if config.hide_emitters:
            raise ValueError(
                "interior.Bidirectional() weighs the light that the camera sees against that which it does not, and "
                "hide_emitters takes it away; leave hide_emitters out, or use interior.LightTracing()"
            )
        if not joins:
            return LightTracing(method, config, config, wanted, joins)
        both = replace(config, connections=method.connections)
        if method.connections == "all":
            if not 0 < max_depth <= interior.MOST_CONNECTED:
                raise ValueError(
                    f"interior.Bidirectional(connections='all') keeps whole paths: max_depth: got {max_depth}, "
                    f"expected 1 to {interior.MOST_CONNECTED}; or use connections='light'"
                )
            both = replace(both, most_vertices=max(4, 1 << (max_depth - 1).bit_length()))
            return LightTracing(method, both, both, None, joins)
        return LightTracing(method, both, both, wanted, joins)
    if config.scatter and has_delta_lobes(config.bsdfs):
        return LightTracing(method, config, replace(config, delta_first=True), wanted, joins)
    camera = replace(config, scatter=False, bsdfs=("diffuse",), material=(), tangent=False, through=False)
    if wanted is not None:
        environment = {EMITTER_CONSTANT, EMITTER_ENVMAP} & set(config.lights)
        of_lights = (config.area and (wanted.radiance or wanted.to_uv)) or (environment and wanted.lights)
        wanted = replace(wanted, material=()) if of_lights else None
    return LightTracing(method, config, camera, wanted, joins)


def refused_with_light_paths(name: str, config: PathConfig, wanted: GradientRequest) -> str:
    """Return why a method with light paths cannot compute derivatives; empty: it can."""
    if wanted.geometry:
        return (
            f"{name} differentiates what moves no vertices of its paths: materials, textures, "
            "radiances, intensities and poses of lights. What moves shapes, normals, texture coordinates or the "
            "camera, or turns rays, as the index of refraction of glass does, takes interior.Replay()"
        )
    if "pose" in wanted.lights and DELTA_LIGHTS & set(config.lights) and has_delta_lobes(config.bsdfs):
        return (
            f"{name} cannot move a point, spot, projector or directional light in a scene with "
            "mirrors, glass or masks, behind which its rays would move too; request its intensity, or use "
            "interior.Replay()"
        )
    return ""


def left_out(config: PathConfig) -> list[tuple[str, str, str]]:
    """Return the plan's line of light that no path from the camera finds, if there is any.

    Lights of no area shine through glass and by mirrors, and next-event estimation never meets these. Derivatives are
    those of the image, so that no method of theirs finds it where the image does not.
    """
    turns = any(model.mirrors or LOBE_DELTA_TRANSMISSION in model.lobes for model in models_of(config.bsdfs))
    if not (turns and DELTA_LIGHTS & set(config.lights)):
        return []
    reason = "a light has no area: interior.LightTracing() or interior.Bidirectional() finds it, image and derivatives"
    return [("light by mirrors and glass", "left out", reason)]


def refuse_connected(plan: Plan, who: str) -> None:
    """Raise if paths from the camera and from lights are drawn together, for who draws them apart.

    Raises:
        ValueError: with what to do instead.
    """
    if plan.light is not None and plan.light.connected:
        raise ValueError(
            f"{who} draws paths from the camera and paths from the lights apart, and "
            "interior.Bidirectional(connections='all') draws them together; use connections='light', or call "
            "psdr.render with spp and seeds of your own"
        )

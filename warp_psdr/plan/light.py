"""What light paths call for: the paths from the camera beside them, where they join these, and what is refused."""

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
from warp_psdr.plan.replay import Kept, keep_blocks
from warp_psdr.topology.behind_glass import lights_behind_glass

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.plan.plan import Plan
    from warp_psdr.scene.scene import Scene

#: What the plan calls the light that no path from the camera finds.
BY_GLASS = "light by mirrors and glass"
#: Vertices of its shortest path: the light, a mirror or glass, and what is lit.
SHORTEST = 3


@dataclass(frozen=True)
class LightTracing:
    """The two passes of light tracing, or of bidirectional paths; or light paths that join those of the camera.

    Attributes:
        method: which of the two.
        paths: what the light paths compile.
        camera: what paths from the camera compile: the light that is seen, and what is seen by a delta lobe.
        wanted: which derivatives they compute; None: they have none, or primal only.
        joins: whether light paths have vertices that can be joined to the camera.
        kept: what of a light path that joins is kept; None: what the method keeps.
    """

    method: interior.Method
    paths: PathConfig
    camera: PathConfig
    wanted: GradientRequest | None
    joins: bool
    kept: Kept | None = None

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
    with_area = (
        "; of what mirrors and glass turn that sees only the light of lights with an area: in place of a light of no "
        "area take a small sphere, whose caustics interior.Replay() with boundary.PathSpace() differentiates, edges "
        "included"
        if has_caustics(config)
        else ""
    )
    if wanted.geometry:
        return (
            f"{name} differentiates what moves no vertices of its paths: materials, textures, "
            "radiances, intensities and poses of lights. What moves shapes, normals, texture coordinates or the "
            f"camera, or turns rays, as the index of refraction of glass does, takes interior.Replay(){with_area}"
        )
    if "pose" in wanted.lights and DELTA_LIGHTS & set(config.lights) and has_delta_lobes(config.bsdfs):
        return (
            f"{name} cannot move a point, spot, projector or directional light in a scene with "
            "mirrors, glass or masks, behind which its rays would move too; request its intensity, or use "
            f"interior.Replay(){with_area}"
        )
    return ""


def left_out(config: PathConfig) -> list[tuple[str, str, str]]:
    """Return the plan's line of light that no path from the camera finds, if there is any.

    Lights of no area shine through glass and by mirrors, and next-event estimation never meets these. Derivatives are
    those of the image, so that no method of theirs finds it where the image does not.
    """
    if not has_caustics(config):
        return []
    reason = (
        "a light has no area: PathIntegrator(caustics=True), interior.LightTracing() or interior.Bidirectional() finds "
        "it, image and derivatives"
    )
    return [(BY_GLASS, "left out", reason)]


def has_caustics(config: PathConfig) -> bool:
    """Whether mirrors or glass may turn light of lights of no area."""
    turns = any(model.mirrors or LOBE_DELTA_TRANSMISSION in model.lobes for model in models_of(config.bsdfs))
    return turns and bool(DELTA_LIGHTS & set(config.lights))


def joined(
    scene: Scene,
    config: PathConfig,
    wanted: GradientRequest | None,
    integrator: PathIntegrator,
    automatic: bool,
    moving: tuple[str, ...],
) -> tuple[LightTracing | None, list[tuple[str, str, str]]]:
    """Return the light paths that join those of the camera, if any do, and what the plan says.

    Args:
        scene: a loaded scene.
        config: what paths from the camera compile.
        wanted: which derivatives; None: primal only.
        integrator: with the method of the interior that it stands for.
        automatic: whether the plan has chosen that method.
        moving: what moves discontinuities.

    Raises:
        ValueError: they join, and what is requested is not differentiated through them, or they were asked for and
            cannot join.
    """
    reason = _cannot_join(config)
    if integrator.caustics is True and reason:
        raise ValueError(f"caustics=True: {reason}; say caustics=False")
    if config.media is not None or integrator.max_depth == 1:
        return None, []
    if not has_caustics(config) or 0 < integrator.max_depth < SHORTEST or reason or integrator.caustics is False:
        return None, left_out(config)
    behind = lights_behind_glass(scene) if automatic and integrator.caustics == "auto" else ()
    if not behind and integrator.caustics is not True:
        return None, left_out(config)
    why = f"{', '.join(behind)} shines by mirrors and glass alone" if behind else "caustics=True"
    if wanted is not None:
        refused = refused_with_light_paths("light tracing", config, wanted)
        if moving and not refused:
            refused = f"light tracing does not follow what moves discontinuities: {moving[0]}"
        if refused:
            raise ValueError(
                f"{why}, and light paths join those of the camera: {refused}. PathIntegrator(caustics=False) leaves "
                "this light out of images and derivatives alike"
            )
        if not (any(wanted.material) or wanted.to_uv or wanted.lights):
            return None, [(BY_GLASS, "not differentiated", "what is requested does not change it")]
    own = replace(config, caustics=True)
    kept = keep_blocks(interior.Replay(), integrator.max_depth, integrator.rr_depth) if wanted is not None else None
    light = LightTracing(interior.LightTracing(), own, config, wanted, True, kept)
    return light, [(BY_GLASS, "light tracing joins", why)]


def _cannot_join(config: PathConfig) -> str:
    """Say why light paths cannot join those of the camera; empty: they can."""
    if config.media is not None:
        return "light paths are not followed through participating media"
    if config.primitives:
        return "light paths do not meet shapes without triangles"
    if config.pulse:
        return "light paths are not timed"
    if config.camera == CAMERA_RADIANCEMETER:
        return "no light path meets the one ray of a 'radiancemeter'"
    return ""


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

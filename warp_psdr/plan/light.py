"""Light paths in the plan: the camera paths beside them, where the two are combined, and what is refused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from warp_psdr.kernels.bsdf.dispatch import has_delta_lobes, has_null_lobes, has_smooth_lobes, models_of
from warp_psdr.kernels.constants import (
    CAMERA_IRRADIANCEMETER,
    DELTA_LIGHTS,
    EMITTER_CONSTANT,
    EMITTER_ENVMAP,
    LOBE_DELTA_TRANSMISSION,
    RFILTER_BOX,
)
from warp_psdr.kernels.scattering import samples_lights
from warp_psdr.options import interior
from warp_psdr.plan.boundary import edge_of_light
from warp_psdr.plan.motion import motion, moves_vertices
from warp_psdr.plan.needs import unknown
from warp_psdr.rows.replay import MOST_KEPT, Kept, keep_blocks
from warp_psdr.scene.layout import LIGHT_POSE
from warp_psdr.topology.behind_glass import lights_behind_glass

if TYPE_CHECKING:
    from collections.abc import Mapping

    from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.options.words import Word
    from warp_psdr.plan.plan import Plan
    from warp_psdr.scene.scene import Scene

#: What the plan calls the light that no path from the camera finds.
BY_GLASS = "light by mirrors and glass"
#: Vertices of its shortest path: the light, a mirror or glass, and what is lit.
SHORTEST = 3
#: What else differentiates caustics.
BY_SPHERES = (
    "With a small sphere in place of a light of no area interior.Replay() and boundary.PathSpace() differentiate "
    "caustics, edges included"
)


#: What the plan says where light paths draw the image, and paths from the camera estimate its derivative.
NOT_FOLLOWED = (
    "light paths",
    "draw the image alone",
    "its derivative by what moves vertices is that of paths from the camera, whose image has the same mean",
)


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
        moves: whether vertices of light paths move.
    """

    method: interior.Method
    paths: PathConfig
    camera: PathConfig
    wanted: GradientRequest | None
    joins: bool
    kept: Kept | None = None
    moves: bool = False

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
        if self.moves:
            return "light paths", "joined to the camera, their vertices move", "interior term alone"
        left = "lights, and what mirrors and glass show" if self.camera.scatter else "the lights that it sees"
        return "light paths", "joined to the camera", f"the camera itself draws {left}"


def followed_by_camera(
    config: PathConfig, wanted: GradientRequest | None, integrator: PathIntegrator
) -> PathIntegrator | None:
    """Return the integrator whose paths from the camera estimate what moves vertices of light paths; None: these do.

    Both images have the same mean. Where mirrors or glass turn light of lights of no area, light paths join those from
    the camera. ``interior.LightTracing()`` with ``boundary=None`` is the interior term of its own.
    """
    method = integrator.interior
    own = isinstance(method, interior.LightTracing) and integrator.boundary is None
    if not isinstance(method, interior.FROM_LIGHTS) or own or wanted is None:
        return None
    if not (moves_vertices(config, wanted) or wanted.camera):
        return None
    caustics = has_caustics(config) or integrator.caustics
    return replace(integrator, interior=interior.Replay(), caustics=caustics)


def passes(
    scene: Scene,
    config: PathConfig,
    wanted: GradientRequest | None,
    method: interior.Method,
    integrator: PathIntegrator,
    names: list[str],
) -> LightTracing:
    """Return the passes for what a scene needs.

    Raises:
        ValueError: no point can be joined to the sensor, lights are hidden, paths are too long to be kept, or what is
            requested moves vertices in a way that is not differentiated.
    """
    max_depth = integrator.max_depth
    joins = config.scatter and samples_lights(config.lights, config.surfaces.bsdfs)
    if isinstance(method, interior.Bidirectional):
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
    moves = wanted is not None and moves_vertices(config, wanted)
    if moves:
        refused = refused_while_vertices_move(scene, config, wanted, integrator, names)
        if refused:
            raise ValueError(f"interior.LightTracing() {refused}")
    if config.scatter and has_delta_lobes(config.surfaces.bsdfs):
        return LightTracing(method, config, replace(config, delta_first=True), wanted, joins, moves=moves)
    surfaces = replace(config.surfaces, bsdfs=("diffuse",), material=(), tangent=False)
    camera = replace(config, scatter=False, surfaces=surfaces, through=False)
    if wanted is not None:
        environment = {EMITTER_CONSTANT, EMITTER_ENVMAP} & set(config.lights.others)
        of_lights = (config.lights.area and (wanted.radiance or wanted.to_uv)) or (environment and wanted.lights)
        seen = of_lights or (wanted.geometry and (config.lights.area or environment))
        wanted = replace(wanted, material=()) if seen else None
    return LightTracing(method, config, camera, wanted, joins, moves=moves)


def refused_while_vertices_move(
    scene: Scene, config: PathConfig, wanted: GradientRequest, integrator: PathIntegrator, names: list[str]
) -> str:
    """Return why light paths cannot follow what moves; empty: they can."""
    if integrator.boundary is not None:
        return (
            "has no boundary term for edges that its paths cross where vertices move; PathIntegrator(boundary=None) "
            "gives the interior term alone, which is whole where no edge of a surface, and no edge of what the camera "
            f"sees, lies in the light that moves. {BY_SPHERES}"
        )
    if wanted.camera:
        return "does not differentiate by the camera; use interior.Replay()"
    if config.camera == CAMERA_IRRADIANCEMETER:
        return "does not follow what moves before an 'irradiancemeter'; use interior.Replay(), or a camera"
    if config.filter == RFILTER_BOX:
        return (
            "needs a filter without steps where vertices move on the film: give the film an 'rfilter' of type "
            "'gaussian' or 'tent'"
        )
    if not 0 < integrator.max_depth <= MOST_KEPT:
        return (
            "keeps whole paths where their vertices move: max_depth: got "
            f"{integrator.max_depth}, expected 1 to {MOST_KEPT}"
        )
    shining = [s.path for i, s in enumerate(scene.description.shapes) if s.emitter and i in motion(scene, names).shapes]
    if shining:
        return f"does not move the shape of a light, {shining[0]!r}; use interior.Replay()"
    turned = {name.rpartition(".")[0] for name in names if LIGHT_POSE in scene.parameters[name].uses}
    for light, e in zip(scene.description.emitters, scene.builder.emitters, strict=True):
        edge = edge_of_light(scene, e) if light.path in turned else ""
        if edge:
            return f"does not move {light.path!r}: {edge}"
    return ""


def shadow_rays_pass(
    scene: Scene, integrator: PathIntegrator, models: tuple[str, ...], lights: tuple[int, ...]
) -> bool:
    """Whether shadow rays pass surfaces by their null lobes.

    ``caustics=False`` leaves out what lights of no area send through them, as it does with mirrors and glass; of other
    lights paths find it. Media are bounded by such surfaces, and paths from lights pass them.
    """
    from_lights = isinstance(integrator.interior, interior.FROM_LIGHTS)
    dark = integrator.caustics is False and not scene.builder.media and not from_lights
    return has_null_lobes(models) and not (dark and DELTA_LIGHTS & set(lights))


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
    turns = any(model.mirrors or LOBE_DELTA_TRANSMISSION in model.lobes for model in models_of(config.surfaces.bsdfs))
    return turns and bool(DELTA_LIGHTS & set(config.lights.others))


def joined(
    scene: Scene,
    config: PathConfig,
    wanted: GradientRequest | None,
    integrator: PathIntegrator,
    automatic: bool,
    names: list[str],
    moving: tuple[str, ...],
    needed: Mapping[str, Word],
) -> tuple[LightTracing | None, list[tuple[str, str, str]]]:
    """Return the light paths that join those of the camera, if any do, and what the plan says.

    Args:
        scene: a loaded scene.
        config: what paths from the camera compile.
        wanted: which derivatives; None: primal only.
        integrator: with the method of the interior that it stands for.
        automatic: whether the plan has chosen that method.
        names: what is requested.
        moving: what moves discontinuities.
        needed: words of the scene and the request.

    Raises:
        ValueError: they join, and what is requested is not differentiated through them, or they were asked for and
            cannot join.
    """
    reason = unknown(interior.LightTracing(), needed, ())
    if not reason and not has_smooth_lobes(config.surfaces.bsdfs):
        reason = "finds no surface that scatters light towards the camera but by mirrors and glass"
    if integrator.caustics is True and reason:
        raise ValueError(f"caustics=True: light tracing {reason}; or say caustics=False")
    if config.media is not None or integrator.max_depth == 1:
        return None, []
    if not has_caustics(config) or 0 < integrator.max_depth < SHORTEST or reason or integrator.caustics is False:
        return None, left_out(config)
    behind = lights_behind_glass(scene) if automatic and integrator.caustics == "auto" else ()
    if not behind and integrator.caustics is not True:
        return None, left_out(config)
    why = f"{', '.join(behind)} shines by mirrors and glass alone" if behind else "caustics=True"
    moves = wanted is not None and moves_vertices(config, wanted)
    if wanted is not None:
        refused = ""
        if moves:
            refused = refused_while_vertices_move(scene, config, wanted, integrator, names)
        elif moving:
            refused = f"does not follow what moves discontinuities: {moving[0]}"
        if refused:
            raise ValueError(
                f"{why}, and light paths join those of the camera: light tracing {refused}. "
                "PathIntegrator(caustics=False) leaves this light out of images and derivatives alike"
            )
        if not (any(wanted.material) or wanted.to_uv or wanted.lights or moves):
            return None, [(BY_GLASS, "not differentiated", "what is requested does not change it")]
    own = replace(config, caustics=True)
    kept = keep_blocks(interior.Replay(), integrator.max_depth, integrator.rr_depth) if wanted is not None else None
    light = LightTracing(interior.LightTracing(), own, config, wanted, True, kept, moves)
    return light, [(BY_GLASS, "light tracing joins", why)]


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

"""Shapes without triangles in a plan: which kinds a scene holds, what is said of them, and what they do not do yet."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.kernels.bsdf.dispatch import has_delta_lobes
from warp_psdr.kernels.constants import METERS
from warp_psdr.options import interior
from warp_psdr.options.boundary import Method, PathSpace
from warp_psdr.plan.motion import motion
from warp_psdr.scene.exact import EXACT
from warp_psdr.topology.exact_shapes import pierced

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.scene.scene import Scene

#: Methods of the interior term that know such shapes.
CLAIMED = (interior.Replay, interior.Textbook, interior.Radiative)
#: What the errors offer.
INSTEAD = "leave out 'exact', and it is made of triangles, which do"


def kinds(scene: Scene) -> tuple[int, ...]:
    """Return the kinds (PRIMITIVE_*) of a scene, for the path loop."""
    return tuple(sorted({EXACT[scene.description.shapes[i].primitive] for i in scene.builder.primitives}))


def describe(scene: Scene) -> list[tuple[str, str, str]]:
    """Return the plan's line."""
    names: dict[str, list[str]] = {}
    for i in scene.builder.primitives:
        shape = scene.description.shapes[i]
        names.setdefault(shape.primitive, []).append(shape.path)
    what = ", ".join(f"{len(paths)} {kind}" for kind, paths in names.items())
    return [("exact shapes", what, "without triangles; every ray is tested against each")] if names else []


def refuse(
    scene: Scene,
    config: PathConfig,
    integrator: PathIntegrator,
    wanted: GradientRequest | None,
    names: list[str],
    moving: tuple[str, ...],
) -> None:
    """Raise for what is not done beside shapes without triangles.

    Raises:
        ValueError: with the shape, and what to do.
    """
    if not config.primitives:
        return
    shape = scene.description.shapes[scene.builder.primitives[0]]
    reason = ""
    if config.media is not None:
        reason = "participating media do not know it"
    elif isinstance(integrator.interior, interior.LightTracing):
        reason = "paths from the lights do not meet it; use interior.Replay()"
    elif wanted is not None and not isinstance(integrator.interior, CLAIMED):
        reason = f"interior.{type(integrator.interior).__name__}() does not know it; use interior.Replay()"
    elif moving and integrator.boundary is not None:
        reason = _beside_motion(scene, config, integrator, names)
    if reason:
        raise ValueError(f"{shape.path!r} is an exact {shape.kind!r}, and {reason}; or {INSTEAD}")


def _beside_motion(scene: Scene, config: PathConfig, integrator: PathIntegrator, names: list[str]) -> str:
    """Say which boundary term is missing where something moves; empty: none."""
    method = integrator.boundary
    if isinstance(method, Method) and (type(method) is not PathSpace or method.guiding is not None):
        return f"{method.label}() has no terms of it; use boundary.PathSpace() without guiding"
    if config.camera in METERS:
        return "what moves is not followed from a sensor of one pixel; use a camera"
    if has_delta_lobes(config.bsdfs):
        return "what moves is not followed through smooth mirrors and glass beside it; make them rough"
    moves = motion(scene, names)
    pair = pierced(scene, None if moves.camera else moves.shapes)
    if pair is not None:
        a, b = (scene.description.shapes[i].path for i in pair)
        return f"{b!r} runs through the surface of {a!r}, along a curve that moves; move them apart"
    return ""

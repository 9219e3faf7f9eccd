"""The passes over light paths (``kernels/light_path.py``): the image, and its derivatives in both modes.

A pass draws as many paths as the image has pixels times samples, and adds to what it is given.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch
from warp_psdr.estimate.draw import Draw
from warp_psdr.estimate.jobs import PixelSamples
from warp_psdr.estimate.passes import (
    STREAM_INTERIOR,
    Progress,
    blocks_of,
    camera_gradient_kernels,
    depth_of,
    image_kernel,
    interior_backward,
    interior_forward,
    launch_pass,
    part,
)
from warp_psdr.kernels.connection import make_connected_image_kernel
from warp_psdr.kernels.films import collect_splats
from warp_psdr.kernels.interior.connected import make_connected_kernel
from warp_psdr.kernels.interior.light_motion_replay import (
    make_light_motion_forward_kernel,
    make_light_motion_kernel,
)
from warp_psdr.kernels.interior.light_tracing import make_light_forward_kernel, make_light_replay_kernel
from warp_psdr.kernels.light_ray import COVER
from warp_psdr.kernels.light_tracing import make_light_image_kernel
from warp_psdr.kernels.rng import mix_seed

if TYPE_CHECKING:
    from warp_psdr.estimate.gradient_sums import GradientSums
    from warp_psdr.kernels.structs import Camera
    from warp_psdr.plan.plan import Plan
    from warp_psdr.scene.scene import Scene

#: Stream of the light paths, beside that of the camera's in the same pass.
STREAM_LIGHT = 0x6C696768
#: Paths over pixels that are summed on a film in float32. They are not spread evenly: a pixel in a caustic counts a
#: thousand times as many, with a relative rounding error of some 1e-3 at most.
FILM_PATHS = 1 << 8


def connected(plan: Plan) -> bool:
    """Whether the pass over light paths draws the camera's too."""
    return traces(plan) and plan.light is not None and plan.light.connected


def image_kernels(scene: Scene, plan: Plan, sensor: int) -> list[wp.Kernel]:
    """Return the kernels of a sensor's image, of paths from the camera and of those from the lights."""
    return [*([] if connected(plan) else [image_kernel(scene, plan, sensor)]), *_kernels(plan)]


def _kernels(plan: Plan) -> list[wp.Kernel]:
    """Return the kernel of the image's light paths, if there are any."""
    if connected(plan):
        return [make_connected_image_kernel(plan.config)]
    return [make_light_image_kernel(plan.light.paths)] if plan.light is not None and traces(plan) else []


def film_of(
    scene: Scene, plan: Plan, sensor: int, draw: Draw, seed: int, progress: Progress | None = None
) -> wp.array | None:
    """Return what the light paths find, (H, W) of vec3d; None: there are none.

    ``seed`` is that of the image's other paths.
    """
    return _splatted(scene, plan, _kernels(plan), sensor, draw, seed, [], progress)


def gradient_kernels(plan: Plan, role: str) -> list[wp.Kernel]:
    """Return the kernels of the interior term, of role "reverse" or "forward": from the camera, and from the lights."""
    found = camera_gradient_kernels(plan, role) if plan.seen_wanted is not None else []
    return [*found, *_gradient_kernels(plan, role)]


def backward(
    scene: Scene,
    plan: Plan,
    sensor: int,
    draw: Draw,
    seed: int,
    adjoint: wp.array,
    sums: GradientSums,
    progress: Progress | None = None,
) -> None:
    """Add the gradient of the interior term, of paths from the camera and of those from the lights."""
    first, second = _halves(plan, progress)
    if plan.seen_wanted is not None:
        interior_backward(scene, plan, sensor, draw, seed, adjoint, sums, first)
    light_backward(scene, plan, sensor, draw, seed, adjoint, sums, second)


def light_backward(
    scene: Scene,
    plan: Plan,
    sensor: int,
    draw: Draw,
    seed: int,
    adjoint: wp.array,
    sums: GradientSums,
    progress: Progress | None = None,
) -> None:
    """Add the gradient of what the light paths find."""
    camera = scene.camera(sensor)
    sphere = bounding_sphere(scene)
    # What draws the camera's paths too has a film, which it leaves.
    unused = [wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)] if connected(plan) else []
    for kernel in _gradient_kernels(plan, "reverse"):
        launch_pass(
            scene,
            kernel,
            (camera.crop_width, camera.crop_height),
            replace(_paths(plan, camera, draw, mix_seed(seed, STREAM_INTERIOR)), adjoint=adjoint),
            camera,
            lambda shard: [sphere, sums.buffer(shard), *unused],
            shards=sums.shards,
            kind="light",
            progress=progress,
            share=draw.share,
        )


def forward(
    scene: Scene,
    plan: Plan,
    sensor: int,
    draw: Draw,
    seed: int,
    target: wp.array,
    image: wp.array,
    progress: Progress | None = None,
) -> wp.array | None:
    """Add the derivative of the interior term along flat tangents to an image, that of paths from the camera.

    Returns:
        That of the paths from the lights, (H, W) of vec3d; None: there are none.
    """
    first, second = _halves(plan, progress)
    if plan.seen_wanted is not None:
        interior_forward(scene, plan, sensor, draw, seed, target, image, first)
    return light_forward(scene, plan, sensor, draw, seed, target, second)


def light_forward(
    scene: Scene,
    plan: Plan,
    sensor: int,
    draw: Draw,
    seed: int,
    target: wp.array,
    progress: Progress | None = None,
) -> wp.array | None:
    """Return the derivative of what the light paths find, along flat tangents, (H, W) of vec3d; None: nothing."""
    kernels = _gradient_kernels(plan, "forward")
    return _splatted(scene, plan, kernels, sensor, draw, mix_seed(seed, STREAM_INTERIOR), [target], progress)


def _halves(plan: Plan, progress: Progress | None) -> tuple[Progress | None, Progress | None]:
    """Split a call's progress over the paths from the camera and those from the lights."""
    if plan.light is None:
        return progress, None
    return part(progress, 0.0, 0.5), part(progress, 0.5, 0.5)


def _gradient_kernels(plan: Plan, role: str) -> list[wp.Kernel]:
    """Return the kernels of the light paths' derivatives, if there are any; their results add up."""
    if plan.light is None or not traces(plan):
        return []
    assert plan.wanted is not None and plan.kept is not None
    paths, kept = plan.light.paths, plan.light.kept or plan.kept
    if plan.light.moves:
        make = make_light_motion_forward_kernel if role == "forward" else make_light_motion_kernel
        return [make(paths, plan.wanted, kept.longest)]
    found = [make_connected_kernel(paths, plan.wanted, role)] if connected(plan) else []
    if role == "forward":
        return [*found, make_light_forward_kernel(paths, plan.wanted)]
    return found or [make_light_replay_kernel(paths, plan.wanted, kept.block, kept.blocks)]


def _paths(plan: Plan, camera: Camera, draw: Draw, seed: int) -> PixelSamples:
    """Return the light paths of a pass."""
    scale = 1.0 / (float(draw.spp) * camera.crop_width * camera.crop_height)
    depth = depth_of(plan, None if plan.light is None else plan.light.kept)
    random = mix_seed(seed, STREAM_LIGHT)
    return PixelSamples(draw.count, random, depth, plan.rr_depth, scale=scale, first_sample=draw.first)


def traces(plan: Plan) -> bool:
    """Whether there is a pass over light paths."""
    return plan.light is not None and plan.light.joins and plan.max_depth != 1


def _splatted(
    scene: Scene,
    plan: Plan,
    kernels: list[wp.Kernel],
    sensor: int,
    draw: Draw,
    seed: int,
    inputs: list,
    progress: Progress | None,
) -> wp.array | None:
    """Run kernels that splat to films, and return the sum of these, (H, W) of vec3d; None: there are no kernels."""
    if not kernels:
        return None
    camera = scene.camera(sensor)
    shape = (camera.crop_height, camera.crop_width)
    sphere = bounding_sphere(scene)
    shards = workers.shard_count(3 * shape[0] * shape[1]) if scene.device.is_cpu else 1
    own = draw.share.of(shards) if scene.device.is_cpu else range(1)
    lanes = (max(len(own), 1), *shape)
    films = wp.zeros(lanes, dtype=wp.vec3, device=scene.device)
    totals = wp.zeros(lanes, dtype=wp.vec3d, device=scene.device)
    paths = _paths(plan, camera, draw, seed)
    for i, kernel in enumerate(kernels):
        told = part(progress, i / len(kernels), 1.0 / len(kernels))
        for first, samples, reported in blocks_of(draw, FILM_PATHS, told):
            launch_pass(
                scene,
                kernel,
                (camera.crop_width, camera.crop_height),
                replace(paths, samples=samples, first_sample=first),
                camera,
                lambda shard: [sphere, *inputs, films[shard - own.start]],
                shards=shards,
                kind="light",
                progress=reported,
                share=draw.share,
            )
            launch(collect_splats, dim=lanes, inputs=[films], outputs=[totals], device=scene.device)
    return workers.tree_sum(totals)


def bounding_sphere(scene: Scene) -> wp.vec4:
    """Center and radius of a sphere that holds the scene."""
    points = scene.points
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(3), np.zeros(3))
    center = 0.5 * (low.astype(np.float64) + high)
    return wp.vec4(*center.tolist(), (1.0 + COVER) * scene.radius)

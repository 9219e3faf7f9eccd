"""The derivative image term by term: interior, smooth silhouettes, edges and creases."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.device import launch
from warp_psdr.estimate import light
from warp_psdr.estimate.arguments import checked_seed, flat_tangents, sample_count
from warp_psdr.estimate.boundary.drivers import launch_forward
from warp_psdr.estimate.boundary.terms import by_parts
from warp_psdr.estimate.draw import Draw
from warp_psdr.estimate.passes import STREAM_BOUNDARY
from warp_psdr.image import Image
from warp_psdr.kernels.films import add_splats
from warp_psdr.kernels.reduction import add_image
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.integrator import Integrator
from warp_psdr.plan.integrator import integrator_of
from warp_psdr.plan.plan import decide
from warp_psdr.plan.transient import require_steady
from warp_psdr.scene.loaded import check_loaded

if TYPE_CHECKING:
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene


def render_parts(
    scene: Scene,
    params: Parameters,
    tangents: dict,
    *,
    sensor: int | str = 0,
    integrator: Integrator | None = None,
    spp: int | None = None,
    seed: int = 0,
) -> dict[str, Image]:
    """Render the derivative of the image along a direction of parameter space, each term by itself.

    Args:
        scene: a loaded scene.
        params: its parameters.
        tangents: as of ``render_forward``.
        sensor: which camera, by its number or its id; not a batch.
        integrator: as of ``render``; ``interior="auto"`` replays, and ``boundary="auto"`` is not guided.
        spp: samples a pixel; default: the sensor's sample count.
        seed: equal seeds give equal bits.

    Returns:
        Images (H, W) of vec3, which add up to the derivative: "interior", what changes at a point that is seen;
        "smooth", the silhouettes of round surfaces, with the rims of exact shapes and the ends of tubes; "edges", all
        other discontinuities: edges of meshes, creases of linear grids, curves of intersection, hard shadows.

    Raises:
        ValueError: as of ``render_forward``, or a batch of sensors.
    """
    check_loaded(scene)
    number = scene.description.camera_number(sensor)
    require_steady(scene, number, "render_parts")
    if not tangents:
        raise ValueError("render_parts needs at least one tangent: {'parameter name': direction}")
    spp, seed = sample_count(scene, number, spp), checked_seed(seed)
    names = list(tangents)
    target = flat_tangents(scene, params, tangents)
    plan = decide(scene, integrator=integrator_of(scene, integrator), sensor=number, names=names)
    camera = scene.camera(number)
    size = (camera.crop_height, camera.crop_width)
    images = {part: Image(size, scene.device, signed=True) for part in ("interior", "smooth", "edges")}
    draw = Draw(spp)
    splats = light.forward(scene, plan, number, draw, seed, target, images["interior"])
    if splats is not None:
        launch(add_splats, dim=size, inputs=[splats], outputs=[images["interior"]], device=scene.device)
    if plan.boundary is not None:
        found = by_parts(scene, plan, names, number, spp, mix_seed(seed, STREAM_BOUNDARY))
        for part, launches in found.items():
            if launches:
                drawn = launch_forward(scene, launches, target, size, draw)
                launch(add_image, dim=size, inputs=[drawn], outputs=[images[part]], device=scene.device)
    return images

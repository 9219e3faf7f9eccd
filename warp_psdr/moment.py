"""Second moments of an image's samples, Mitsuba's ``moment`` integrator."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.estimate.arguments import checked_seed, sample_count
from warp_psdr.estimate.calls import ImageCall
from warp_psdr.estimate.draw import Draw
from warp_psdr.estimate.passes import Progress, splats
from warp_psdr.estimate.views import assembled, count_of_views, whole
from warp_psdr.image import Image
from warp_psdr.invalid import warns
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.plan.integrator import integrator_of
from warp_psdr.plan.plan import decide
from warp_psdr.plan.transient import require_steady
from warp_psdr.scene.description import Sensor
from warp_psdr.scene.loaded import check_loaded

if TYPE_CHECKING:
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.scene.scene import Scene


@warns
def render_moment(
    scene: Scene,
    *,
    sensor: Sensor = 0,
    integrator: PathIntegrator | dict | str | None = None,
    spp: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Image, wp.array]:
    """Render an image and the mean of its samples' squares, from which the variance of a sample follows.

    With the image m and the second moment q of N samples a pixel, (q - m^2) / (N - 1) estimates the variance of m.
    Samples are independent: those of one pixel are not stratified, so the image itself is noisier than that of
    ``render``. Each is a pass of its own over the image, which takes longer for small images. Where paths start at the
    lights, what a pass finds in a pixel counts as one sample.

    Args:
        scene: a loaded scene.
        sensor: which camera, by its number or its id; of a ``batch`` all its cameras; several in a list.
        integrator: as for ``render``; default: the one nested in the ``moment`` of the scene's file.
        spp: samples a pixel, N; default: the sensor's sample count.
        seed: equal seeds give equal bits.
        progress: called with the finished fraction.

    Returns:
        The image, W/m^2/sr, and the second moment, its unit squared; both ``wp.array2d`` of vec3, (H, W) of the crop
        window, or (B, H, W) of a list of sensors.

    Raises:
        ValueError: an option is out of range, or the camera's filter lets a sample count for several pixels.
    """
    check_loaded(scene)
    views = scene.description.views(sensor)
    if views.several:
        spp, squares = count_of_views(scene, views, spp), []

        def draw(one: int, told: Progress | None) -> Image:
            found, moment = render_moment(scene, sensor=one, integrator=integrator, spp=spp, seed=seed, progress=told)
            squares.append(moment.numpy())
            return found

        image = assembled(scene, views, draw, progress)
        return image, wp.array(whole(views, squares), dtype=wp.vec3, device=scene.device)
    number = views.sensors[0]
    require_steady(scene, number, "render_moment")
    camera = scene.camera(number)
    if splats(camera):
        raise ValueError(
            "render_moment: samples count for several pixels, and a pixel has no moments of its own; "
            "give the film a 'box' filter"
        )
    spp, seed = sample_count(scene, number, spp), checked_seed(seed)
    plan = decide(scene, integrator=integrator_of(scene, integrator), sensor=number)
    shape = (camera.crop_height, camera.crop_width)
    sums = np.zeros((2, *shape, 3))
    for n in range(spp):
        call = ImageCall(scene, plan, number, mix_seed(seed, n))
        values = call.finish(call.draw(Draw(1))).numpy().astype(np.float64)
        sums += values, values * values
        if progress is not None:
            progress((n + 1) / spp)
    image = Image(shape, scene.device)
    image.assign((sums[0] / spp).astype(np.float32))
    return image, wp.array((sums[1] / spp).astype(np.float32), dtype=wp.vec3, device=scene.device)

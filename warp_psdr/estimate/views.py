"""Several sensors in one call: side by side on the film of a ``batch``, or one after the other in a stack, (B, H, W).

Every sensor is rendered with the call's seed, so that its image and gradient have the bits of a call of its own. The
gradient of a call is the sum over its sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.device import launch
from warp_psdr.estimate.arguments import draw_of, sample_count, samples
from warp_psdr.estimate.passes import Progress, part
from warp_psdr.image import Image
from warp_psdr.kernels.columns import place_columns
from warp_psdr.plan.transient import require_steady, shape_of

if TYPE_CHECKING:
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.scene.description import Views
    from warp_psdr.scene.scene import Scene


def shape_of_views(scene: Scene, views: Views) -> tuple[int, ...]:
    """Return the shape of what several sensors show: (H, W) of a batch, (B, H, W) of a stack.

    Raises:
        ValueError: the films of a stack differ in size, or one has time bins.
    """
    if views.batch is not None:
        return shape_of(scene, views.batch)
    for number in views.sensors:
        require_steady(scene, number, "a list of sensors")
    sizes = [shape_of(scene, number) for number in views.sensors]
    if len(set(sizes)) > 1:
        names = [scene.description.sensors[number].path for number in views.sensors]
        each = ", ".join(f"'{name}' {w} x {h}" for name, (h, w) in zip(names, sizes, strict=True))
        raise ValueError(
            f"sensor: a list takes sensors whose films have one size, got {each} (pixels); render those of each "
            "size in a call of their own"
        )
    return (len(sizes), *sizes[0])


def count_of_views(scene: Scene, views: Views, spp: int | None) -> int | None:
    """Return the samples a pixel of every sensor: those given, else the batch's; None: each sensor's own."""
    if spp is not None:
        return samples("spp", spp)
    return None if views.batch is None else sample_count(scene, views.batch, None)


def require_range(
    scene: Scene, views: Views, integrator: PathIntegrator, spp: int | None, value: tuple[int, int] | None
) -> None:
    """Raise, before the first of several sensors is drawn, unless each has the samples of a range.

    Raises:
        ValueError: as of ``arguments.draw_of``.
    """
    for number in views.sensors:
        draw_of(integrator, sample_count(scene, number, spp), value)


def assembled(
    scene: Scene,
    views: Views,
    draw: Callable[[int, Progress | None], wp.array],
    progress: Progress | None,
    *,
    requires_grad: bool = False,
    signed: bool = False,
) -> Image:
    """Return the images of several sensors as one; ``draw(number, progress)`` returns that of one of them."""
    shape = shape_of_views(scene, views)
    image = Image(shape, scene.device, requires_grad=requires_grad, signed=signed, stack=views.batch is None)
    for number, place, told in each(scene, views, progress):
        drawn = draw(number, told)
        film, first = (image[place], 0) if views.batch is None else (image, place)
        launch(place_columns, dim=drawn.shape, inputs=[drawn, first], outputs=[film], device=scene.device)
    return image


def each(scene: Scene, views: Views, progress: Progress | None) -> Iterator[tuple[int, int, Progress | None]]:
    """Give the number of each sensor, the first column or the layer of its image, and its progress."""
    count = len(views.sensors)
    step = 1 if views.batch is None else scene.camera(views.batch).crop_width // count
    for i, number in enumerate(views.sensors):
        yield number, i * step, part(progress, i / count, 1.0 / count)


def of_one(scene: Scene, views: Views, image: np.ndarray, place: int) -> np.ndarray:
    """Return one sensor's part, (h, w, ...), of what has the shape of the whole."""
    if views.batch is None:
        return image[place]
    return image[:, place : place + scene.camera(views.batch).crop_width // len(views.sensors)]


def whole(views: Views, images: list[np.ndarray]) -> np.ndarray:
    """Return images (h, w, ...) of the sensors as one array of the shape of the whole."""
    return np.stack(images) if views.batch is None else np.concatenate(images, axis=1)

"""Sensors side by side on one film: images of a ``batch`` from those of its sensors, each with the call's seed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import warp as wp

from warp_psdr.device import launch
from warp_psdr.estimate.passes import Progress, part
from warp_psdr.image import Image
from warp_psdr.kernels.columns import place_columns

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


def beside(
    scene: Scene,
    sensor: int,
    draw: Callable[[int, Progress | None], wp.array],
    progress: Progress | None,
    *,
    requires_grad: bool = False,
    signed: bool = False,
) -> Image:
    """Return the image of a batch, (H, W) of vec3; ``draw(number, progress)`` returns that of one of its sensors."""
    camera = scene.camera(sensor)
    image = Image((camera.crop_height, camera.crop_width), scene.device, requires_grad=requires_grad, signed=signed)
    for number, first, _last, told in columns(scene, sensor, progress):
        drawn = draw(number, told)
        launch(place_columns, dim=drawn.shape, inputs=[drawn, first], outputs=[image], device=scene.device)
    return image


def columns(scene: Scene, sensor: int, progress: Progress | None) -> Iterator[tuple[int, int, int, Progress | None]]:
    """Give each sensor of a batch, the first and the last column (exclusive) of its image, and its progress."""
    numbers = scene.description.parts_of(sensor)
    width = scene.camera(sensor).crop_width // len(numbers)
    for i, number in enumerate(numbers):
        yield number, i * width, (i + 1) * width, part(progress, i / len(numbers), 1.0 / len(numbers))

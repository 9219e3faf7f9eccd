"""Films of a range of samples (``psdr.Film``): of all of the crop window, or of rectangles in it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.estimate.arguments import sample_range
from warp_psdr.estimate.calls import ImageCall
from warp_psdr.estimate.draw import Draw
from warp_psdr.estimate.light import traces
from warp_psdr.estimate.passes import Progress, filter_margin, filter_reach, splats
from warp_psdr.film import Film
from warp_psdr.plan.plan import decide
from warp_psdr.plan.transient import require_steady

if TYPE_CHECKING:
    from warp_psdr.kernels.structs import Camera
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.scene.description import Views
    from warp_psdr.scene.scene import Scene

#: (x0, y0, x1, y1): columns x0 ... x1 - 1 and rows y0 ... y1 - 1 of an image.
Rectangle = tuple[int, int, int, int]


def film(
    scene: Scene,
    views: Views,
    integrator: PathIntegrator,
    samples: tuple[int, int],
    pixels: list[Rectangle] | None,
    seed: int,
    progress: Progress | None,
) -> Film:
    """Return the film of some samples before one sensor.

    Args:
        scene: the scene.
        views: what the call's ``sensor`` names.
        integrator: of the call.
        samples: the range (a, b) of their numbers.
        pixels: rectangles in the crop window; None: all of it.
        seed: of the call.
        progress: called with the finished fraction.

    Raises:
        ValueError: no such range or rectangles, several sensors, a transient film, or rectangles before light paths.
    """
    first, stop = sample_range(samples)
    if views.several:
        raise ValueError("samples: a film is that of one sensor; render those of a list or a batch one by one")
    (sensor,) = views.sensors
    require_steady(scene, sensor, "render(samples=...)")
    plan = decide(scene, integrator=integrator, sensor=sensor)
    lights = traces(plan)
    if pixels is not None and lights:
        raise ValueError(
            "pixels: paths start at the lights, and may end in any pixel; leave pixels out and split the samples, or "
            "choose an integrator without light paths (caustics=False)"
        )
    camera = scene.camera(sensor)
    height, width = shape = camera.crop_height, camera.crop_width
    rectangles = [(0, 0, width, height)] if pixels is None else checked_rectangles(pixels, width, height)
    inside = np.zeros(shape, bool)
    for x0, y0, x1, y1 in rectangles:
        inside[y0:y1, x0:x1] = True
    squares = None if splats(camera) or lights else wp.zeros(shape, dtype=wp.vec3d, device=scene.device)
    listed = None if pixels is None else _listed(camera, rectangles, scene.device)
    # All samples are weighed alike: the scale of a sample is that of a call with one a pixel.
    drawn = Draw(1, first, stop)
    parts = ImageCall(scene, plan, sensor, seed).draw(drawn, progress, pixels=listed, squares=squares)
    found = {kind: part.numpy().copy() for kind, part in parts.items()}
    sums = np.where(inside[..., None], found["film"], 0.0) if "film" in found else np.zeros((*shape, 4))
    return Film(
        weights=sums[..., 3].copy(),
        radiance=sums[..., :3].copy(),
        drawn=np.where(inside, drawn.count, 0),
        squares=None if squares is None else squares.numpy().copy(),
        splats=found.get("splats"),
    )


def checked_rectangles(value, width: int, height: int) -> list[Rectangle]:
    """Return rectangles in an image of a width and height.

    Raises:
        ValueError: they are none, or one is not within the image.
    """
    expected = (
        f"expected rectangles [(x0, y0, x1, y1), ...] of the image's pixels with 0 <= x0 < x1 <= {width} and "
        f"0 <= y0 < y1 <= {height}"
    )
    rectangles = list(value) if isinstance(value, (list, tuple, np.ndarray)) else []
    if not rectangles:
        raise ValueError(f"pixels: got {value!r}, {expected}")
    found = []
    for one in rectangles:
        numbers = tuple(one) if isinstance(one, (list, tuple, np.ndarray)) else ()
        whole = all(isinstance(n, (int, np.integer)) and not isinstance(n, bool) for n in numbers)
        if len(numbers) != 4 or not whole:
            raise ValueError(f"pixels: got {one!r}, {expected}")
        x0, y0, x1, y1 = (int(n) for n in numbers)
        if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
            raise ValueError(f"pixels: got {(x0, y0, x1, y1)}, {expected}")
        found.append((x0, y0, x1, y1))
    return found


def _listed(camera: Camera, rectangles: list[Rectangle], device) -> wp.array:
    """Return the numbers of the raster's pixels whose samples count in some rectangles, each once.

    Their order is that of a whole film, so that sums in a pixel are made in the same order.
    """
    margin, reach = (filter_margin(camera), filter_reach(camera)) if splats(camera) else (0, 0)
    raster = (camera.crop_width + 2 * margin, camera.crop_height + 2 * margin)
    counts = np.zeros(raster[::-1], bool)
    for x0, y0, x1, y1 in rectangles:
        rows = slice(max(y0 + margin - reach, 0), y1 + margin + reach)
        counts[rows, max(x0 + margin - reach, 0) : x1 + margin + reach] = True
    order = workers.pixel_order(*raster)
    return wp.array(order[counts.reshape(-1)[order]], dtype=wp.int32, device=device)

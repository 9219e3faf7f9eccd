"""What is estimated, of several sensors in one call: images put together, and gradients added up.

A term of the whole is the term of that name of every sensor, with the same samples a pixel and a stream of its own. The
samples of each are spread evenly over its pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.accuracy import quantity
from warp_psdr.accuracy.quantity import IMAGE, Part, Quantity
from warp_psdr.estimate.arguments import adjoint_array
from warp_psdr.estimate.views import each, of_one, shape_of_views
from warp_psdr.kernels.rng import mix_seed

if TYPE_CHECKING:
    from warp_psdr.options.integrator import Integrator
    from warp_psdr.scene.description import Views
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene


def gradient(scene: Scene, views: Views, params: Parameters, adjoint, *, integrator: Integrator | None) -> Quantity:
    """Return the gradient of ``sum(adjoint * image)``, ``adjoint`` in the shape of the whole, as a quantity.

    Raises:
        ValueError: as of ``quantity.gradient``.
    """
    if not views.several:
        return quantity.gradient(scene, params, adjoint, integrator=integrator, sensor=views.sensors[0])
    array = adjoint_array(adjoint, shape_of_views(scene, views), scene.device).numpy()
    own = {n: of_one(scene, views, array, place) for n, place, _told in each(scene, views, None)}
    return together(views, lambda n: quantity.gradient(scene, params, own[n], integrator=integrator, sensor=n))


def together(views: Views, of_sensor: Callable[[int], Quantity]) -> Quantity:
    """Return what ``of_sensor(number)`` is of all sensors as one quantity."""
    found = tuple(of_sensor(number) for number in views.sensors)
    first = found[0]
    if not views.several:
        return first
    names = list(dict.fromkeys(part.name for what in found for part in what.parts))
    parts = tuple(_part(name, found) for name in names)
    if first.role == "reverse":
        return replace(first, parts=parts, views=views, each=found)
    shape_of_views(first.scene, views)  # stacks only what has one size
    blocks = {IMAGE: slice(0, sum(what.blocks[IMAGE].stop for what in found))}
    ends = np.cumsum([what.raw_size for what in found])

    def finish(raw: np.ndarray) -> np.ndarray:
        own = np.split(raw, ends[:-1])
        return np.concatenate([what.finished(batch) for what, batch in zip(found, own, strict=True)])

    return replace(first, parts=parts, blocks=blocks, finish=finish, raw=int(ends[-1]), views=views, each=found)


def _part(name: str, found: tuple[Quantity, ...]) -> Part:
    """Return a term of all sensors; those that do not have it add nothing."""
    own = [next((part for part in what.parts if part.name == name), None) for what in found]
    join = np.sum if found[0].role == "reverse" else np.concatenate

    def run(spp: int, seed: int) -> np.ndarray:
        batches = [
            np.zeros(what.raw_size) if part is None else part.run(spp, mix_seed(seed, i))
            for i, (what, part) in enumerate(zip(found, own, strict=True))
        ]
        return np.asarray(join(batches, axis=0))

    building = [part.prepare for part in own if part is not None and part.prepare is not None]

    def prepare() -> None:
        for build in building:
            build()

    return Part(name, run, prepare if building else None)

"""The estimated quantity: an image, a derivative image or a gradient, as a sum of terms that run one by one.

A *batch* of a term is one run of it with a number of samples and a seed of its own: an independent, unbiased estimate.
The means of batches of all terms add up to the quantity; so do their variances.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.accuracy.tiles import Tiling, uniform
from warp_psdr.estimate import light
from warp_psdr.estimate.arguments import adjoint_array, flat_tangents, requested
from warp_psdr.estimate.boundary.drivers import launch_backward, launch_forward
from warp_psdr.estimate.boundary.terms import TERMS, BoundaryTerm, Request, launches
from warp_psdr.estimate.draw import Draw
from warp_psdr.estimate.gradient_sums import GradientSums
from warp_psdr.estimate.guiding import store
from warp_psdr.estimate.passes import (
    STREAM_BOUNDARY,
    STREAM_PRIMAL,
    film_of,
    filter_margin,
    interior_backward,
    interior_forward,
    splats,
)
from warp_psdr.estimate.views import whole
from warp_psdr.kernels.medium.coefficients import SCALE, SIGMA_T
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.integrator import Integrator, PathIntegrator
from warp_psdr.options.interior import Replay, Textbook
from warp_psdr.plan.choice import named
from warp_psdr.plan.integrator import integrator_of
from warp_psdr.plan.light import refuse_connected
from warp_psdr.plan.motion import motion
from warp_psdr.plan.plan import Plan, decide
from warp_psdr.plan.transient import require_steady, shape_of
from warp_psdr.scene.layout import MEDIUM
from warp_psdr.topology import contacts

if TYPE_CHECKING:
    from warp_psdr.scene.description import Views
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene

#: Stream of the indirect boundary, beside those of the terms (``estimate/boundary/terms``).
STREAM_INDIRECT = 0x696E6469
#: Stream of derivatives by the density of media, and the uses of their parameters.
STREAM_DENSITY = 0x64656E73
DENSITY = {MEDIUM + SIGMA_T, MEDIUM + SCALE}
#: What asks for a quantity, for errors.
BUDGETS = "psdr.accuracy, as target_error and time_budget,"
#: Name of the components of an image.
IMAGE = "image"


@dataclass(frozen=True)
class Part:
    """A term.

    Attributes:
        name: what it is called.
        run: (samples a pixel, seed) -> one batch, in the layout of ``Quantity.blocks`` or what ``Quantity.finish``
            takes.
        prepare: builds anew what is built once for many batches; None: there is none, or it had been built before.
    """

    name: str
    run: Callable[[int, int], np.ndarray]
    prepare: Callable[[], None] | None = None


@dataclass(frozen=True)
class Quantity:
    """What is estimated.

    Attributes:
        scene: the scene.
        plan: what is compiled and estimated.
        role: "primal", "forward" or "reverse".
        sensor: which camera.
        parts: the terms; the first is the one that runs over pixels.
        blocks: name -> its components in a batch: parameters, or the image.
        adjoint: of reverse mode.
        over_pixels: (samples a pixel, seed, tiling) -> a batch of the first part.
        finish: raw batch, or a mean of raw batches -> components; an image under a filter that reaches beyond its pixel
            is a quotient.
        raw: numbers of a raw batch; None: those of the components.
        views: of several sensors in one call (``accuracy/views.py``); None: one sensor.
        each: what it is of each of them.
    """

    scene: Scene
    plan: Plan
    role: str
    sensor: int
    parts: tuple[Part, ...]
    blocks: dict[str, slice]
    over_pixels: Callable[[int, int, Tiling], np.ndarray]
    adjoint: np.ndarray | None = None
    finish: Callable[[np.ndarray], np.ndarray] | None = None
    raw: int | None = None
    views: Views | None = None
    each: tuple[Quantity, ...] = ()

    @property
    def raw_size(self) -> int:
        """Numbers of a raw batch."""
        return max(block.stop for block in self.blocks.values()) if self.raw is None else self.raw

    def finished(self, raw: np.ndarray) -> np.ndarray:
        """Return the components of a batch."""
        return raw if self.finish is None else self.finish(raw)

    def pixels(self, components: np.ndarray) -> np.ndarray:
        """Return the components of an image as (H, W, 3), or (B, H, W, 3) of a list of sensors."""
        if self.views is not None:
            ends = np.cumsum([q.blocks[IMAGE].stop for q in self.each])
            parts = np.split(components, ends[:-1])
            return whole(self.views, [q.pixels(part) for q, part in zip(self.each, parts, strict=True)])
        camera = self.scene.camera(self.sensor)
        return components.reshape(camera.crop_height, camera.crop_width, 3)

    @property
    def raster(self) -> tuple[int, int, int]:
        """Width and height of what the first part runs over, and its margin around the crop window, in pixels."""
        camera = self.scene.camera(self.sensor)
        margin = filter_margin(camera) if self.role == "primal" and splats(camera) else 0
        return camera.crop_width + 2 * margin, camera.crop_height + 2 * margin, margin

    def tiled(self, tiling: Tiling) -> Quantity:
        """Return the same with the first part's samples spread as a tiling says."""
        first = replace(self.parts[0], run=lambda spp, seed: self.over_pixels(spp, seed, tiling))
        return replace(self, parts=(first, *self.parts[1:]))


def image(scene: Scene, *, integrator: Integrator | None, sensor: int) -> Quantity:
    """Return the image as a quantity."""
    require_steady(scene, sensor, BUDGETS)
    integrator = integrator_of(scene, integrator)
    camera = scene.camera(sensor)
    plan = decide(scene, integrator=integrator, sensor=sensor)
    refuse_connected(plan, BUDGETS)
    shape = (camera.crop_height, camera.crop_width)

    def box_batch(spp: int, seed: int, tiling: Tiling) -> np.ndarray:
        total = np.zeros((*shape, 3))
        for pixels, count, _weight in tiling.launches(spp, seed, scene.device):
            film = film_of(scene, plan, sensor, Draw(count), mix_seed(seed, STREAM_PRIMAL), pixels=pixels)
            total += film.numpy()[..., :3] / count
        return total.reshape(-1)

    def light_batch(spp: int, seed: int) -> np.ndarray:
        film = light.film_of(scene, plan, sensor, Draw(spp), mix_seed(seed, STREAM_PRIMAL))
        found = _flat(film, shape)
        return found if box else np.concatenate([np.zeros(film_size), found])

    def splat_batch(spp: int, seed: int, tiling: Tiling) -> np.ndarray:
        total = np.zeros((*shape, 4))
        for pixels, count, _weight in tiling.launches(spp, seed, scene.device):
            film = film_of(scene, plan, sensor, Draw(count), mix_seed(seed, STREAM_PRIMAL), pixels=pixels)
            # Weighted by area: where tiles differ in their samples, a filter that reaches into both stays itself.
            total += film.numpy() / count
        return np.concatenate([total.reshape(-1), np.zeros(3 * film_size // 4 if light.traces(plan) else 0)])

    def quotient(raw: np.ndarray) -> np.ndarray:
        film, splats_of_light = raw[:film_size].reshape(-1, 4), raw[film_size:]
        seen = (film[:, :3] / np.where(film[:, 3:] > 0.0, film[:, 3:], 1.0)).reshape(-1)
        return seen + splats_of_light if splats_of_light.size else seen

    box, film_size = not splats(scene.camera(sensor)), 4 * shape[0] * shape[1]
    over_pixels = box_batch if box else splat_batch
    found = Quantity(
        scene, plan, "primal", sensor, (), {IMAGE: slice(0, 3 * shape[0] * shape[1])}, over_pixels,
        finish=None if box else quotient,
        raw=None if box else film_size + (3 * film_size // 4 if light.traces(plan) else 0),
    )  # fmt: skip
    return _with(found, IMAGE, _light_parts(plan, light_batch))


def derivative(
    scene: Scene, params: Parameters, tangents: dict, *, integrator: Integrator | None, sensor: int
) -> Quantity:
    """Return the derivative image along tangents as a quantity.

    Raises:
        ValueError: no or wrong tangents, or what the methods do not cover.
    """
    if not tangents:
        raise ValueError("tangents: got none; expected at least one, {'parameter name': direction}")
    require_steady(scene, sensor, BUDGETS)
    integrator = integrator_of(scene, integrator)
    target = flat_tangents(scene, params, tangents)
    plan = decide(scene, integrator=integrator, sensor=sensor, names=list(tangents))
    refuse_connected(plan, BUDGETS)
    if plan.boundary is not None:
        contacts.warn(scene, target.numpy())
    camera = scene.camera(sensor)
    shape = (camera.crop_height, camera.crop_width)

    def light_batch(spp: int, seed: int) -> np.ndarray:
        return _flat(light.light_forward(scene, plan, sensor, Draw(spp), seed, target), shape)

    def over_pixels(own: Plan, spp: int, seed: int, tiling: Tiling) -> np.ndarray:
        out = wp.zeros(shape, dtype=wp.vec3, device=scene.device)
        for pixels, count, weight in tiling.launches(spp, seed, scene.device) if own.seen_wanted is not None else ():
            interior_forward(scene, own, sensor, Draw(count), seed, target, out, pixels=pixels, weight=weight)
        return out.numpy().astype(np.float64).reshape(-1)

    def boundary(request: Callable[[int, int], list], spp: int, seed: int) -> np.ndarray:
        return _flat(launch_forward(scene, request(spp, seed), target, shape), shape)

    blocks = {IMAGE: slice(0, 3 * shape[0] * shape[1])}
    (title, first), *beside = _interior_parts(scene, plan, integrator, sensor, list(tangents))
    found = Quantity(scene, plan, "forward", sensor, (), blocks, partial(over_pixels, first))
    more = _light_parts(plan, light_batch) + _boundary_parts(found, list(tangents), boundary)
    return _with(found, title, _beside(found, over_pixels, beside) + more)


def gradient(scene: Scene, params: Parameters, adjoint, *, integrator: Integrator | None, sensor: int) -> Quantity:
    """Return the gradient of ``sum(adjoint * image)`` with respect to what ``params.requires_grad`` named.

    Raises:
        ValueError: nothing is requested, a wrong adjoint, or what the methods do not cover.
    """
    require_steady(scene, sensor, BUDGETS)
    names = requested(scene, params)
    integrator = integrator_of(scene, integrator)
    plan = decide(scene, params, integrator=integrator, sensor=sensor)
    refuse_connected(plan, BUDGETS)
    array = adjoint_array(adjoint, shape_of(scene, sensor), scene.device)
    records = [scene.parameters[name] for name in names]
    ends = np.cumsum([0, *(p.size for p in records)]).tolist()
    blocks = {name: slice(a, b) for name, a, b in zip(names, ends[:-1], ends[1:], strict=True)}

    def collected(sums: GradientSums) -> np.ndarray:
        flat = sums.result().numpy().astype(np.float64)
        return np.concatenate([flat[p.offset : p.offset + p.size] for p in records])

    def light_batch(spp: int, seed: int) -> np.ndarray:
        sums = GradientSums(scene, names)
        light.light_backward(scene, plan, sensor, Draw(spp), seed, array, sums)
        return collected(sums)

    def over_pixels(own: Plan, spp: int, seed: int, tiling: Tiling) -> np.ndarray:
        sums = GradientSums(scene, names)
        for pixels, count, weight in tiling.launches(spp, seed, scene.device) if own.seen_wanted is not None else ():
            interior_backward(scene, own, sensor, Draw(count), seed, array, sums, pixels=pixels, weight=weight)
        return collected(sums)

    def boundary(request: Callable[[int, int], list], spp: int, seed: int) -> np.ndarray:
        sums = GradientSums(scene, names)
        launch_backward(scene, request(spp, seed), array, sums)
        return collected(sums)

    (title, first), *beside = _interior_parts(scene, plan, integrator, sensor, names)
    found = Quantity(scene, plan, "reverse", sensor, (), blocks, partial(over_pixels, first), adjoint=array.numpy())
    more = _light_parts(plan, light_batch) + _boundary_parts(found, names, boundary)
    return _with(found, title, _beside(found, over_pixels, beside) + more)


def _flat(film: wp.array | None, shape: tuple[int, int]) -> np.ndarray:
    """Return what a pass drew, (H, W) of three, as a batch; None is nothing."""
    return np.zeros(3 * shape[0] * shape[1]) if film is None else film.numpy().astype(np.float64).reshape(-1)


def _interior_parts(
    scene: Scene, plan: Plan, integrator: PathIntegrator, sensor: int, names: list[str]
) -> list[tuple[str, Plan]]:
    """Return the names and plans of the terms over pixels: derivatives by densities of media are one of their own.

    They need paths that collide where nothing is, and vary as nothing else does.
    """
    density = [name for name in names if scene.parameters[name].uses & DENSITY]
    rest = [name for name in names if name not in density]
    if not density:
        return [("interior", plan)]
    if not rest:
        return [("interior density", plan)]
    if not isinstance(named(integrator), Replay | Textbook):
        return [("interior", plan)]
    alone = replace(integrator, boundary=None)
    plans = [decide(scene, integrator=alone, sensor=sensor, names=part) for part in (rest, density)]
    return list(zip(("interior", "interior density"), plans, strict=True))


def _beside(quantity: Quantity, run: Callable[..., np.ndarray], plans: list[tuple[str, Plan]]) -> tuple[Part, ...]:
    """Return further terms over pixels, with samples spread evenly over those that count."""
    even = uniform(quantity)

    def part(title: str, own: Plan) -> Part:
        return Part(title, lambda spp, seed: run(own, spp, mix_seed(seed, STREAM_DENSITY), even))

    return tuple(part(title, own) for title, own in plans)


def _light_parts(plan: Plan, run: Callable[[int, int], np.ndarray]) -> tuple[Part, ...]:
    """Return the term of paths from the lights, if there are any."""
    return (Part("light paths", run),) if light.traces(plan) else ()


def _with(quantity: Quantity, title: str, more: tuple[Part, ...]) -> Quantity:
    """Give a quantity its parts: the one over pixels, with samples spread evenly over those that count, and others."""
    even = uniform(quantity)
    first = Part(title, lambda spp, seed: quantity.over_pixels(spp, seed, even))
    return replace(quantity, parts=(first, *more))


def _boundary_parts(quantity: Quantity, names: list[str], run: Callable[..., np.ndarray]) -> tuple[Part, ...]:
    """Return the terms of the boundary's method, each with a sample count of its own.

    Where paths of two vertices can be told from longer ones, they are a term of their own
    (``kernels/boundary/depth.py``): light that a shadow hides and light that comes by way of other surfaces differ in
    what a sample costs and in how it varies.
    """
    scene, method = quantity.scene, quantity.plan.boundary
    if method is None:
        return ()
    # Without counts of its own the method takes the request's.
    plan = replace(quantity.plan, boundary=method.without_counts())
    moves, guiding = motion(scene, names), getattr(method, "guiding", None)

    def part(term: BoundaryTerm, kind: str) -> Part | None:
        depths = replace(plan, max_depth=2) if kind == "direct" else plan

        def request(spp: int, seed: int) -> Request:
            seed = mix_seed(seed, STREAM_BOUNDARY)
            if kind == "indirect":  # independent of the direct part at equal seeds
                seed = mix_seed(seed, STREAM_INDIRECT)
            return Request(scene, depths, moves, quantity.role, quantity.sensor, spp, seed, kind == "indirect")

        def one(spp: int, seed: int) -> np.ndarray:
            return run(lambda n, s: launches(term, request(n, s)), spp, seed)

        def prepare() -> None:
            assert guiding is not None
            store.forget(request(1, 0), guiding, term.name)
            launches(term, request(1, 0))

        # What was built before is kept, for whoever built it.
        fresh = guiding is not None and term.guided and not store.built(request(1, 0), guiding, term.name)
        if not launches(term, request(1, 0)):
            return None
        return Part(term.title.format(kind), one, prepare if fresh else None)

    found = [part(term, kind) for term in TERMS[type(method)] for kind in _kinds(term, plan.max_depth)]
    return tuple(p for p in found if p is not None)


def _kinds(term: BoundaryTerm, max_depth: int) -> tuple[str, ...]:
    """Return the parts of a term that are told apart."""
    if not term.splits or 0 <= max_depth < 2:
        return ("",)
    return ("direct",) if max_depth == 2 else ("direct", "indirect")

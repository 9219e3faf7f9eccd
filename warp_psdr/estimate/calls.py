"""A call before one sensor, cut in three: what is decided once, the samples that are drawn, and what they add up to.

``psdr.render`` and its like draw all samples. Processes of a pool draw a share of them each (``psdr.distributed``), and
the sums of the shares are those of the call, bit for bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import compiler, workers
from warp_psdr.device import launch
from warp_psdr.estimate import choice, light
from warp_psdr.estimate.arguments import flat
from warp_psdr.estimate.boundary.drivers import launch_backward, launch_forward
from warp_psdr.estimate.boundary.terms import Term, terms
from warp_psdr.estimate.draw import Draw
from warp_psdr.estimate.gradient_sums import GradientSums
from warp_psdr.estimate.guiding import automatic
from warp_psdr.estimate.passes import STREAM_BOUNDARY, STREAM_PRIMAL, Progress, film_of, image_shards, part, timed
from warp_psdr.image import Image
from warp_psdr.kernels.films import add_splats, resolve
from warp_psdr.kernels.reduction import add_image
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.plan.transient import shape_of
from warp_psdr.scene.derived_values import pull_kernels

if TYPE_CHECKING:
    from warp_psdr.plan.plan import Plan
    from warp_psdr.scene.scene import Scene

#: What a share of a call adds to it, by kind: "film", "bins", "splats", "interior", "boundary" or "gradient".
Parts = dict[str, wp.array | np.ndarray]


@dataclass(frozen=True)
class ImageCall:
    """An image.

    Attributes:
        scene: the scene.
        plan: of the image.
        sensor: which camera.
        seed: of the call.
    """

    scene: Scene
    plan: Plan
    sensor: int
    seed: int

    @property
    def shards(self) -> int:
        """Into how many shards the passes are split: there are no more shares that are not empty."""
        return image_shards(self.scene, self.sensor)

    def kernels(self) -> list[wp.Kernel]:
        """Return what the call compiles."""
        return light.image_kernels(self.scene, self.plan, self.sensor)

    def draw(
        self,
        draw: Draw,
        progress: Progress | None = None,
        *,
        pixels: wp.array | None = None,
        squares: wp.array | None = None,
    ) -> dict[str, wp.array]:
        """Return what some samples add up to: "film", or "bins" of a transient film, and "splats" of light paths.

        ``pixels`` and ``squares``: of "film", as of ``passes.film_of``.
        """
        scene, plan, stream = self.scene, self.plan, mix_seed(self.seed, STREAM_PRIMAL)
        found: dict[str, wp.array] = {}
        first, second = (progress, None) if plan.light is None else (part(progress, 0.0, 0.5), part(progress, 0.5, 0.5))
        if plan.times is not None:
            height, width, bins = shape_of(scene, self.sensor)
            film = wp.zeros((height, width * bins), dtype=wp.vec3d, device=scene.device)
            timed(scene, plan, self.sensor, draw, stream, film, first)
            found["bins"] = film
        elif not light.connected(plan):
            found["film"] = film_of(scene, plan, self.sensor, draw, stream, first, pixels, squares)
        splats = light.film_of(scene, plan, self.sensor, draw, stream, second)
        return found if splats is None else found | {"splats": splats}

    def finish(self, parts: dict[str, wp.array], *, requires_grad: bool = False) -> Image:
        """Return the image that all samples add up to."""
        image = Image(shape_of(self.scene, self.sensor), self.scene.device, requires_grad=requires_grad)
        pixels = flat(image)
        for kind, kernel in (("film", resolve), ("bins", add_splats), ("splats", add_splats)):
            if kind in parts:
                launch(kernel, dim=pixels.shape, inputs=[parts[kind]], outputs=[pixels], device=self.scene.device)
        return image


@dataclass(frozen=True)
class DerivativeCall:
    """A gradient, or a derivative image.

    Attributes:
        scene: the scene.
        plan: of the derivative, with its methods chosen.
        names: what is differentiated.
        role: "reverse" or "forward".
        sensor: which camera.
        spp: samples a pixel of the whole call.
        seed: of the call.
        given: the adjoint, (H, W) of vec3, or the flat tangents.
        boundary: the launches of the boundary term.
    """

    scene: Scene
    plan: Plan
    names: list[str]
    role: str
    sensor: int
    spp: int
    seed: int
    given: wp.array
    boundary: list[Term]

    @property
    def shards(self) -> int:
        """Into how many shards the passes are split: there are no more shares that are not empty."""
        return workers.shard_count(self.scene.values.shape[0]) if self.role == "reverse" else workers.SHARDS

    @property
    def shape(self) -> tuple[int, int]:
        """The image's shape as kernels take it."""
        height, width, *bins = shape_of(self.scene, self.sensor)
        return height, width * (bins[0] if bins else 1)

    def draw(self, draw: Draw, progress: Progress | None = None) -> Parts:
        """Return what some samples add up to.

        Of a gradient "gradient" (``GradientSums.total``); of a derivative image "interior", "splats" of light paths and
        "boundary".
        """
        if self.role == "reverse":
            sums = GradientSums(self.scene, self.names, draw.share)
            self.add(draw, sums, progress)
            return {"gradient": sums.total()}
        scene, (first, second) = self.scene, self._shares(draw, progress)
        image = wp.zeros(self.shape, dtype=wp.vec3, device=scene.device)
        splats = light.forward(scene, self.plan, self.sensor, draw, self.seed, self.given, image, first)
        found: Parts = {"interior": image}
        if splats is not None:
            found["splats"] = splats
        if self.boundary:
            found["boundary"] = launch_forward(scene, self.boundary, self.given, self.shape, draw, second)
        return found

    def add(self, draw: Draw, sums: GradientSums, progress: Progress | None = None) -> None:
        """Add what some samples say of the gradient."""
        first, second = self._shares(draw, progress)
        light.backward(self.scene, self.plan, self.sensor, draw, self.seed, self.given, sums, first)
        launch_backward(self.scene, self.boundary, self.given, sums, draw, second)

    def image(self, parts: Parts) -> Image:
        """Return the derivative image that all samples add up to."""
        image = Image(shape_of(self.scene, self.sensor), self.scene.device, signed=True)
        pixels = flat(image)
        for kind, kernel in (("interior", add_image), ("splats", add_splats), ("boundary", add_image)):
            if kind in parts:
                launch(kernel, dim=pixels.shape, inputs=[parts[kind]], outputs=[pixels], device=self.scene.device)
        return image

    def gradient(self, parts: Parts) -> wp.array:
        """Return the flat gradient that all samples add up to, pulled to poses and positions."""
        sums = GradientSums(self.scene, self.names)
        sums.take(np.asarray(parts["gradient"]))
        return sums.result()

    def _shares(self, draw: Draw, progress: Progress | None) -> tuple[Progress | None, Progress | None]:
        """Split a call's progress over the samples of the interior and those of the boundary term."""
        interior = self.shape[0] * self.shape[1] * draw.spp
        share = interior / (interior + sum(term.samples for term in self.boundary))
        return part(progress, 0.0, share), part(progress, share, 1.0 - share)


def derivative(
    scene: Scene,
    plan: Plan,
    names: list[str],
    role: str,
    sensor: int,
    spp: int,
    seed: int,
    given: wp.array,
    *,
    guide: bool,
) -> DerivativeCall:
    """Return the call of a derivative; what was left to the plan is chosen.

    Args:
        scene: the scene.
        plan: of the derivative.
        names: what is differentiated.
        role: "reverse" or "forward".
        sensor: which camera.
        spp: samples a pixel.
        seed: of the call.
        given: the adjoint, (H, W) of vec3, or the flat tangents.
        guide: whether the boundary term may be guided automatically, where it was left to the plan.
    """
    compiler.begin(light.gradient_kernels(plan, role), scene.device)
    plan = choice.choose(scene, plan, names, role, sensor, spp, seed, given)
    if guide and plan.boundary is not None:
        plan = automatic.choose(scene, plan, names, role, sensor, spp, seed, given)
    return prepared(scene, plan, names, role, sensor, spp, seed, given)


def prepared(
    scene: Scene, plan: Plan, names: list[str], role: str, sensor: int, spp: int, seed: int, given: wp.array
) -> DerivativeCall:
    """Return the call of a derivative by a plan that leaves nothing to choose; arguments as of ``derivative``."""
    compiler.begin(light.gradient_kernels(plan, role), scene.device)
    boundary: list[Term] = []
    if plan.boundary is not None:
        boundary = terms(scene, plan, names, role, sensor, spp, mix_seed(seed, STREAM_BOUNDARY))
    if role == "reverse":
        compiler.begin(pull_kernels(scene, names), scene.device)
    return DerivativeCall(scene, plan, names, role, sensor, spp, seed, given, boundary)

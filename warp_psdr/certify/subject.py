"""What a certificate examines: images at values of parameters, and gradients, of a scene or of another renderer."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from warp_psdr.estimate.arguments import adjoint_array
from warp_psdr.invalid import Ledger
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.integrator import PathIntegrator
from warp_psdr.plan.plan import decide
from warp_psdr.render import render, render_backward, render_forward
from warp_psdr.scene.edits import State
from warp_psdr.scene.frames import held_at
from warp_psdr.scene.parameters import Parameters
from warp_psdr.scene.scene import Scene

#: What guiding and the choice of methods keep on a scene, and whether they may.
KEPT = ("_guiding", "_automatic", "_interior", "_guides", "_chooses")
#: Samples of a batch at first, and most samples a pixel of it.
SAMPLES, MOST_SPP = 1 << 13, 1 << 12
#: While twice the samples take less than so many times the time, batches grow; each is timed so often.
CHEAP, TIMINGS = 1.75, 3
#: Batches that a budget has time for at least: images, and gradients of all adjoints.
IMAGES, GRADIENTS = 400, 60


class Subject(Protocol):
    """A renderer with a scene.

    Attributes:
        shape: (H, W) of its images.
        values: name -> values of the parameters that are examined, float64.
    """

    shape: tuple[int, int]
    values: dict[str, np.ndarray]

    def image(self, moved: Mapping[str, np.ndarray], seed: int) -> np.ndarray:
        """Return the image (H, W, 3) at other values of some parameters; equal seeds share random numbers."""

    def gradients(self, adjoints: np.ndarray, seed: int) -> dict[str, np.ndarray]:
        """Return the gradients of sum(adjoint * image) for adjoints (K, H, W, 3): name -> (K, *shape)."""


@dataclass(eq=False)
class SceneSubject:
    """A scene as it is.

    Attributes:
        scene: the scene.
        params: parameters of its own, so that gradients of the user's are left alone.
        integrator: of images and gradients.
        sensor: number of the camera.
        names: what is examined.
        shape: (H, W).
        values: name -> float64.
        spp: samples a pixel of an image, and of a gradient.
        state: of the scene.
    """

    scene: Scene
    params: Parameters
    integrator: PathIntegrator
    sensor: int
    names: tuple[str, ...]
    shape: tuple[int, int]
    values: dict[str, np.ndarray]
    spp: tuple[int, int]
    state: State = field(repr=False)

    @classmethod
    def of(cls, scene: Scene, names: list[str], integrator: PathIntegrator, sensor: int) -> SceneSubject:
        """Return the subject of a scene.

        Raises:
            ValueError: a derivative is refused, or a value is not finite.
        """
        params = Parameters(scene)
        for name in params:
            if not np.isfinite(params[name].numpy()).all():
                raise ValueError(f"certify: {name!r} holds NaN or infinity; write finite values")
        decide(scene, integrator=integrator, sensor=sensor, names=names)
        camera = scene.camera(sensor)
        shape = (camera.crop_height, camera.crop_width)
        spp = min(1 << max(int(np.log2(SAMPLES / (shape[0] * shape[1]))), 0), MOST_SPP)
        values = {name: params[name].numpy().astype(np.float64) for name in names}
        return cls(scene, params, integrator, sensor, tuple(names), shape, values, (spp, spp), scene.state())

    def sized(self, adjoints: np.ndarray, budget: float) -> SceneSubject:
        """Return the same with batches of sizes whose time is not mostly what every call takes; compiles.

        A budget, in seconds, has time for many.
        """
        moved = {self.names[0]: self.values[self.names[0]]}  # the same, but the scene follows all the same
        image = _size(self.spp[0], lambda n: replace(self, spp=(n, n)).image(moved, 0), budget / IMAGES)
        gradient = _size(self.spp[1], lambda n: replace(self, spp=(n, n)).gradients(adjoints, 0), budget / GRADIENTS)
        return replace(self, spp=(image, gradient))

    def by(self, **methods: Any) -> SceneSubject:
        """Return the same by other methods of the integrator.

        Raises:
            ValueError: they do not cover the request.
        """
        integrator = replace(self.integrator, **methods)
        decide(self.scene, integrator=integrator, sensor=self.sensor, names=list(self.names))
        return replace(self, integrator=integrator)

    def image(self, moved: Mapping[str, np.ndarray], seed: int) -> np.ndarray:
        """Return the image at other values of some parameters."""
        with self.moved(moved):
            options: dict[str, Any] = {"integrator": self.integrator, "sensor": self.sensor}
            return render(self.scene, spp=self.spp[0], seed=seed, **options).numpy().astype(np.float64)

    @contextlib.contextmanager
    def moved(self, values: Mapping[str, np.ndarray]) -> Iterator[None]:
        """Let some parameters have other values meanwhile."""
        try:
            for name, value in values.items():
                self.params[name] = value
            self.params.update(*values)
            yield
        finally:
            self.scene.restore(self.state)

    def derivative(self, name: str, tangent: np.ndarray, seed: int) -> np.ndarray:
        """Return the derivative image (H, W, 3) along a direction, of the samples of the first of ``gradients``."""
        tangents = {name: tangent.astype(np.float32)}
        options: dict[str, Any] = {"integrator": self.integrator, "sensor": self.sensor, "spp": self.spp[1]}
        image = render_forward(self.scene, self.params, tangents, seed=mix_seed(seed, 0), **options)
        return image.numpy().astype(np.float64)

    def gradients(self, adjoints: np.ndarray, seed: int) -> dict[str, np.ndarray]:
        """Return the gradients of adjoints."""
        self.params.requires_grad_only(*self.names)
        found: dict[str, list[np.ndarray]] = {name: [] for name in self.names}
        for k, adjoint in enumerate(adjoints):
            self.params.zero_grad()
            render_backward(
                self.scene, self.params, adjoint, integrator=self.integrator, sensor=self.sensor, spp=self.spp[1],
                seed=mix_seed(seed, k),
            )  # fmt: skip
            for name in self.names:
                found[name].append(self.params[name].grad.numpy().astype(np.float64))
        self.params.requires_grad_only()
        return {name: np.stack(rows) for name, rows in found.items()}


def _size(spp: int, run: Callable[[int], object], most: float) -> int:
    """Return samples a pixel from which on twice as many take nearly twice the processor time, or too many seconds."""

    def timed(n: int) -> tuple[float, float]:
        cpu, wall = time.process_time(), time.perf_counter()
        for _ in range(TIMINGS):
            run(n)
        return (time.process_time() - cpu) / TIMINGS, (time.perf_counter() - wall) / TIMINGS

    run(spp)
    now, wall = timed(spp)
    while spp > 1 and wall > most:
        spp //= 2
        now, wall = timed(spp)
    while spp < MOST_SPP and 2.0 * wall <= most:
        more, wall = timed(2 * spp)
        if more > CHEAP * now or wall > most:
            break
        spp, now = 2 * spp, more
    return spp


@contextlib.contextmanager
def untouched(scene: Scene) -> Iterator[Ledger]:
    """Let a scene be moved about, and put everything back: values, bound arrays, structures, choices and counts.

    Methods that are left to the plan are those of a first gradient meanwhile. Yields the counts of dropped samples.
    """
    ledger, counts = Ledger(), scene.invalid
    with held_at(scene, scene.state()):
        kept = {key: scene.__dict__.pop(key) for key in KEPT if key in scene.__dict__}
        scene.__dict__ |= {"_guides": False, "_chooses": False}
        scene.invalid = ledger
        try:
            yield ledger
        finally:
            scene.invalid = counts
            for key in KEPT:
                scene.__dict__.pop(key, None)
            scene.__dict__.update(kept)


def adjoints_of(scene: Scene, sensor: int, adjoint: Any, shape: tuple[int, int]) -> np.ndarray:
    """Return a user's adjoint as (1, H, W, 3) float32.

    Raises:
        ValueError: a wrong shape, or not finite.
    """
    return adjoint_array(adjoint, shape, scene.device).numpy()[None].astype(np.float32)

"""Derivative images with a boundary term, by this renderer and by Mitsuba 3, and how their errors are measured."""

import statistics
import time
from pathlib import Path

import numpy as np
import warp as wp
from common import psdr

from warp_psdr.estimate.boundary import drivers, terms
from warp_psdr.plan.motion import motion

#: Relative error at which times are compared.
AIM = 0.1
#: World units of a small step of an optimisation.
STEP = 1e-3


class Ours:
    """Derivative images of this renderer as the vertices of a mesh move along a direction."""

    def __init__(self, file: Path, resolution: int, vertices: str, direction: tuple, guiding, *, depth: int, all_terms):
        self.scene = psdr.load_file(file, resolution=resolution)
        self._params = psdr.traverse(self.scene)
        self._params.requires_grad(vertices)
        self._guiding, self._depth, self._all_terms = guiding, depth, all_terms
        self._tangent = {vertices: np.broadcast_to(np.float32(direction), self._params[vertices].numpy().shape).copy()}

    def image(self, spp: int, seed: int) -> np.ndarray:
        """Return the derivative image; without ``all_terms`` with one sample of all but the secondary boundary."""
        rest = spp if self._all_terms else 1
        method = psdr.boundary.PathSpace(spp_primary=rest, spp_secondary=spp, guiding=self._guiding)
        integrator = psdr.PathIntegrator(max_depth=self._depth, boundary=method)
        options = {"integrator": integrator, "spp": rest, "seed": seed}
        return psdr.render_forward(self.scene, self._params, self._tangent, **options).numpy()

    def step(self, spp: int, seed: int) -> None:
        """Render the image, and the gradient of its sum, by all terms."""
        method = psdr.boundary.PathSpace(guiding=self._guiding)
        options = {"integrator": psdr.PathIntegrator(max_depth=self._depth, boundary=method), "spp": spp}
        image = psdr.render(self.scene, self._params, seed=seed, **options).numpy()
        psdr.render_backward(self.scene, self._params, np.ones_like(image), seed=seed + 1, **options)

    def forget(self) -> None:
        """Forget the structure."""
        psdr.guiding.reset(self.scene)

    @property
    def memory(self) -> float:
        """Megabytes of the structure."""
        return sum(s.memory for s in psdr.guiding.structures(self.scene)) / 1e6


class Secondary:
    """Derivative images of this renderer by the secondary boundary term alone, as a mesh moves along a direction."""

    def __init__(self, file: Path, resolution: int, vertices: str, direction: tuple, method, depth: int):
        self._scene = psdr.load_file(file, resolution=resolution)
        self._params = psdr.traverse(self._scene)
        self._vertices, self._start = vertices, self._params[vertices].numpy().copy()
        self._direction = np.float32(direction)
        self._integrator = psdr.PathIntegrator(max_depth=depth, boundary=method)
        flat = np.zeros(self._scene.values.shape[0], np.float32)
        p = self._scene.parameters[vertices]
        flat[p.offset : p.offset + p.size] = np.broadcast_to(self._direction, self._start.shape).reshape(-1)
        self._tangent = wp.array(flat, dtype=wp.float32, device=self._scene.device)

    def image(self, spp: int, seed: int) -> np.ndarray:
        """Return the derivative image; its structure, if there is none, is built on the way."""
        scene, names = self._scene, [self._vertices]
        plan = psdr.plan(scene, names=names, integrator=self._integrator)
        camera = scene.camera(0)
        request = terms.Request(scene, plan, motion(scene, names), "forward", 0, spp, seed)
        found = terms.launches(terms.named("secondary"), request)
        image = drivers.launch_forward(scene, found, self._tangent, (camera.crop_height, camera.crop_width))
        return image.numpy().astype(np.float64)

    def gradient(self, spp: int, seed: int) -> np.ndarray:
        """Return the derivative image by all terms."""
        tangents = {self._vertices: np.broadcast_to(self._direction, self._start.shape)}
        options = {"integrator": self._integrator, "spp": spp, "seed": seed}
        return psdr.render_forward(self._scene, self._params, tangents, **options).numpy()

    def move(self, step: int) -> None:
        """Move the mesh by a small step."""
        self._params[self._vertices] = self._start + np.float32(STEP * step) * self._direction
        self._params.update()

    def forget(self) -> None:
        """Forget the structure."""
        psdr.guiding.reset(self._scene)

    @property
    def memory(self) -> float:
        """Megabytes of the structure."""
        return sum(s.memory for s in psdr.guiding.structures(self._scene)) / 1e6


class Theirs:
    """The same of Mitsuba."""

    def __init__(self, mi, dr, file: Path, resolution: int, vertices: str, direction: tuple, options: dict):
        self._mi, self._dr, self._options, self._vertices, self._direction = mi, dr, options, vertices, direction
        self._scene = mi.load_file(str(file), resolution=resolution)
        self._base = mi.Float(mi.traverse(self._scene)[vertices])

    def image(self, spp: int, seed: int) -> np.ndarray:
        """Return the derivative image; an ``spp...`` of the options that is None takes ``spp``."""
        mi, dr = self._mi, self._dr
        integrator = self._integrator(spp)
        params = mi.traverse(self._scene)
        theta = mi.Float(0.0)
        dr.enable_grad(theta)
        moved = dr.unravel(mi.Point3f, self._base) + mi.Vector3f(*self._direction) * theta
        params[self._vertices] = dr.ravel(moved)
        params.update()
        dr.forward(theta, dr.ADFlag.ClearEdges)
        image = integrator.render_forward(self._scene, params=theta, seed=seed, spp=spp)
        dr.eval(image)
        dr.sync_thread()
        return np.array(image)

    def step(self, spp: int, seed: int) -> None:
        """Render the image and the gradient of its sum."""
        mi, dr = self._mi, self._dr
        params = mi.traverse(self._scene)
        vertices = mi.Float(self._base)
        dr.enable_grad(vertices)
        params[self._vertices] = vertices
        params.update()
        image = mi.render(self._scene, params, integrator=self._integrator(spp), spp=spp, seed=seed)
        dr.backward(dr.sum(image, axis=None))
        dr.eval(dr.grad(vertices))
        dr.sync_thread()

    def _integrator(self, spp: int):
        options = {name: spp if value is None else value for name, value in self._options.items()}
        return self._mi.load_dict(options)

    def forget(self) -> None:
        """There is nothing to forget."""

    memory = 0.0


def long_image(renderer, spp: int, images: int = 8) -> np.ndarray:
    """Return the mean of images with seeds that no measurement uses."""
    return np.mean([renderer.image(spp, 10_000 + i) for i in range(images)], axis=0)


def measure(renderer, spp: int, repeat: int, reference: np.ndarray, *, first: bool) -> dict:
    """Return the median time and the relative squared error of images with independent seeds."""
    renderer.image(1, 0)  # compile
    renderer.forget()
    times, errors = [], []
    for seed in range(1, repeat + 2):
        if first:
            renderer.forget()
        start = time.perf_counter()
        image = renderer.image(spp, seed)
        times.append(time.perf_counter() - start)
        errors.append(float(((image - reference) ** 2).mean() / (reference**2).mean()))
    # The first call builds what later ones use.
    seconds, squared = statistics.median(times[1:]), statistics.mean(errors[1:])
    row = {"spp": spp, "seconds": seconds, "relative error": squared**0.5, "error^2 x time": squared * seconds}
    return row | {f"seconds to {AIM}": squared * seconds / AIM**2, "MB": renderer.memory}

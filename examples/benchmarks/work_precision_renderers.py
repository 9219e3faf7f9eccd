"""Images, derivative images and gradients of a case, by this renderer and by Mitsuba 3, with their seconds.

Timed is what an optimisation repeats: one rendering of an unchanged scene, until its values are in memory. Loading,
moving vertices and refitting the structure of the scene are not. A first call, which compiles, is recorded apart.
"""

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import warp as wp
from common import SETTLE, psdr
from work_precision_cases import Case, Method


class Run(NamedTuple):
    """What one run gives."""

    values: np.ndarray
    seconds: float
    cores: float | None = None  # processor time of all threads over wall time


def adjoint_image(pixels: int) -> np.ndarray:
    """Return the smooth weights of reverse mode, (pixels, pixels, 3): every pixel counts, each another amount."""
    y, x = (np.mgrid[0:pixels, 0:pixels] + 0.5) / pixels
    return np.stack([1.0 + 0.5 * np.sin(7.0 * x), 1.0 + 0.5 * np.cos(5.0 * y), 1.0 + 0.5 * x * y], -1).astype(
        np.float32
    )


def _timed(function) -> Run:
    time.sleep(SETTLE)
    start, used = time.perf_counter(), time.process_time()
    values = function()
    seconds, used = time.perf_counter() - start, time.process_time() - used
    return Run(values, seconds, used / seconds)


class Ours:
    """This renderer over one case."""

    def __init__(self, file: Path, pixels: int, case: Case, method: Method):
        self._scene = psdr.load_file(file, resolution=pixels)
        self._params = psdr.traverse(self._scene)
        self._case, self._method = case, method
        self._integrator = psdr.PathIntegrator(max_depth=case.depth, rr_depth=case.rr_depth, **method.options)
        if case.kind != "image":
            self._base = self._params[case.parameter].numpy().copy()
            self._tangent = np.broadcast_to(np.float32(case.direction), self._base.shape).copy()
        if case.kind == "reverse":
            self._params.requires_grad(case.parameter)
            self._adjoint = wp.array(adjoint_image(pixels), dtype=wp.vec3, device="cpu")

    def first(self, spp: int) -> float:
        """Return the seconds of the first call."""
        return self.run(spp, 0).seconds

    def run(self, spp: int, seed: int) -> Run:
        """Render."""
        if self._method.forget:
            self.forget()
        options = {"integrator": self._integrator, "spp": spp, "seed": seed}
        if self._case.kind == "image":
            return _timed(lambda: psdr.render(self._scene, **options).numpy())
        if self._case.kind == "forward":
            tangents = {self._case.parameter: self._tangent}
            return _timed(lambda: psdr.render_forward(self._scene, self._params, tangents, **options).numpy())
        gradient = self._params[self._case.parameter].grad
        gradient.zero_()

        def backward() -> np.ndarray:
            psdr.render_backward(self._scene, self._params, self._adjoint, **options)
            return gradient.numpy().copy()

        return _timed(backward)

    def difference(self, spp: int, seed: int) -> Run:
        """Return the central difference of two images with equal random numbers."""
        images, seconds = [], 0.0
        integrator = psdr.PathIntegrator(max_depth=self._case.depth, rr_depth=self._case.rr_depth)
        for sign in (1.0, -1.0):
            self._move(sign * self._case.step)
            start = time.perf_counter()
            image = psdr.render(self._scene, integrator=integrator, spp=spp, seed=seed)
            images.append(image.numpy().astype(np.float64))
            seconds += time.perf_counter() - start
        self._move(0.0)
        return Run((images[0] - images[1]) / (2.0 * self._case.step), seconds)

    def _move(self, distance: float) -> None:
        self._params[self._case.parameter] = (self._base + distance * self._tangent).astype(np.float32)
        self._params.update()

    def forget(self) -> None:
        """Forget what guiding has learnt."""
        psdr.guiding.reset(self._scene)


class Theirs:
    """Mitsuba over the same case.

    Raises:
        Exception: what Mitsuba raises where it refuses the case, here or when it runs.
    """

    def __init__(self, mi, dr, file: Path, pixels: int, case: Case, method: Method):
        self._mi, self._dr, self._case, self._method = mi, dr, case, method
        self._scene = mi.load_file(str(file), resolution=pixels)
        self._integrators: dict[int, object] = {}
        if case.kind == "image":
            return
        self._params = mi.traverse(self._scene)
        self._name = case.theirs or case.parameter
        value = self._params[self._name]
        self._base = value if case.kind == "reverse" else type(value)(value)
        if case.kind == "reverse":
            self._adjoint = mi.TensorXf(adjoint_image(pixels))
            dr.enable_grad(value)
            self._params.update()

    def _move(self) -> None:
        """Attach the parameter to the direction: a rendering consumes what the last one was given."""
        mi, dr, base, direction = self._mi, self._dr, self._base, self._case.direction
        self._theta = theta = mi.Float(0.0)
        dr.enable_grad(theta)
        if self._name.endswith(".vertex_positions"):
            moved = dr.ravel(dr.unravel(mi.Point3f, base) + mi.Vector3f(*direction) * theta)
        elif self._name.endswith(".to_world"):
            translation = np.asarray(direction, np.float64)[:3, 3]  # of a tangent, (4, 4)
            moved = mi.Transform4f().translate(mi.Vector3f(*translation.tolist()) * theta) @ base
        elif isinstance(direction, tuple):
            moved = base + type(base)(*direction) * theta
        else:
            moved = base + direction * theta
        self._params[self._name] = moved
        self._params.update()
        dr.forward(theta, dr.ADFlag.ClearEdges)
        dr.eval(self._params[self._name])
        dr.sync_thread()

    def first(self, spp: int) -> float:
        """Return the seconds of the first call of a sample count, which is compiled for it."""
        counts = {k: spp if v is None else v for k, v in self._method.options.items()}
        settings = {"max_depth": self._case.depth, "rr_depth": self._case.rr_depth} | counts
        self._integrators[spp] = self._mi.load_dict(settings)
        return self.run(spp, 0).seconds

    def run(self, spp: int, seed: int) -> Run:
        """Render."""
        mi, dr = self._mi, self._dr
        if spp not in self._integrators:
            self.first(spp)
        integrator = self._integrators[spp]
        if self._case.kind == "forward":
            self._move()

        def values():
            if self._case.kind == "image":
                result = mi.render(self._scene, integrator=integrator, spp=spp, seed=seed)
            elif self._case.kind == "forward":
                result = integrator.render_forward(self._scene, params=self._theta, seed=seed, spp=spp)
            else:
                dr.set_grad(self._params[self._name], 0.0)
                integrator.render_backward(self._scene, self._params, self._adjoint, seed=seed, spp=spp)
                result = dr.grad(self._params[self._name])
            dr.eval(result)
            dr.sync_thread()
            return np.array(result)

        return _timed(values)

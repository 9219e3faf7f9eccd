"""Rendered images beside what was seen: residuals, their derivatives by all unknown numbers, and normal equations."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_psdr.observe.observation import Observation
from warp_psdr.observe.photograph import Photograph
from warp_psdr.observe.solution import described
from warp_psdr.observe.unknowns import Entries, Unknowns, pushed
from warp_psdr.plan.transient import shape_of
from warp_psdr.render import render, render_backward, render_forward
from warp_psdr.scene.parameters import traverse

if TYPE_CHECKING:
    from warp_psdr.plan.integrator import Integrator
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene

#: Samples of an image over those of each of its derivatives, of which there are many.
IMAGE_SHARE = 4
#: Most unknown numbers whose derivative images are each rendered, and kept.
MOST = 512
#: Eigenvalue of the normal equations, scaled to a diagonal of ones, below which nothing is told.
SINGULAR = 1.0e-6
#: Standard deviations, and that many, above which an eigenvalue stands out of the noise of its own estimate.
DEVIATIONS = 2.0


@dataclass(frozen=True)
class Side:
    """One of two independent looks at a photograph.

    Attributes:
        image: rendered, (H, W, 3), or (H, W, bins, 3) of a transient film.
        residual: (H, W, C), weighted.
        numbers: (k,) which unknowns move it.
        columns: (k, H, W, C) derivatives of the residual by these; with conjugate gradients by the photograph's own.
        seed: of its random numbers.
        spp: samples a pixel of derivatives.
    """

    image: np.ndarray
    residual: np.ndarray
    numbers: np.ndarray
    columns: np.ndarray
    seed: int
    spp: int


class Problem:
    """Photographs of a scene, and what is unknown.

    Args:
        scene: the scene.
        params: its parameters.
        observations: as of ``solve``.
        unknowns: likewise.
        integrator: likewise.

    Attributes:
        labels: names of all numbers, those of the scene first.
    """

    def __init__(
        self,
        scene: Scene,
        params: Parameters,
        observations: Any,
        unknowns: Sequence[Unknowns] | None,
        integrator: Integrator | None,
    ):
        self.scene, self.params, self._integrator = scene, params, integrator
        self.views = _views(scene, observations)
        given = unknowns if unknowns is not None else [Entries(name) for name in params.requested]
        self.unknowns: list[Unknowns] = list(given)
        self.labels: list[str] = []
        self._sizes = [len(u.values(params)) for u in self.unknowns]
        for u in self.unknowns:
            self.labels += u.labels
        self._firsts: dict[int, int] = {}
        for _sensor, photograph in self.views:
            if id(photograph) not in self._firsts:
                self._firsts[id(photograph)] = len(self.labels)
                more = photograph.labels
                self.labels += [f"{photograph.name} {label}" for label in more] if len(self.views) > 1 else more
        if not self.labels:
            raise ValueError("solve: nothing is unknown; call params.requires_grad(...), or give unknowns=[...]")
        # Gradients of our own: those of the caller's parameters stay as they are.
        self._reversed = traverse(scene)

    @property
    def size(self) -> int:
        """Number of unknown numbers."""
        return len(self.labels)

    def values(self) -> np.ndarray:
        """Return all numbers."""
        parts = [u.values(self.params) for u in self.unknowns]
        return np.concatenate([*parts, *(p.unknown_values for p in self._photographs())])

    def _photographs(self) -> list[Observation]:
        return list({id(photograph): photograph for _sensor, photograph in self.views}.values())

    def look(self) -> None:
        """Ask masks that are functions again."""
        for photograph in self._photographs():
            photograph.look()

    def state(self) -> Any:
        """Return what ``restore`` goes back to."""
        held = [{k: v.copy() for k, v in p.values.items()} for p in self._photographs()]
        return [u.state(self.params) for u in self.unknowns], held

    def restore(self, state: Any) -> None:
        """Go back to a state."""
        for u, held in zip(self.unknowns, state[0], strict=True):
            u.restore(self.params, held)
        for p, values in zip(self._photographs(), state[1], strict=True):
            p.values = {k: v.copy() for k, v in values.items()}
            p.move(np.zeros(p.unknown_values.size))
        self.params.update()

    def move(self, step: np.ndarray) -> None:
        """Add a step to all numbers."""
        first = 0
        for u, size in zip(self.unknowns, self._sizes, strict=True):
            u.move(self.params, step[first : first + size])
            first += size
        for p in self._photographs():
            n = p.unknown_values.size
            p.move(step[first : first + n])
            first += n
        self.params.update()

    def _options(self, spp: int, seed: int) -> dict[str, Any]:
        """Return the options of a call that renders."""
        return {"integrator": self._integrator, "spp": spp, "seed": seed}

    def images(self, seed: int, spp: int) -> list[np.ndarray]:
        """Render all views."""
        options = self._options(IMAGE_SHARE * spp, seed)
        return [render(self.scene, sensor=s, **options).numpy().astype(float) for s, _photograph in self.views]

    def residuals(self, seed: int, spp: int) -> list[np.ndarray]:
        """Return the residuals of all views."""
        return [p.residual(i) for (_s, p), i in zip(self.views, self.images(seed, spp), strict=True)]

    def sides(self, seed: int, spp: int, *, each: bool = True) -> list[Side]:
        """Return residuals and derivatives of all views; by the scene's numbers only if ``each``."""
        tangents = [row for u in self.unknowns for row in u.tangents(self.params)] if each else []
        options = self._options(spp, seed)
        found = []
        for (sensor, photograph), image in zip(self.views, self.images(seed, spp), strict=True):
            numbers, columns = [], []
            for i, row in enumerate(tangents):
                row = self._seen(row, sensor)
                if row:
                    moved = render_forward(self.scene, self.params, row, sensor=sensor, **options).numpy()
                    numbers.append(i)
                    columns.append(photograph.pushed(image, moved).astype(np.float32))
            residual, own = photograph.residual(image), photograph.derivatives(image)
            first = self._firsts[id(photograph)]
            numbers += range(first, first + len(own))
            columns += list(own.astype(np.float32))
            stacked = np.stack(columns) if columns else np.zeros((0, *residual.shape), np.float32)
            found.append(Side(image, residual, np.array(numbers, int), stacked, seed, spp))
        return found

    def groups(self) -> list[slice]:
        """Return the numbers of each kind of unknowns, and of each photograph."""
        sizes = [*self._sizes, *(p.unknown_values.size for p in self._photographs())]
        ends = np.cumsum(sizes)
        return [slice(int(end) - size, int(end)) for end, size in zip(ends, sizes, strict=True) if size]

    def pushed(self, direction: np.ndarray, look: list[Side]) -> list[np.ndarray]:
        """Return J d of a look without ``each``: how residuals of all views change along a direction (n,)."""
        found = []
        total = pushed(self.unknowns, self.params, direction)
        for (sensor, photograph), side in zip(self.views, look, strict=True):
            moved = np.einsum("k,khwc->hwc", direction[side.numbers], side.columns)
            row = self._seen(total, sensor)
            if row:
                options = self._options(side.spp, side.seed)
                image = render_forward(self.scene, self.params, row, sensor=sensor, **options).numpy()
                moved += photograph.pushed(side.image, image)
            found.append(moved)
        return found

    def pulled(self, images: list[np.ndarray], look: list[Side]) -> np.ndarray:
        """Return J^T y of a look without ``each``: (n,), ``images`` y, (H, W, C) for each view."""
        params, found = self._reversed, np.zeros(self.size)
        names = dict.fromkeys(name for u in self.unknowns for name in u.names(self.params))
        params.requires_grad_only(*names)
        params.zero_grad()
        for (sensor, photograph), side, image in zip(self.views, look, images, strict=True):
            if names:
                adjoint = photograph.pulled(side.image, image).astype(np.float32)
                options = self._options(side.spp, side.seed)
                render_backward(self.scene, params, adjoint, sensor=sensor, **options)
            found[side.numbers] += np.einsum("hwc,khwc->k", image, side.columns)
        gradients = {name: params[name].grad.numpy() for name in names}
        first = 0
        for u, size in zip(self.unknowns, self._sizes, strict=True):
            found[first : first + size] += u.pull(self.params, gradients)
            first += size
        return found

    def _seen(self, tangents: Mapping[str, np.ndarray], sensor: int) -> dict[str, np.ndarray]:
        """Return the tangents that are not of another sensor."""
        others = tuple(f"{s.path}." for i, s in enumerate(self.scene.description.sensors) if i != sensor)
        return {name: row for name, row in tangents.items() if not name.startswith(others)}


def _views(scene: Scene, observations: Any) -> list[tuple[int, Observation]]:
    """Return (sensor, observation) of all observations."""
    given = dict(observations) if isinstance(observations, Mapping) else {0: observations}
    found = []
    for sensor, observation in given.items():
        number = scene.description.views(sensor).sensors[0]
        seen = observation if isinstance(observation, Observation) else Photograph(observation, response=None)
        shape = shape_of(scene, number)
        if seen.shape != shape:
            raise ValueError(
                f"{seen.name} has {_size(seen.shape)}, the film of sensor {sensor!r} {_size(shape)}; give the film "
                "that size, or reduce the photograph; a transient film takes a psdr.Observation of its shape"
            )
        found.append((number, seen))
    return found


def _size(shape: tuple[int, ...]) -> str:
    """Return the size of an image in words."""
    bins = f" of {shape[2]} bins" if len(shape) > 2 else ""
    return f"{shape[1]} x {shape[0]} pixels{bins}"


@dataclass(frozen=True)
class Normal:
    """Normal equations of two looks; products are of independent ones, so without bias.

    Attributes:
        h: (n, n) J_1^T W J_2, symmetrised.
        apart: of each photograph: which unknowns move it (k,), and half of the difference of J_1 and J_2 there, times
            the square root of W, (k, pixels, C).
        g_a: (n,) J_2^T W r_1.
        g_b: (n,) J_1^T W r_2.
    """

    h: np.ndarray
    apart: list[tuple[np.ndarray, np.ndarray]]
    g_a: np.ndarray
    g_b: np.ndarray

    @property
    def g(self) -> np.ndarray:
        """Half of the gradient of the sum of squares."""
        return 0.5 * (self.g_a + self.g_b)

    @functools.cached_property
    def _axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return (scale, sizes, axes, told) of H with a diagonal of ones; told: which axes stand out of the noise.

        The noise of a size is that of the sum of products of two looks, whose scatter the pixels' differences tell.
        """
        scale = np.sqrt(np.maximum(np.diag(self.h), 0.0))
        scale = np.where(scale > 0.0, scale, 1.0)
        sizes, axes = np.linalg.eigh(self.h / np.outer(scale, scale))
        variance = np.zeros(len(sizes))
        for numbers, columns in self.apart:
            along = np.tensordot((axes / scale[:, None])[numbers], columns, (0, 0))
            variance += ((2.0 * (along**2).sum(axis=2)) ** 2).sum(axis=1)
        return scale, sizes, axes, sizes > np.maximum(DEVIATIONS * np.sqrt(variance), SINGULAR)

    @property
    def told(self) -> bool:
        """Whether some number changes a picture."""
        return bool(np.any(np.diag(self.h) > 0.0))

    def step(self, damping: float) -> np.ndarray:
        """Return -(H + damping diag H)^-1 g, 0 along what the pictures do not tell."""
        return self._solved(self.g, damping)

    def promised(self, step: np.ndarray) -> float:
        """Return by how much the sum of squares would fall if the residuals were linear."""
        return -2.0 * float(self.g @ step) - float(step @ self.h @ step)

    def within(self, step: np.ndarray, damping: float) -> bool:
        """Return whether a step is no longer than its own error."""
        noise = self._solved(0.5 * (self.g_a - self.g_b), damping)
        scale = np.diag(self.h).clip(min=0.0)
        return float((scale * step**2).sum()) <= 2.0 * float((scale * noise**2).sum())

    def _solved(self, g: np.ndarray, damping: float) -> np.ndarray:
        scale, sizes, axes, told = self._axes
        along = axes.T @ (g / scale)
        return -(axes[:, told] @ (along[told] / (sizes[told] + damping))) / scale

    def inverse(self, labels: list[str]) -> tuple[np.ndarray, list[tuple[str, np.ndarray]]]:
        """Return H^-1 of what the pictures tell, and names and vectors of the directions that they do not."""
        scale, sizes, axes, told = self._axes
        found = (axes[:, told] / sizes[told]) @ axes[:, told].T / np.outer(scale, scale)
        return found, [(described(axes[:, i], labels), axes[:, i]) for i in np.flatnonzero(~told)]


def normal_equations(a: list[Side], b: list[Side], robust: list[np.ndarray], size: int) -> Normal:
    """Return the normal equations of two looks at all photographs."""
    h, g_a, g_b = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    apart = []
    for one, other, w in zip(a, b, robust, strict=True):
        n = one.numbers
        if not len(n):
            continue
        ja, jb = (s.columns.reshape(len(n), -1) for s in (one, other))
        weights = np.broadcast_to(w, one.residual.shape).ravel().astype(np.float32)
        product = (ja * weights) @ jb.T
        apart.append((n, (0.5 * np.sqrt(weights) * (ja - jb)).reshape(len(n), -1, one.residual.shape[2])))
        h[np.ix_(n, n)] += 0.5 * (product + product.T)
        g_a[n] += jb @ (weights * one.residual.ravel())
        g_b[n] += ja @ (weights * other.residual.ravel())
    return Normal(h, apart, g_a, g_b)

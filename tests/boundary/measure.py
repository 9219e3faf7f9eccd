"""Derivative images, all terms together, against central finite differences.

Both are weighted by a finite difference with other random numbers and summed over the image, batch by batch. So the
ratio of the sums is the regression of one image on the other, without the bias of noisy weights.
"""

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import pytest

import warp_psdr as psdr

from .scenes import load

BATCHES = 8
#: Largest error of a slope, as the project promises. Three standard errors of a comparison have to fit into it.
SLOPE_TOLERANCE = 0.02
STANDARD_ERRORS = 3.0
#: What the remainder of the difference, of second order in the step, may leave: steps are a twentieth of a pixel.
REMAINDER = 0.01
#: By how much samples are more where terms of grids, networks and curves take shares of them.
OF_SHARES = 3
SEED, WEIGHT_SEED = 300, 900
#: Modes of a row. Their kernels differ only in where derivatives go, which ``assert_transposes`` compares exactly, so
#: the fast subset runs one.
MODES = ["forward", pytest.param("reverse", marks=pytest.mark.slow)]
#: Float32 sums in another order, relative to the sum of magnitudes.
SUMMATION = 1.0e-4


@dataclass(frozen=True)
class Case:
    """One row.

    Attributes:
        scene: key of ``scenes.SCENES``.
        parameter: name of the parameter, or several that move together.
        tangent: values -> direction, in the shape of the values.
        step: of the difference.
        what: tells rows of one parameter apart.
        depth: most path vertices.
        spp: of a batch of derivatives; differences take ``difference_spp``.
        slow: left out of the fast subset.
        smoke: one of the handful that ``-m smoke`` runs.
        hidden: the camera does not see the lights.
    """

    scene: str
    parameter: str | tuple[str, ...]
    tangent: Callable[[np.ndarray], np.ndarray]
    step: float
    what: str
    depth: int = 2
    spp: int = 256
    difference_spp: int = 1024
    slow: bool = True
    smoke: bool = False
    hidden: bool = False

    def integrator(self, boundary="auto") -> psdr.PathIntegrator:
        return psdr.PathIntegrator(max_depth=self.depth, boundary=boundary, hide_emitters=self.hidden)

    @property
    def names(self) -> tuple[str, ...]:
        return (self.parameter,) if isinstance(self.parameter, str) else self.parameter

    def __str__(self) -> str:
        return f"{self.scene}, {self.what}, depth {self.depth}"


def rows(cases: Iterable[Case]) -> list:
    """Return the cases as parameters of a test, with their marks."""

    def marks(case: Case) -> list:
        return [pytest.mark.slow] * case.slow + [pytest.mark.smoke] * case.smoke

    return [pytest.param(c, id=str(c), marks=marks(c)) for c in cases]


def move(params, values: dict) -> None:
    for name, value in values.items():
        params[name] = value.astype(np.float32)
    params.update()


@functools.cache
def differences(case: Case) -> tuple[dict, np.ndarray, np.ndarray]:
    """Return (tangents, weights, weighted differences of the batches)."""
    scene, params = load(case.scene)
    base = {n: params[n].numpy().astype(np.float64) for n in case.names}
    tangents = {n: np.asarray(case.tangent(v), np.float64) for n, v in base.items()}

    def image(sign: float, seed: int) -> np.ndarray:
        move(params, {n: base[n] + sign * case.step * t for n, t in tangents.items()})
        return (
            psdr.render(scene, integrator=case.integrator(), spp=case.difference_spp, seed=seed)
            .numpy()
            .astype(np.float64)
        )

    def difference(seed: int) -> np.ndarray:
        return (image(1.0, seed) - image(-1.0, seed)) / (2.0 * case.step)

    try:
        weights = np.mean([difference(WEIGHT_SEED + b) for b in range(2)], axis=0)
        sums = np.array([(weights * difference(SEED + b)).sum() for b in range(BATCHES)])
    finally:
        move(params, base)
    scale = np.abs(weights).max()
    assert scale > 0.0, "the parameter has no influence on the image"
    return tangents, weights / scale, sums / scale


def accumulated(scene, tangents: dict, integrator, spp: int, seed: int) -> np.ndarray:
    """Return the derivative image of a scene; tangents: name -> function of the values, as of a ``Case``."""
    params = psdr.traverse(scene)
    given = {name: np.float32(tangent(params[name].numpy().copy())) for name, tangent in tangents.items()}
    return psdr.render_forward(scene, params, given, integrator=integrator, spp=spp, seed=seed).numpy()


def derivatives(case: Case, mode: str, boundary="auto") -> np.ndarray:
    """Return the weighted derivative of every batch."""
    scene, params = load(case.scene)
    tangents, weights, _sums = differences(case)
    shared = any(s.geometry and not s.geometry.is_material for s in scene.description.shapes)
    options = {"integrator": case.integrator(boundary), "spp": case.spp * (OF_SHARES if shared else 1)}
    sums = []
    for batch in range(BATCHES):
        if mode == "forward":
            given = {n: t.astype(np.float32) for n, t in tangents.items()}
            image = psdr.render_forward(scene, params, given, seed=SEED + batch, **options).numpy()
            sums.append(float((weights * image).sum()))
        else:
            params.requires_grad_only(*case.names)
            params.zero_grad()
            psdr.render_backward(scene, params, weights.astype(np.float32), seed=SEED + batch, **options)
            sums.append(sum(float((params[n].grad.numpy().astype(np.float64) * t).sum()) for n, t in tangents.items()))
    return np.array(sums)


def slope(derivative: np.ndarray, difference: np.ndarray) -> tuple[float, float]:
    """Return the slope and its standard error, which for slopes below 1 is the one that it would have at 1."""
    count = len(derivative)
    ratio = derivative.mean() / difference.mean()
    variance = derivative.var(ddof=1) + max(1.0, ratio**2) * difference.var(ddof=1)
    return float(ratio), float(np.sqrt(variance / count) / abs(difference.mean()))


def assert_agrees(derivative: np.ndarray, difference: np.ndarray) -> None:
    """Fail unless the slope is 1 within SLOPE_TOLERANCE and within its own error, and the error is small.

    Raises:
        AssertionError: also for a derivative, or a difference, of zero.
    """
    assert np.isfinite(derivative).all() and np.isfinite(difference).all(), "not finite"
    assert derivative.mean() != 0.0, "a derivative of zero"
    value, error = slope(derivative, difference)
    assert STANDARD_ERRORS * error <= SLOPE_TOLERANCE, f"too noisy to tell: slope {value:.4f} +- {error:.4f}"
    assert abs(value - 1.0) <= SLOPE_TOLERANCE, f"slope {value:.4f} +- {error:.4f}"
    assert abs(value - 1.0) <= STANDARD_ERRORS * error + REMAINDER, f"z-test: slope {value:.4f} +- {error:.4f}"


def assert_needs_boundary(case: Case) -> None:
    """Fail if the interior term alone is about as good: the row could not tell that the boundary term is missing."""
    value, error = slope(derivatives(case, "forward", None), differences(case)[2])
    assert abs(value - 1.0) > 0.05 + 3.0 * error


def assert_transposes(scene, params, names, options: dict) -> None:
    """Fail unless forward and reverse mode, with equal random numbers, are transposes of each other.

    Random tangents and a random adjoint: <J v, w> = <v, J^T w>.

    Args:
        scene: the scene.
        params: its parameters.
        names: what is differentiated.
        options: of ``psdr.render_forward`` and ``psdr.render_backward``.

    Raises:
        AssertionError: also where the derivative is about zero.
    """
    random = np.random.default_rng(1)
    tangents = {n: random.normal(size=params[n].numpy().shape).astype(np.float32) for n in names}
    for t in tangents.values():
        if t.shape == (4, 4):
            t[3] = 0.0
    camera = scene.camera(0)
    adjoint = random.uniform(0.5, 1.5, (camera.crop_height, camera.crop_width, 3)).astype(np.float32)
    image = psdr.render_forward(scene, params, tangents, **options).numpy().astype(np.float64)
    params.requires_grad_only(*names)
    params.zero_grad()
    psdr.render_backward(scene, params, adjoint, **options)
    total = sum(float((params[n].grad.numpy().astype(np.float64) * tangents[n]).sum()) for n in names)
    scale = float((adjoint * np.abs(image)).sum())
    assert scale > 1.0, "hardly a derivative"
    assert abs(total - float((adjoint * image).sum())) <= SUMMATION * scale

"""Derivatives against central finite differences: how they are taken, and when they agree.

A difference renders the primal image twice with the random numbers of the gradient pass (its stream is patched) and
with the light selection of the unmoved scene, which stays a valid estimator. So the noise that both share cancels:
for parameters that no sampling decision depends on a difference equals the derivative up to rounding. That takes a box
filter: under wider ones primal images splat their samples, while gradient passes draw positions from the filter.
"""

import contextlib
import functools
import importlib
from dataclasses import dataclass

import numpy as np

import warp_psdr as psdr
from warp_psdr.estimate.passes import STREAM_INTERIOR
from warp_psdr.scene.lights.selection import Lights

from .scenes import load

#: Independent batches of every comparison.
BATCHES = 8
#: Two-sided quantile of Student's t with BATCHES - 1 degrees of freedom at 1e-3 is 5.4. Seeds are fixed, so a test
#: that passes once passes always; the table holds some 10^2 comparisons.
T_QUANTILE = 5.5
#: Largest error of a slope, as the project promises.
SLOPE_TOLERANCE = 0.02
#: What the remainder of a central difference (see STEP_TOLERANCE) and float32 rounding of two images may leave.
REMAINDER = 3e-3
#: Two steps, h and h / 2, give derivatives this close, so that the remainder at h / 2 is a third of it.
STEP_TOLERANCE = 9e-3
#: Seeds: the weights of the comparison come from random numbers of their own.
SEED, WEIGHT_SEED = 100, 900
#: The weights take this many times the samples of a batch, so that their noise does not hide the derivative.
WEIGHT_SAMPLES = 4
NO_ROULETTE = 1 << 20
#: What recomputes the light selection after an edit.
LIGHT_UPDATES = ("update_areas", "update_environment", "update_selection")


@dataclass(frozen=True)
class Comparison:
    """Weighted sums of a derivative and of a finite difference, one pair a batch, float64 (BATCHES,)."""

    derivative: np.ndarray
    difference: np.ndarray

    @property
    def slope(self) -> float:
        """Regression of derivatives on differences; the weights are independent of both, so noise does not bias it."""
        return float(self.derivative.mean() / self.difference.mean())

    @property
    def error(self) -> float:
        """T_QUANTILE standard errors of the mean difference between the two."""
        return T_QUANTILE * float((self.derivative - self.difference).std(ddof=1)) / np.sqrt(len(self.derivative))


def assert_agrees(c: Comparison) -> None:
    """Fail unless the slope is 1 and the batches agree, and unless the comparison could have told otherwise.

    Raises:
        AssertionError: also for a derivative, or a difference, of zero.
    """
    scale = abs(float(c.difference.mean()))
    assert np.isfinite(c.derivative).all() and np.isfinite(c.difference).all(), "not finite"
    spread = T_QUANTILE * float(c.difference.std(ddof=1)) / np.sqrt(len(c.difference))
    assert scale > spread, f"the finite difference is lost in noise: {scale:g} +- {spread:g}"
    assert c.error <= SLOPE_TOLERANCE * scale, f"too noisy to tell: {c.error / scale:.2%} of the difference"
    assert abs(c.slope - 1.0) <= SLOPE_TOLERANCE, f"slope {c.slope:.4f}"
    gap = abs(float((c.derivative - c.difference).mean()))
    assert gap <= c.error + REMAINDER * scale, f"z-test: off by {gap / scale:.3%} at a noise of {c.error / scale:.3%}"


def assert_steps_agree(fine: np.ndarray, coarse: np.ndarray) -> None:
    """Fail if differences with step h / 2 and h, one a batch, disagree by more than their noise and STEP_TOLERANCE."""
    scale = abs(float(fine.mean()))
    noise = T_QUANTILE * float((coarse - fine).std(ddof=1)) / np.sqrt(len(fine))
    gap = abs(float((coarse - fine).mean()))
    assert gap <= noise + STEP_TOLERANCE * scale, f"the difference depends on its step: by {gap / scale:.2%}"


@contextlib.contextmanager
def shared_random_numbers():
    """Let primal images use the random numbers of gradient passes, and edits keep the light selection."""
    calls = importlib.import_module("warp_psdr.estimate.calls")
    stream, updates = calls.STREAM_PRIMAL, {n: getattr(Lights, n) for n in LIGHT_UPDATES}
    calls.STREAM_PRIMAL = STREAM_INTERIOR
    for name in updates:
        setattr(Lights, name, lambda self, *args: None)
    try:
        yield
    finally:
        calls.STREAM_PRIMAL = stream
        for name, function in updates.items():
            setattr(Lights, name, function)


def integrator(depth: int, block: int = 8, **options) -> psdr.PathIntegrator:
    """Return the interior term's integrator without roulette, whose decisions would depend on the parameters."""
    options = {"rr_depth": NO_ROULETTE, "boundary": None, **options}
    return psdr.PathIntegrator(max_depth=depth, interior=interior(block), **options)


def interior(block: int) -> psdr.interior.Method:
    """Return record and sweep in blocks of K vertices; 0: textbook replay, which keeps none."""
    return psdr.interior.Replay(block=block) if block else psdr.interior.Textbook()


def image_at(scene, params, name, values, depth, spp, seed):
    """Return the image, float64, with other values of one parameter, and put the values back."""
    before = params[name].numpy().copy()
    follow = [n for n in (name.removesuffix("vertex_positions") + "vertex_normals",) if n != name and n in params]
    normals = {n: params[n].numpy().copy() for n in follow if name.endswith("vertex_positions")}
    try:
        params[name].assign(values.astype(np.float32))  # in place: a step may leave the parameter's range
        params.update(name)
        return psdr.render(scene, integrator=integrator(depth), spp=spp, seed=seed).numpy().astype(np.float64)
    finally:
        params[name] = before
        params.update()
        for n, v in normals.items():
            params[n].assign(v)


def difference(scene, params, name, tangent, step, depth, spp, seed):
    """Return the central difference of the image along a tangent, (H, W, 3) float64."""
    base = params[name].numpy().astype(np.float64)
    high, low = (
        image_at(scene, params, name, (base + s * step * tangent).astype(np.float32), depth, spp, seed) for s in (1, -1)
    )
    return (high - low) / (2.0 * step)


@functools.cache
def differences(case):
    """Return (tangent, weights, differences of the batches) of a case, after a study of its step."""
    scene, params = load(case.scene)
    tangent = case.tangent(params[case.parameter].numpy())
    half = 0.5 * case.step
    with shared_random_numbers():

        def at(step, seed, spp):
            return difference(scene, params, case.parameter, tangent, step, case.depth, spp, seed)

        weights = at(case.step, WEIGHT_SEED, WEIGHT_SAMPLES * case.spp)
        assert np.abs(weights).max() > 0.0, "the parameter has no influence on the image"
        weights /= np.abs(weights).max()
        fine, coarse = (
            np.array([(weights * at(h, SEED + b, case.spp)).sum() for b in range(BATCHES)]) for h in (half, case.step)
        )
    assert_steps_agree(fine, coarse)
    return tangent, weights.astype(np.float32), fine


def derivative(case, mode: str, block: int, names, tangent, weights) -> np.ndarray:
    """Return the weighted derivative of each batch, in forward or in reverse mode."""
    scene, params = load(case.scene)
    options = {"integrator": integrator(case.depth, block), "spp": case.spp}
    sums = []
    for batch in range(BATCHES):
        if mode == "forward":
            tangents = dict.fromkeys(names, 0.0) | {case.parameter: tangent}
            image = psdr.render_forward(scene, params, tangents, seed=SEED + batch, **options).numpy()
            sums.append(float((weights.astype(np.float64) * image).sum()))
        else:
            params.requires_grad_only(*names)
            params.zero_grad()
            psdr.render_backward(scene, params, weights, seed=SEED + batch, **options)
            sums.append(float((params[case.parameter].grad.numpy().astype(np.float64) * tangent).sum()))
    return np.array(sums)


def compare(case, mode: str, block: int, names) -> Comparison:
    """Return the sums of a case under a method."""
    tangent, weights, expected = differences(case)
    return Comparison(derivative(case, mode, block, names, tangent, weights), expected)


def is_geometric(name: str) -> bool:
    """Whether a parameter moves path vertices."""
    moving = ("vertex_positions", "vertex_normals", "vertex_texcoords", "to_world", "x_fov", ".eta")
    return name.endswith(moving) and not name.startswith(("env", "sun", "spot", "point"))

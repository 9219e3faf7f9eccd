"""Levenberg-Marquardt on rendered images: least squares without learning rates.

Every step looks twice, with independent random numbers, at images I and their derivatives J. Products of the two looks
have no bias: H = J_1^T W J_2, g = J_1^T W r_2, symmetrised. Their difference tells how noisy the step is. W are Huber's
weights. A step is taken if it lessens r_1^T W r_2, both sides of it seen with the same random numbers.

Up to 512 numbers have a derivative image each; more than that are solved by conjugate gradients (``krylov.py``).

Derivation: ``docs/theory/photographs.md``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from warp_psdr.observe import errors
from warp_psdr.observe.krylov import Products
from warp_psdr.observe.problem import MOST as MOST_DENSE
from warp_psdr.observe.problem import Normal, Problem, Side, normal_equations
from warp_psdr.observe.solution import TAKEN, Solution, Step

if TYPE_CHECKING:
    from warp_psdr.observe.unknowns import Unknowns
    from warp_psdr.plan.integrator import Integrator
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene

__all__ = ["solve"]

Method = Literal["auto", "dense", "conjugate_gradients"]

#: Damping: at first, over the diagonal of H; its change after a bad and after a good step; its bounds.
START, UP, DOWN, LEAST, MOST = 1.0e-3, 8.0, 0.2, 1.0e-7, 1.0e6
#: Gain ratio above which damping falls.
GOOD = 0.5
#: Median of the absolute values of a normal distribution of standard deviation one, inverse.
NORMAL_MEDIAN = 1.4826
#: Least scale of Huber's weights over the residuals' root mean square, until they settle once: far off, most residuals
#: are small, and the large ones lead the way.
OF_RMS = 0.5
#: Sampling variance of a number, over that of what the photographs have and the scene lacks, that is small enough.
ENOUGH = 0.25
#: Relative change of the loss below which it counts as settled, if damping is low; far off, and at the end.
FAR_SETTLED, SETTLED = 1.0e-2, 1.0e-3
#: By how much samples are fewer far off, where steps are longer than their errors; many pixels tell few numbers.
COARSER = 4
#: By how much samples grow where noise decides the step, and at most in all.
FINER, FINEST = 2, 8


def solve(
    scene: Scene,
    params: Parameters,
    observations: Any,
    *,
    unknowns: Sequence[Unknowns] | None = None,
    integrator: Integrator | None = None,
    spp: int = 16,
    steps: int = 20,
    huber: float | None = 1.5,
    seed: int = 0,
    method: Method = "auto",
    progress: Callable[[Step], None] | None = None,
) -> Solution:
    """Find values of parameters with which the scene looks as photographs do, and their error bars.

    It needs a start from which the pictures overlap, and no learning rate. Beyond 512 unknown numbers (texels,
    vertices) there are no error bars.

    Args:
        scene: a loaded scene, which holds the start; at the end it holds the values found.
        params: its parameters.
        observations: a ``psdr.Photograph``, any ``psdr.Observation``, or a linear image (H, W, 3), of sensor 0; or
            sensor -> such, for several.
        unknowns: ``psdr.unknowns.Rigid``, ``Function``, ``Taped`` or ``Entries``. Default: all entries of what
            ``params.requires_grad`` named.
        integrator: as of ``render``.
        spp: samples a pixel of derivative images and of reverse passes, and a quarter of an image's. Grows up to
            eightfold where noise decides.
        steps: most steps.
        huber: residuals larger than so many standard deviations (robust estimate) count linearly; None: none do.
        seed: equal seeds give equal results.
        method: "dense": two derivative images per unknown and step, up to 512 unknowns; "conjugate_gradients": up to 24
            products with the normal equations a step, each two derivative images and two reverse passes, no error
            bars; "auto": by the number of unknowns.
        progress: called after each step, for example ``print``.

    Returns:
        Values, standard deviations, covariance, its directions, and how the steps went.

    Raises:
        ValueError: nothing is unknown; more than 512 numbers with "dense"; an observation has another size; no unknown
            changes any picture.

    Warns:
        RuntimeWarning: the pictures do not tell some combination of the unknowns, which is named; the steps ran out;
            the residual says that the scene does not look like the photographs.
    """
    problem = Problem(scene, params, observations, unknowns, integrator)
    dense = _dense(method, problem)
    damping, finer, far, taken = START, 1, huber is not None, []
    reason = f"{steps} steps were not enough"
    fresh = _Seeds(seed)
    for number in range(steps):
        samples = max(spp // COARSER, 1) if far and dense else spp * finer
        a, b, robust = _looks(problem, fresh, samples, huber, far, each=dense)
        equations = (
            normal_equations(a, b, robust, problem.size) if dense else Products(problem, a, b, robust, seed + number)
        )
        if not equations.told:
            raise ValueError("solve: no unknown changes any picture; is what they move seen by the sensors?")
        before = _loss([side.residual for side in a], [side.residual for side in b], robust)
        state = problem.state()
        while True:
            step = equations.step(damping)
            promised, below = equations.promised(step), equations.within(step, damping)
            loss = _loss_after(problem, step, a, b, robust, samples)
            gain = (before - loss) / promised if promised > 0.0 else -1.0
            if gain >= TAKEN:
                break
            problem.restore(state)
            damping *= UP
            if damping > MOST or below:
                break
        taken.append(Step(number, samples, before, loss, gain, damping, problem.values()))
        if progress is not None:
            progress(taken[-1])
        stuck = gain < TAKEN
        if gain >= GOOD:
            damping = max(DOWN * damping, LEAST)
        settled = before - loss < (FAR_SETTLED if far else SETTLED) * before and damping <= START
        if below or stuck or settled:
            if far:
                far = False
                continue
            if finer >= FINEST or (
                isinstance(equations, Normal) and errors.estimated(problem, equations, a, b, robust).noisiest <= ENOUGH
            ):
                reason = "no step lessens the residual" if stuck and not below else "the step is below its own error"
                reason = reason if below or stuck else "the residual is settled"
                break
            finer *= FINER
            damping = min(damping, START)
    a, b, robust = _looks(problem, fresh, spp * finer, huber, each=dense)
    return errors.solution(problem, a, b, robust, taken, reason, bars=dense)


def _dense(method: Method, problem: Problem) -> bool:
    """Return whether every number has derivative images."""
    if method not in get_args(Method):
        raise ValueError(f"solve: method {method!r}; expected one of {', '.join(map(repr, get_args(Method)))}")
    if method == "dense" and problem.size > MOST_DENSE:
        raise ValueError(
            f"solve: {problem.size} unknown numbers, and the method 'dense' takes up to {MOST_DENSE}: each costs two "
            "derivative images; 'conjugate_gradients' takes them"
        )
    return method == "dense" or (method == "auto" and problem.size <= MOST_DENSE)


class _Seeds:
    """Random numbers that no step shares with another."""

    def __init__(self, seed: int):
        self._next = 2 * seed * (1 << 16)

    def pair(self) -> tuple[int, int]:
        """Return two seeds."""
        self._next += 2
        return self._next, self._next + 1


def _looks(
    problem: Problem, fresh: _Seeds, spp: int, huber: float | None, far: bool = False, *, each: bool
) -> tuple[list[Side], list[Side], list[np.ndarray]]:
    """Return two independent looks, and Huber's weights of all residuals, (H, W, 1) each."""
    problem.look()
    a, b = (problem.sides(s, spp, each=each) for s in fresh.pair())
    robust = []
    for (_sensor, photograph), one, other in zip(problem.views, a, b, strict=True):
        mean = 0.5 * (one.residual + other.residual)
        size = np.abs(mean).max(axis=2, keepdims=True)
        counts = photograph.weights.max(axis=2, keepdims=True) > 0.0
        scale = NORMAL_MEDIAN * float(np.median(size[counts]))
        if far:
            scale = max(scale, OF_RMS * float(np.sqrt((size[counts] ** 2).mean())))
        weight = np.ones_like(size)
        if huber is not None and scale > 0.0:
            weight = np.minimum(1.0, huber * scale / np.maximum(size, 1e-30))
        robust.append(np.where(counts, weight, 0.0))
    return a, b, robust


def _loss_after(
    problem: Problem, step: np.ndarray, a: list[Side], b: list[Side], robust: list[np.ndarray], spp: int
) -> float:
    """Take a step and return the loss there, seen with the random numbers of two looks.

    It is infinite where the step leaves what parameters may be: a lens that folds, for example. The scene rendered
    where the step began, so that a shorter step is the cure.
    """
    try:
        problem.move(step)
        first, second = (problem.residuals(look[0].seed, spp) for look in (a, b))
    except ValueError:
        return math.inf
    return _loss(first, second, robust)


def _loss(first: list[np.ndarray], second: list[np.ndarray], robust: list[np.ndarray]) -> float:
    """Return r_1^T W r_2."""
    return sum(float((w * x * y).sum()) for w, x, y in zip(robust, first, second, strict=True))

"""The bias of a method: what it leaves out by design, in words, and measured where another method includes it.

Textbook replay and a gradient without its boundary term have an unbiased *twin*: the same request with ``Replay()`` and
with the boundary term. The bias b is the mean of the difference D of both,

    D = interior term of the twin - interior term (textbook replay only) + the twin's boundary terms (if left out).

The two interior terms use equal random numbers, which cancels most noise. As for the gradient g, |b|^2 is the squared
mean of batches of D less the variance of that mean (``statistics.py``). It is reported relative to |g|^2, as all errors
of the report are; with several parameters, it is the mean of these ratios. More samples reduce the relative error to
the square root of that number and no further.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from warp_psdr.accuracy.quantity import Quantity
from warp_psdr.accuracy.statistics import Moments, jackknife, moments
from warp_psdr.estimate.passes import splats
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.integrator import PathIntegrator
from warp_psdr.options.interior import Replay
from warp_psdr.plan.plan import Plan

#: Batches: the least, the most, and the share of the pilot's time after which there are no more.
LEAST_BATCHES, MOST_BATCHES, SHARE = 8, 64, 0.5


def named(what: Quantity) -> tuple[str, ...]:
    """Say what the methods leave out by design."""
    scene, plan = what.scene, what.plan
    found = []
    if what.role == "primal":
        if splats(scene.camera(what.sensor)):
            found.append("the filtered image is a quotient of two sums: of the order of 1 / all samples of a pixel")
        return tuple(found)
    if plan.interior is not None and plan.kept is not None and plan.kept.bias:
        found.append(f"{plan.interior.label}: {plan.kept.bias}")
    if _without_boundary(plan):
        found.append("boundary=None: all of the boundary term is left out, although " + "; ".join(plan.discontinuities))
    if plan.wanted is not None and plan.wanted.geometry and scene.contact_ratio > 0.0:
        found.append(
            f"where shapes touch: of the order of {scene.contact_ratio:.2g}, squared, in the light between them, and "
            "of its first power in what was scattered close by before or near gaps "
            "(kernels/interior/factors/contact.py)"
        )
    return tuple(found)


def _biased(plan: Plan) -> bool:
    return plan.kept is not None and bool(plan.kept.bias)


def _without_boundary(plan: Plan) -> bool:
    return plan.boundary is None and bool(plan.discontinuities)


def unbiased(integrator: PathIntegrator, what: Quantity) -> PathIntegrator | None:
    """Return the twin's integrator; None: the method needs none."""
    changes: dict = {}
    if _biased(what.plan):
        changes["interior"] = Replay()
    if _without_boundary(what.plan):
        changes["boundary"] = "auto"
    return replace(integrator, **changes) if changes and what.role != "primal" else None


def measured(
    what: Quantity, twin: Quantity, found: Moments, spp: int, seed: int, seconds: float, now: Callable[[], float]
) -> tuple[float, float]:
    """Return the squared relative bias, which may come out negative where there is none, and its standard error.

    Args:
        what: what is biased.
        twin: the same by an unbiased method.
        found: of the pilot's batches.
        spp: samples a pixel of a batch.
        seed: of the batches.
        seconds: of the pilot.
        now: its clock.
    """
    blocks = list(what.blocks.values())
    boundary = twin.parts[1:] if _without_boundary(what.plan) else ()
    batches: list[np.ndarray] = []
    for part in (twin.parts[0], *boundary):
        part.run(1, seed)  # compiles
    start = now()
    while len(batches) < LEAST_BATCHES or (len(batches) < MOST_BATCHES and now() - start < SHARE * seconds):
        at = mix_seed(seed, len(batches))
        difference = np.zeros(max(block.stop for block in blocks))
        if _biased(what.plan):
            difference += twin.parts[0].run(spp, at) - what.parts[0].run(spp, at)
        batches.append(sum((part.run(spp, at) for part in boundary), difference))
    of_bias = moments([batches], blocks)

    def relative(norm2: np.ndarray) -> np.ndarray:
        return (norm2[..., found.seen] / found.norm2[found.seen]).mean(axis=-1)

    # The gradient's own norm is uncertain too, of each parameter by itself.
    ratios = of_bias.norm2[found.seen] / found.norm2[found.seen]
    of_norm = ratios * found.norm2_error[found.seen] / found.norm2[found.seen] / len(ratios)
    error = np.hypot(jackknife(relative(of_bias.norm2_without)), np.linalg.norm(of_norm))
    return float(relative(of_bias.norm2)), float(error)

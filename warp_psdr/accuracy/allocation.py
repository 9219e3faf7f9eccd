"""The split of a budget over terms.

A batch of term k costs C_k seconds and has the relative variance U_k. n_k batches of each term have the squared error
sum_k U_k / n_k and take sum_k n_k C_k seconds. At a given time the error is least for n_k ~ sqrt(U_k / C_k) (Lagrange),
and then error^2 * time = (sum_k sqrt(U_k C_k))^2. Every term gets at least one batch for each of the two halves of a
run (``budget.py``); if this binds, the others share the rest. A term that the pilot's batches have hardly met is not
known to be small, so each term also gets at least ``FLOOR`` of the best split's time. K terms lose at most the share K
* FLOOR of the time by it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Least batches of a term: one for each half of a run to an error, and one of a run for a time.
LEAST, LEAST_IN_TIME = 2.0, 1.0
#: Least time of a term, as a share of that of the best split: a hundredth costs little, and bounds what is lost where
#: rare samples of a term carry its variance and the pilot has met none.
FLOOR = 0.01


@dataclass(frozen=True)
class Allocation:
    """A split.

    Attributes:
        batches: term -> number of batches.
        spp: term -> samples a pixel in all.
        seconds: what it takes.
        error: the relative error that it reaches.
    """

    batches: dict[str, int]
    spp: dict[str, int]
    seconds: float
    error: float


def efficiency(cost: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return error^2 * time of the best split, for costs and relative variances (..., terms)."""
    return np.sqrt(cost * variance).sum(axis=-1) ** 2


def ideal(cost: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return (terms,): the best numbers of batches up to a factor, none of them below its floor."""
    best = np.sqrt(variance / cost)
    return np.maximum(best, FLOOR * float(best @ cost) / cost)


def batches_for_time(cost: np.ndarray, variance: np.ndarray, seconds: float, least: float = LEAST) -> np.ndarray:
    """Return the best (terms,) numbers of batches, not rounded, for a time; ``least`` each where it is too short."""

    def scale(free: np.ndarray, numbers: np.ndarray) -> float:
        return (seconds - least * cost[~free].sum()) / float(numbers[free] @ cost[free])

    return _split(cost, variance, scale, least)


def batches_for_error(cost: np.ndarray, variance: np.ndarray, error: float, least: float = LEAST) -> np.ndarray:
    """Return the cheapest (terms,) numbers of batches, not rounded, for a relative error."""

    def scale(free: np.ndarray, numbers: np.ndarray) -> float:
        rest = error**2 - variance[~free].sum() / least
        return float((variance[free] / numbers[free]).sum()) / rest if rest > 0.0 else np.inf

    return _split(cost, variance, scale, least)


def _split(cost: np.ndarray, variance: np.ndarray, scale, least: float) -> np.ndarray:
    """Scale the free terms' numbers; terms that would fall below ``least`` are fixed there, and the scale found again.

    ``scale``: (which are free, their numbers up to a factor) -> the factor.
    """
    numbers = ideal(cost, variance)
    free = numbers > 0.0
    while True:
        batches = np.full(len(cost), least)
        if not free.any():
            return batches
        batches[free] = scale(free, numbers) * numbers[free]
        short = free & (batches < least)
        if not short.any():
            return batches
        free &= ~short

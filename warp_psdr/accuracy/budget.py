"""Budgets: spend samples until a relative error is reached, or for a time, without bias.

A pilot (``pilot.py``) fixes the batches and is thrown away. For a target error, two halves of the run decide each
other's number of batches. For a time, rounds of equal batches run until it is over. Neither rule prefers an outcome.

Derivation: ``docs/theory/accuracy.md#budgets-without-bias``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_psdr.accuracy import pilot
from warp_psdr.accuracy.allocation import LEAST_IN_TIME, batches_for_error, batches_for_time
from warp_psdr.accuracy.quantity import Quantity
from warp_psdr.accuracy.report import Report, positive
from warp_psdr.accuracy.statistics import Running, squared
from warp_psdr.accuracy.tiles import spread, tile_count
from warp_psdr.estimate.arguments import checked_seed
from warp_psdr.kernels.rng import mix_seed

#: Seed stream of what is spent, and those of its halves.
STREAM_BUDGET, STREAM_A, STREAM_B = 0x73706E64, 0, 1
#: Share of the predicted batches that tell how many are run, and how many times as many as have told can be: the pilot
#: is off by more than 30 % in few cases, and what is run beyond what was needed is wasted.
FIRST_LOOK, NEXT_LOOK = 0.7, 2.0
#: Steps in which the number that reaches the error is searched: fine beside one batch.
STEP = 1.01
#: Least kurtosis less one: nothing is known as exactly as a pilot of many components may say; and the largest r^2: the
#: expansion says nothing of larger ones.
LEAST_EXCESS, MOST_UNCERTAIN = 0.02, 0.25
#: Most rounds of a time budget, and the share of the efficiency that rounding to them may cost.
MOST_ROUNDS, ROUNDING = 16, 0.03
#: Rounds count that end within so many times the budget; they are planned to, where samples were rounded.
SLACK, FULL = 1.1, 1.02
#: Seconds of the pilot of a time budget, at least; and how many times its share it may take where it is uncertain.
LEAST_PILOT, PATIENCE = 0.1, 1.25
#: Seconds of the pilot of a target error, whose time is not known before; more where it is uncertain (``pilot.SHARE``).
ERROR_PILOT = 2.0
#: How uncertain the exponent is of sizes other than those that told it, beside its own error: stratification sets in.
DRIFT = 0.2
#: What is spent, seconds, where the pilot took all of a time budget.
LEAST_SECONDS = 1e-3


@dataclass(frozen=True)
class Budget:
    """A budget.

    Attributes:
        error: relative error to be reached; None: there is a time instead.
        seconds: to be spent; None: there is an error instead.
        report: of a pilot; None: one is run.
    """

    error: float | None
    seconds: float | None
    report: Report | None


@dataclass(frozen=True)
class Reached:
    """What a budget bought.

    Attributes:
        error: estimated relative error (of the gradient: root mean square over the parameters), about what the method
            converges to: the bias of a method that has one is not in it.
        seconds: spent, without the pilot and without compiling.
        pilot_seconds: of the pilot; 0 where a report was given.
        spp: term -> samples a pixel.
        batches: term -> batches.
        report: what the pilot found; pass it to the next call at a similar scene, which then needs none.
    """

    error: float
    seconds: float
    pilot_seconds: float
    spp: dict[str, int]
    batches: dict[str, int]
    report: Report


def check(spp: Any, target_error: Any, time_budget: Any, report: Any) -> bool:
    """Whether a budget is given.

    Raises:
        ValueError: arguments that exclude each other, or are none.
    """
    if target_error is None and time_budget is None:
        if report is not None:
            raise ValueError("report: needed with target_error or time_budget only; give one of these or leave it out")
        return False
    if target_error is not None and time_budget is not None:
        raise ValueError("target_error and time_budget exclude each other; give one")
    if spp is not None:
        name = "target_error" if target_error is not None else "time_budget"
        raise ValueError(f"spp and {name} exclude each other: the budget says how many samples are taken")
    if report is not None and not isinstance(report, Report):
        raise ValueError(f"report: got {type(report).__name__}, expected what psdr.accuracy returned")
    if time_budget is None:
        positive("target_error", target_error)
    else:
        positive("time_budget", time_budget)
    return True


def spend(
    what: Quantity, wanted: Budget, *, seed: int, progress: Callable[[float], None] | None
) -> tuple[np.ndarray, Reached]:
    """Estimate a quantity within a budget.

    Returns:
        Its components, and what was reached.

    Raises:
        ValueError: the report is of something else, or the gradient does not stand out of the pilot's noise.
    """
    seed = checked_seed(seed)
    pilot_seconds = 0.0
    report = wanted.report
    if report is None:
        seconds = ERROR_PILOT if wanted.seconds is None else max(pilot.SHARE * wanted.seconds, LEAST_PILOT)
        options: dict[str, Any] = {"seconds": seconds, "error": wanted.error, "patience": PATIENCE}
        report = pilot.run(what, spp=None, seed=seed, tiles=True, clock="wall", **options)
        pilot_seconds = report.pilot_seconds
    _check_report(what, report)
    if report.tile:
        what = what.tiled(spread(what, report.tile, report.deviations))
    seed = mix_seed(seed, STREAM_BUDGET)
    found, left = report, (wanted.seconds or 0.0) - pilot_seconds
    if wanted.error is not None:
        report = found.fitted(error=wanted.error)
        raw, counts, error, spent = _to_error(what, report, found, float(wanted.error), seed, progress)
    else:
        left = max(left, LEAST_SECONDS)
        report = found.fitted(seconds=left)
        raw, counts, error, spent = _in_time(what, report, found, left, seed, progress)
    if progress is not None:
        progress(1.0)
    names = [part.name for part in what.parts]
    batches = dict(zip(names, counts, strict=True))
    spp = {t.name: t.spp * batches[t.name] for t in report.terms}
    return what.finished(raw), Reached(error, spent, pilot_seconds, spp, batches, found)


def _check_report(what: Quantity, report: Report) -> None:
    """Refuse the report of something else."""
    pairs = {
        "role": (report.role, what.role),
        "terms": ([t.name for t in report.terms], [p.name for p in what.parts]),
        "parameters": (list(report.norm2), list(what.blocks)),
    }
    for name, (got, expected) in pairs.items():
        if got != expected:
            raise ValueError(f"report: its {name} are {got}, expected {expected}; run psdr.accuracy for this call")
    if report.tile:
        tiles = tile_count(what, report.tile)
        if len(report.deviations) != tiles:
            raise ValueError(
                f"report: it has {len(report.deviations)} tiles, this image {tiles}; run psdr.accuracy for this call"
            )


class _Half:
    """Batches of all terms with seeds of their own, and what they say of the error.

    Args:
        what: what is estimated.
        report: the pilot's, for batches of the sizes that are run.
        found: the pilot's, for batches of its own sizes.
        seed: of the batches.
    """

    def __init__(self, what: Quantity, report: Report, found: Report, seed: int):
        self._what, self._report, self._seed = what, report, seed
        # The logarithm of a variance has the variance (kurtosis - 1) / (number of batches), of one that was told from
        # another size also that of the exponent.
        sizes = np.array([a.spp / b.spp for a, b in zip(report.terms, found.terms, strict=True)])
        errors = np.hypot(np.nan_to_num([t.exponent_error for t in found.terms]), DRIFT)
        self._excess = np.maximum([t.kurtosis - 1.0 for t in found.terms], LEAST_EXCESS)[:, None]
        self._known = self._excess / (self._excess / (found.batches - 1) + (errors * np.log(sizes))[:, None] ** 2)
        self._blocks = list(what.blocks.values())
        self.terms = [Running(self._blocks) for _ in what.parts]

    def run(self, counts: np.ndarray) -> None:
        """Bring every term to its number of batches."""
        for k, (part, sums) in enumerate(zip(self._what.parts, self.terms, strict=True)):
            stream = mix_seed(self._seed, k)
            while sums.count < counts[k]:
                raw = part.run(self._report.terms[k].spp, mix_seed(stream, sums.count))
                sums.add(raw, self._what.finished(raw))

    def mean(self) -> np.ndarray:
        """Return the sum of the terms' means, raw."""
        total = sum(sums.total / sums.count for sums in self.terms)
        return np.asarray(total)

    def variances(self) -> np.ndarray:
        """Return (terms, blocks): of a batch, from this half and the pilot, by their degrees of freedom."""
        prior = np.array([[t.variance[b] for b in self._what.blocks] for t in self._report.terms])
        known = self._known
        own = np.array([sums.variance() for sums in self.terms])
        degrees = np.array([[sums.count - 1] for sums in self.terms])
        return (known * prior + degrees * own) / (known + degrees)

    def norm2(self, variances: np.ndarray) -> np.ndarray:
        """Return (blocks,): squared norms, from this half and the pilot, by how certain their means are."""
        counts = np.array([sums.count for sums in self.terms])
        components = np.sum([np.asarray(sums.sums) / sums.count for sums in self.terms], axis=0)
        lengths2 = np.array([squared(components[block]) for block in self._blocks])
        noise = (variances / counts[:, None]).sum(axis=0)
        prior = np.array([self._report.norm2[b] for b in self._what.blocks])
        prior_noise = variances.sum(axis=0) / self._report.batches
        # Inverse variances of the two means; what has no noise at all is as good as certain.
        weight, prior_weight = 1.0 / np.maximum(noise, 1e-300), 1.0 / np.maximum(prior_noise, 1e-300)
        return (weight * (lengths2 - noise) + prior_weight * prior) / (weight + prior_weight)

    def relative_variance(self) -> np.ndarray:
        """Return (terms,): squared relative error of a batch; infinite where nothing stands out of the noise."""
        variances = self.variances()
        norm2 = self.norm2(variances)
        seen = np.array([name in self._report.seen for name in self._what.blocks])
        if (norm2[seen] <= 0.0).any():
            return np.full(len(variances), math.inf)
        return np.asarray((variances[:, seen] / norm2[seen]).mean(axis=1))

    def error(self, counts: np.ndarray) -> float:
        """Return the relative error of means of (terms,) batches; infinite where nothing stands out of the noise."""
        return math.sqrt(float((self.relative_variance() / counts).sum()))

    def needed(self, wanted: np.ndarray, start: float, target: float) -> float:
        """Return the factor, ``start`` or up to ``NEXT_LOOK`` times that, of (terms,) batches a half for this error.

        Infinite: they are more.
        """
        variance = self.relative_variance()
        own = np.array([max(sums.count - 1, 0) for sums in self.terms])
        uncertain = self._excess[:, 0] / (self._known[:, 0] + own)
        share = start
        while share <= NEXT_LOOK * start and np.isfinite(variance).all():
            squares = variance / (2.0 * np.maximum(share * wanted, 1.0))
            total = max(float(squares.sum()), 1e-300)
            if total * (1.0 + min(float((squares / total) ** 2 @ uncertain), MOST_UNCERTAIN)) <= target**2:
                return share
            share *= STEP
        return math.inf


def _whole(share: float, wanted: np.ndarray, half: int) -> np.ndarray:
    """Return whole numbers of batches of a half; those of both add up to the nearest of the sum."""
    return np.maximum(np.floor(share * wanted + (0.25, 0.75)[half]), 1.0)


def _to_error(what: Quantity, report: Report, found: Report, target: float, seed: int, progress):
    """Run both halves until each has decided about the other."""
    now = pilot.CLOCKS[report.clock]
    start = now()
    wanted = batches_for_error(report.cost, report.relative_variance, target) / 2.0
    halves = [_Half(what, report, found, mix_seed(seed, stream)) for stream in (STREAM_A, STREAM_B)]
    means: list[np.ndarray | None] = [None, None]
    used: list[np.ndarray] = [np.zeros(0), np.zeros(0)]
    look = FIRST_LOOK
    while means[0] is None or means[1] is None:
        for i, half in enumerate(halves):
            half.run(_whole(look, wanted, i))
        # Both decide before either runs on: a half never knows how much the other has seen.
        shares = [half.needed(wanted, look, target) for half in halves]
        for a, b in ((0, 1), (1, 0)):
            if means[a] is None and math.isfinite(shares[b]):
                used[a] = _whole(shares[b], wanted, a)
                halves[a].run(used[a])
                means[a] = halves[a].mean()
        look *= NEXT_LOOK
        if progress is not None:
            progress(min(0.99, 0.5 * look))
    # The mean of two means of n and m batches has the variance V (1/n + 1/m) / 4: that of 4 / (1/n + 1/m) batches.
    effective = 4.0 / (1.0 / used[0] + 1.0 / used[1])
    both = _together(halves, what, report, found)
    assert means[0] is not None and means[1] is not None
    return 0.5 * (means[0] + means[1]), (used[0] + used[1]).astype(int).tolist(), both.error(effective), now() - start


def _in_time(what: Quantity, report: Report, found: Report, seconds: float, seed: int, progress):
    """Run rounds until they are done or the time is over."""
    now = pilot.CLOCKS[report.clock]
    start = now()
    each, most = rounds(report, seconds)
    whole, done = _Half(what, report, found, seed), 0
    mean: np.ndarray | float = 0.0
    names = range(len(what.parts))
    blocks = list(what.blocks.values())
    while done < most:
        this = [Running(blocks) for _ in names]
        for k, part in enumerate(what.parts):
            stream = mix_seed(seed, k)
            for i in range(int(each[k])):
                raw = part.run(report.terms[k].spp, mix_seed(stream, done * int(each[k]) + i))
                this[k].add(raw, what.finished(raw))
        if done and now() - start > SLACK * seconds:
            break
        for sums, more in zip(whole.terms, this, strict=True):
            sums.merge(more)
        done += 1
        mean = whole.mean()
        spent = now() - start
        if progress is not None:
            progress(min(0.99, max(done / most, spent / seconds)))
        if spent > SLACK * seconds:  # the next round could not count
            break
    counts = done * each
    return np.asarray(mean), counts.astype(int).tolist(), whole.error(counts), now() - start


def rounds(report: Report, seconds: float) -> tuple[np.ndarray, int]:
    """Return the batches of each term in a round, and the number of rounds that fill a time."""
    cost, variance = report.cost, report.relative_variance
    ideal = batches_for_time(cost, variance, seconds, LEAST_IN_TIME)
    best: tuple[float, np.ndarray, int] | None = None
    for number in range(1, MOST_ROUNDS + 1):
        each = np.maximum(np.floor(FULL * ideal / number), 1.0)
        # What flooring leaves over goes to more rounds.
        count = max(int(FULL * seconds / float(each @ cost)), 1)
        error2 = float((variance / (count * each)).sum())
        if best is None or error2 <= best[0] * (1.0 + ROUNDING):
            best = (min(error2, best[0] if best else error2), each, count)
    assert best is not None
    return best[1], best[2]


def _together(halves: list[_Half], what: Quantity, report: Report, found: Report) -> _Half:
    """Return both halves' batches as one; only the error that is reported is estimated from it."""
    whole = _Half(what, report, found, 0)
    for half in halves:
        for sums, more in zip(whole.terms, half.terms, strict=True):
            sums.merge(more)
    return whole

"""The rounds of a pilot: batches of every term, of two sizes, until their costs and variances are known well enough.

A round is a batch of every term, with a seed of its own. Some rounds also run a batch ``LARGER`` times as large, whose
time and variance give the marginal cost and the exponent a of a variance that falls as samples^-a. If a differs from
one by more than its error, budgets will run such batches, and every round has one. The logarithm of a predicted time,
log (sum_k sqrt(U_k C_k))^2 for costs C_k and relative variances U_k, changes by s_k = sqrt(U_k C_k) / sum_j sqrt(U_j
C_j) times the change of log U_k or log C_k. The jackknife gives the scatter of U (and of the norms in it) for all terms
at once, bounded below by that of normal batches; the uncertainty of C_k and of the exponents is added.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from warp_psdr.accuracy.allocation import efficiency
from warp_psdr.accuracy.quantity import Quantity
from warp_psdr.accuracy.report import LARGEST_FOR_ERROR, counted_exponent
from warp_psdr.accuracy.statistics import Moments, Running, jackknife, moments, pooled, relative_variance
from warp_psdr.kernels.rng import mix_seed

#: Rounds: the least, the most, and how many the pilot's time should be enough for.
LEAST_ROUNDS, MOST_ROUNDS, AIM_ROUNDS = 4, 256, 64
#: Standard error of the logarithm of a predicted time at which the pilot ends.
CERTAIN = 0.12
#: Rounds after which it may; those after which exponents are looked at; after the pilot's time, when it has grown by a
#: factor.
LOOKS, EXPONENT_LOOKS, LATER = (32, 45, 64, 91, 128, 181), (12, 22), 1.2
#: Batches of the other size: larger by this factor, as those for an error are at most, so that what they cost and how
#: they vary lies between two that were measured; the first rounds that have one (the second and third if time is left),
#: the rounds from one to the next, and the least batches that tell a variance.
LARGER, OTHER_FIRST, OTHER_EVERY, LEAST_OTHERS = int(LARGEST_FOR_ERROR), (1, 3, 5), 5, 3
#: Share of the times of a batch that count, from the fastest on.
KEPT_TIMES = 0.9
#: Batches of a term that are kept hold at most this many numbers (256 MB).
KEPT = 1 << 25


@dataclass(frozen=True)
class Known:
    """What batches say.

    Attributes:
        found: moments of the pilot's batches; variances are those that both sizes tell.
        cost: (terms,), seconds of a batch.
        cost_error: (terms,), standard errors.
        exponents: of every term, and its standard error; NaN: not measured.
    """

    found: Moments
    cost: np.ndarray
    cost_error: np.ndarray
    exponents: tuple[tuple[float, float], ...]

    def spread(self, factor: float = 1.0) -> float:
        """Return the standard error of the logarithm of error^2 * time, of batches larger by a factor."""
        found, cost = self.found, self.cost
        if not found.seen.any():
            return math.inf
        u = relative_variance(found.variance, found.norm2, found.seen)
        without = relative_variance(found.variance_without, found.norm2_without, found.seen)
        best = float(efficiency(cost, u))
        if best <= 0.0:
            return 0.0
        share = np.sqrt(u * cost / best)
        statistical = float(jackknife(np.log(np.maximum(efficiency(cost, without), 1e-300))))
        # A few batches that happen to lie close to one another do not tell how far others lie.
        squares = (found.squares[:, found.seen] / found.norm2[found.seen] ** 2).sum(axis=1)
        normal = np.sqrt(2.0 * squares / found.batches) / np.maximum(u * found.seen.sum(), 1e-300)
        statistical = max(statistical, float(np.linalg.norm(share * normal)))
        timing = float(np.linalg.norm(share * self.cost_error / np.maximum(cost, 1e-300)))
        drift = share * [counted_exponent(*e)[1] for e in self.exponents] * math.log(factor)
        return math.hypot(statistical, timing, float(np.linalg.norm(drift)))


class Rounds:
    """Batches of all terms.

    Args:
        what: what is estimated.
        sizes: samples a pixel of the batches of each term.
        seeds: streams of the two sizes.
        now: the clock.
    """

    def __init__(self, what: Quantity, sizes: list[int], seeds: tuple[int, int], now: Callable[[], float]):
        self._what, self._seeds, self._now = what, seeds, now
        self._sizes = (sizes, [LARGER * n for n in sizes])
        self._blocks = list(what.blocks.values())
        size = max(block.stop for block in self._blocks) * len(sizes)
        self.most = max(min(MOST_ROUNDS, KEPT // size), LEAST_ROUNDS)
        self.kept: tuple[list[list], list[list]] = ([[] for _ in sizes], [[] for _ in sizes])
        self.times: tuple[list[list[float]], list[list[float]]] = ([[] for _ in sizes], [[] for _ in sizes])
        self._sums = [Running(self._blocks) for _ in sizes]  # their additions are part of what a batch costs
        self._every = [OTHER_EVERY] * len(sizes)

    def run(self, seconds: float, allowed: Callable[[Known], float], start: float, progress) -> Known:
        """Run rounds until enough is known, or the time that is allowed for it is over."""
        next_look, number, spent = 0.0, 0, 0.0
        while True:
            early = OTHER_FIRST if spent < seconds else OTHER_FIRST[:1]
            for k, every in enumerate(self._every):
                self._batch(k, 0, number)
                if number in early or number % every == 1 % every:
                    self._batch(k, 1, number)
            number += 1
            spent = self._now() - start
            if progress is not None:
                progress(min(max(spent / seconds, number / MOST_ROUNDS), 0.99))
            over = number >= LEAST_ROUNDS and spent >= seconds
            # How much is known is looked at rarely.
            late = over and spent >= next_look
            if number < self.most and number not in LOOKS + EXPONENT_LOOKS and not late:
                continue
            known = self._known()
            self._every = [1 if counted_exponent(*e)[0] != 1.0 else OTHER_EVERY for e in known.exponents]
            certain = number in LOOKS and known.found.seen.all() and known.spread(LARGER) <= CERTAIN
            if number >= self.most or certain or (late and spent >= allowed(known)):
                return known
            if late:
                next_look = LATER * spent

    def _batch(self, k: int, size: int, number: int) -> None:
        begun = self._now()
        raw = self._what.parts[k].run(self._sizes[size][k], mix_seed(self._seeds[size], number))
        batch = self._what.finished(raw)
        self._sums[k].add(raw, batch)
        self.times[size][k].append(self._now() - begun)
        if size == 0 or len(self.kept[1][k]) < self.most // 2:
            self.kept[size][k].append(batch.astype(np.float32))

    def _known(self) -> Known:
        found = moments(self.kept[0], self._blocks)
        exponents, scale, second = [], np.zeros(len(self._sums)), []
        for k, batches in enumerate(self.kept[1]):
            told = moments([batches], self._blocks) if len(batches) >= LEAST_OTHERS else None
            exponents.append((math.nan, math.nan) if told is None else _exponent(found, told, k))
            scale[k] = LARGER ** counted_exponent(*exponents[k])[0]
            second.append(told)
        found = pooled(found, second, scale, math.sqrt(LARGER))
        cost, cost_error = np.array([typical(t) for t in self.times[0]]).T
        return Known(found, cost, cost_error, tuple(exponents))


def _exponent(found: Moments, second: Moments, k: int) -> tuple[float, float]:
    """Return the exponent of the variance's fall and its standard error (delta method on the two logarithms).

    Few batches of the other size say little of how uncertain they are: no less than the kurtosis of the many says.
    """
    values, errors = [], []
    excess = max(float(found.kurtosis[k]) - 1.0, 0.0)
    for m, row in ((found, k), (second, 0)):
        u = relative_variance(m.variance, found.norm2, found.seen)[row] if found.seen.any() else 0.0
        if u <= 0.0:
            return math.nan, math.nan
        without = relative_variance(m.variance_without, found.norm2, found.seen)[:, row]
        values.append(math.log(u))
        errors.append(max(float(jackknife(without)) / u, math.sqrt(excess / m.batches)))
    return (values[0] - values[1]) / math.log(LARGER), math.hypot(*errors) / math.log(LARGER)


def typical(times: list[float]) -> tuple[float, float]:
    """Return the mean of times without the slowest tenth, which other work on the machine makes, and its error."""
    kept = np.sort(times)[: max(math.ceil(KEPT_TIMES * len(times)), 1)]
    return float(kept.mean()), float(kept.std() / math.sqrt(len(kept)))

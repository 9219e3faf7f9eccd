"""Spending a budget: batches go where a verdict is open, and the test keeps its level.

Batches come from samplers; a row compares two of them. The number of batches is fixed before they are drawn, by
variances and costs that are known until then. A test follows; where rows are open and time is left, numbers are fixed
once more, and there is a second and last test of all batches. Each of the ``LOOKS`` tests has its share of the level
(Bonferroni), whatever made the run go on.

A row that is called biased is tested once more, with differences of much shorter steps where it has such: a bias stays,
and what only long steps see does not. It takes both p-values. If shorter steps do not confirm it, they replace the
others at the next look.

Derivation: ``docs/theory/certificates.md#looking-twice``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from warp_psdr.certify.statistics import Batches, Slope, holm
from warp_psdr.kernels.rng import mix_seed

#: Tests at most.
LOOKS = 2
#: Batches of a pilot, and the least of a test.
PILOT, LEAST = 5, 8
#: A pilot of few batches tells a variance badly: it is taken so many times larger at the first look.
DOUBT = (1.5, 1.0)
#: Standard errors by which an interval is to be shorter than needed: 90 of 100 plans then suffice, and 99 of the last.
SPARE = (1.3, 2.3)
#: Share of the budget by which confirming a bias may exceed it.
CONFIRMING = 0.5
#: Growth of a sampler's batches in planning, and the most that are planned.
GROWTH, MOST = 1.2, 1 << 20
#: Share of the tolerance that noise is to fit into where a remainder takes more than the rest.
LEAST_ROOM = 0.2
#: Streams of the pilots' and the tests' random numbers.
STREAM_PILOT, STREAM_TEST = 1, 2


@dataclass(eq=False)
class Sampler:
    """Independent batches of some numbers.

    Attributes:
        draw: seed -> one batch.
        seed: of its stream.
        pilot: batches that plan, and are not tested.
        batches: those that are tested.
        seconds: spent on ``calls`` of them.
    """

    draw: Callable[[int], np.ndarray]
    seed: int
    pilot: list[np.ndarray] = field(default_factory=list)
    batches: list[np.ndarray] = field(default_factory=list)
    seconds: float = 0.0
    calls: int = 0

    @property
    def cost(self) -> float:
        """Seconds of a batch."""
        return self.seconds / max(self.calls, 1)

    def try_out(self, count: int = PILOT) -> None:
        """Draw batches of the pilot."""
        for _ in range(count):
            self.pilot.append(self._timed(mix_seed(mix_seed(self.seed, STREAM_PILOT), len(self.pilot))))

    def run(self, count: int, over: Callable[[], bool]) -> None:
        """Draw batches until there are so many, or the time is over and there are enough for a test."""
        while len(self.batches) < count and not (over() and len(self.batches) >= LEAST):
            self.batches.append(self._timed(mix_seed(mix_seed(self.seed, STREAM_TEST), len(self.batches))))

    def known(self) -> np.ndarray:
        """Return the batches by which numbers are planned."""
        return np.stack(self.batches if len(self.batches) >= LEAST else self.pilot)

    def _timed(self, seed: int) -> np.ndarray:
        begun = time.perf_counter()
        found = self.draw(seed)
        self.seconds += time.perf_counter() - begun
        self.calls += 1
        return found


@dataclass(eq=False, kw_only=True)
class Row:
    """A comparison.

    Attributes:
        check: name of the check that it belongs to.
        parameter: name of the parameter.
        what: the direction, or the methods.
        a, b: samplers.
        of_a: batches of ``a`` -> (n,).
        of_b: batches of ``b`` -> (n,) and the remainder (n,).
        finer: the same as ``b``, by much shorter steps; None: there are none.
        floor: as of ``Batches``.
        p_value: so far, adjusted for the number of looks.
        slope: at the last look.
        decided: within, at some look.
        needed: seconds that would decide it, about.
    """

    check: str
    parameter: str
    what: str
    a: Sampler
    b: Sampler
    of_a: Callable[[np.ndarray], np.ndarray]
    of_b: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    finer: Sampler | None = None
    floor: float = 0.0
    p_value: float = 1.0
    slope: Slope | None = None
    decided: bool = False
    seen: bool = True
    heavy: bool = False
    needed: float = math.nan

    def compared(self) -> Batches:
        """Return the batches that are tested."""
        return Batches(self.of_a(np.stack(self.a.batches)), *self.of_b(np.stack(self.b.batches)), self.floor)

    def look(self, tolerance: float, level: float) -> None:
        """Test with all batches; ``level``: of the interval of this look."""
        batches = self.compared()
        self.seen, self.heavy = batches.seen, batches.heavy
        if not self.seen:
            return
        self.slope = batches.slope(level)
        self.decided |= self.slope.within(tolerance)
        self.p_value = min(self.p_value, 1.0, LOOKS * batches.p_value(tolerance))

    def confirm(self, tolerance: float, alpha: float, level: float, over: Callable[[], bool]) -> None:
        """Test a row that is called biased with shorter steps, by as many batches as its bias needs."""
        if self.finer is None:
            return
        self.b, self.finer = self.finer, None
        self.b.try_out()
        assert self.slope is not None
        of_a, of_b, _remainder = self.variances()
        away = max(abs(self.slope.value - 1.0) - tolerance, 0.0)
        room = (away / (float(stats.norm.isf(alpha)) + SPARE[-1])) ** 2 - of_a / len(self.a.batches)
        needed = DOUBT[0] * of_b / room if room > 0.0 else math.inf
        self.b.run(max(LEAST, math.ceil(min(needed, MOST))), over)
        batches = self.compared()
        self.slope, self.heavy = batches.slope(level), batches.heavy
        self.p_value = max(self.p_value, min(1.0, LOOKS * batches.p_value(tolerance)))

    def variances(self) -> tuple[float, float, float]:
        """Return the variances of a batch of both sides, and the remainder, of a slope of 1."""
        a = self.of_a(self.a.known())
        b, r = self.of_b(self.b.known())
        size = max(abs(float(b.mean())), self.floor)
        if size == 0.0:
            return 0.0, 0.0, 0.0
        of_b = max(x.var(ddof=1) for x in (b, b + r, b - r))
        return float(a.var(ddof=1)) / size**2, float(of_b) / size**2, size_of(r) / size


def size_of(remainder: np.ndarray) -> float:
    """Return the size of the mean of batches without what their noise adds to it."""
    return math.sqrt(max(float(remainder.mean()) ** 2 - float(remainder.var(ddof=1)) / len(remainder), 0.0))


def spend(
    rows: Sequence[Row], seconds: float, tolerance: float, level: float, progress: Callable[[float], None] | None = None
) -> None:
    """Spend a budget on rows, and test them.

    Args:
        rows: what is compared.
        seconds: for all of it.
        tolerance: of slopes.
        level: of the certificate.
        progress: called with the finished fraction.
    """
    start = time.perf_counter()

    def left() -> float:
        return seconds - (time.perf_counter() - start)

    def over() -> bool:
        if progress is not None:
            progress(min(1.0 - left() / seconds, 0.99) if seconds > 0.0 else 0.99)
        return left() <= 0.0

    def long_over() -> bool:
        return left() <= -CONFIRMING * seconds

    def biased() -> list[Row]:
        adjusted = holm([row.p_value for row in rows])
        return [row for row, p in zip(rows, adjusted, strict=True) if p <= 1.0 - level]

    plan = Planning(tolerance, (1.0 - level) / LOOKS)
    open_rows = list(rows)
    for look in range(LOOKS):
        wanted = plan.counts(open_rows, left(), look)
        for sampler in _samplers(open_rows):
            sampler.run(wanted[id(sampler)], over)
        for row in open_rows:
            row.look(tolerance, 1.0 - plan.alpha)
        for row in biased():
            row.confirm(tolerance, (1.0 - level) / len(rows), 1.0 - plan.alpha, long_over)
        closed = {id(row) for row in biased()}
        open_rows = [row for row in open_rows if row.seen and not row.decided and id(row) not in closed]
        if not open_rows or over():
            break
    for row in open_rows:
        row.needed = plan.alone(row)


@dataclass(frozen=True)
class Planning:
    """How many batches rows need.

    Attributes:
        tolerance: of slopes.
        alpha: of the interval of a look, both sides together.
    """

    tolerance: float
    alpha: float

    def counts(self, rows: Sequence[Row], seconds: float, look: int) -> dict[int, int]:
        """Return the number of batches of every sampler, by its id: rows that are cheap to decide come first.

        The first that does not fit gets what is left: a large bias shows early.
        """
        samplers = _samplers(rows)
        counts = {id(s): max(len(s.batches), LEAST) for s in samplers}
        costs = {id(s): s.cost for s in samplers}
        left = seconds - sum((counts[id(s)] - len(s.batches)) * s.cost for s in samplers)
        for row in sorted(rows, key=self.alone):
            more = self._enough(row, counts, look)
            extra = sum((more[key] - counts[key]) * costs[key] for key in more)
            share = min(max(left, 0.0) / extra, 1.0) if extra > 0.0 else 1.0
            for key, count in more.items():
                counts[key] += int(share * (count - counts[key]))
            left -= share * extra
        return counts

    def alone(self, row: Row) -> float:
        """Return the seconds that would decide a row by itself; infinite where its remainder is too large."""
        if row.variances()[2] >= self.tolerance:
            return math.inf
        counts = self._enough(row, {id(row.a): LEAST, id(row.b): LEAST}, LOOKS - 1)
        return counts[id(row.a)] * row.a.cost + counts[id(row.b)] * row.b.cost

    def _enough(self, row: Row, counts: dict[int, int], look: int) -> dict[int, int]:
        """Return numbers of batches of a row's samplers that decide it, no fewer than there are already."""
        of_a, of_b, remainder = row.variances()
        a, b = id(row.a), id(row.b)
        counts = {a: counts[a], b: counts[b]}
        room = max(self.tolerance - remainder, LEAST_ROOM * self.tolerance)
        while max(counts.values()) < MOST:
            quantile = float(stats.t.isf(0.5 * self.alpha, min(counts.values()) - 1))
            shares = {a: DOUBT[look] * of_a / counts[a], b: DOUBT[look] * of_b / counts[b]}
            if shares[a] + shares[b] <= (room / (quantile + SPARE[look])) ** 2:
                break
            gain = {id(s): shares[id(s)] / max(counts[id(s)] * s.cost, 1e-9) for s in (row.a, row.b)}
            best = max(gain, key=lambda key: gain[key])
            counts[best] = math.ceil(GROWTH * counts[best])
        return counts


def _samplers(rows: Sequence[Row]) -> list[Sampler]:
    return list({id(s): s for row in rows for s in (row.a, row.b)}.values())

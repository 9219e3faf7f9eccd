"""One certificate, from a subject to its verdicts: a pilot, directions, rows of all checks, batches, Holm."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from warp_psdr.accuracy.report import positive
from warp_psdr.certify import estimators, identities, necessity, precision, price, slope
from warp_psdr.certify.adjoints import telling_adjoint
from warp_psdr.certify.certificate import BIASED, NOT_SEEN, UNDECIDED, WITHIN, Certificate, Finding
from warp_psdr.certify.directions import Direction
from warp_psdr.certify.examination import Examination
from warp_psdr.certify.spending import Row, spend
from warp_psdr.certify.statistics import holm
from warp_psdr.certify.subject import Subject
from warp_psdr.estimate.arguments import checked_seed

#: Name -> rows of a check.
CHECKS: dict[str, Callable[[Examination], list[Row]]] = {
    slope.NAME: slope.rows,
    identities.NAME: identities.rows,
    precision.NAME: precision.rows,
    estimators.NAME: estimators.rows,
}
#: Names of all checks.
NAMES = (*CHECKS, necessity.NAME, price.NAME)
#: Share of the budget that pilots and the least batches of differences may take, and those of other methods; every
#: parameter has one direction at least.
PILOT_SHARE, METHODS_SHARE = 0.25, 0.25
#: Most directions of a parameter.
MOST_DIRECTIONS = 8
#: p-value of a comparison by itself from which on it leans away from 1.
LEANS = 0.05
#: Name, mean and standard deviation of a pilot's gradient -> directions, and notes on those that are left out.
Directions = Callable[[str, np.ndarray, np.ndarray], tuple[list[Direction], list[str]]]


@dataclass(frozen=True)
class Request:
    """What is asked of a certificate; attributes as the arguments of ``psdr.certify``."""

    budget: float
    level: float
    tolerance: float
    checks: tuple[str, ...]
    seed: int

    @classmethod
    def checked(
        cls, budget: float, level: float, tolerance: float, checks: str | Sequence[str], seed: int, known: Iterable[str]
    ) -> Request:
        """Return a request.

        Raises:
            ValueError: an option out of range, or a check that is not known.
        """
        for name, value, low in (("level", level, 0.5), ("tolerance", tolerance, 0.0)):
            if not low < positive(name, value) < 1.0:
                raise ValueError(f"{name}: got {value!r}, expected a number between {low:g} and 1")
        wanted = tuple(known) if checks == "all" else (checks,) if isinstance(checks, str) else tuple(checks)
        for name in wanted:
            if name not in known:
                raise ValueError(f"checks: got {name!r}, expected 'all' or some of {', '.join(map(repr, known))}")
        return cls(positive("budget", budget), level, tolerance, wanted, checked_seed(seed))


def issue(
    subject: Subject,
    adjoints: np.ndarray,
    directions: Directions,
    request: Request,
    progress: Callable[[float], None] | None,
    chooses: bool,
    afterwards: Callable[[], list[str]] = list,
) -> Certificate:
    """Examine a subject.

    Args:
        subject: what is examined.
        adjoints: (K, H, W, 3).
        directions: of a parameter.
        request: what is asked.
        progress: called with the finished fraction.
        chooses: whether an adjoint that a pilot chooses takes the place of ``adjoints`` once there are directions.
        afterwards: what else there is to say when all is done.
    """
    start = time.perf_counter()
    e = _prepared(subject, adjoints, directions, request)
    if chooses and e.directions:
        e.watch(telling_adjoint(e))
    rows = [row for name in request.checks if name in CHECKS for row in CHECKS[name](e)] if e.directions else []
    effects = necessity.effects(e, request.budget) if necessity.NAME in request.checks else []
    start += e.compiling
    left = request.budget - (time.perf_counter() - start)
    spend(rows, left, request.tolerance, request.level, progress)
    if progress is not None:
        progress(1.0)
    adjusted = holm([row.p_value for row in rows])
    return Certificate(
        parameters=tuple(subject.values),
        findings=tuple(_finding(row, p, request.level) for row, p in zip(rows, adjusted, strict=True)),
        effects=tuple(effects),
        prices=tuple(e.prices) if price.NAME in request.checks else (),
        refused=tuple(e.refused),
        notes=(*e.notes, *afterwards()),
        level=request.level,
        tolerance=request.tolerance,
        budget=request.budget,
        seconds=time.perf_counter() - start,
    )


def _prepared(subject: Subject, adjoints: np.ndarray, directions: Directions, request: Request) -> Examination:
    """Return an examination with directions: as many as there is time for, but one a parameter at least."""
    begun = time.perf_counter()
    subject.image({}, 1)
    image = time.perf_counter() - begun
    e = Examination(subject, adjoints, [], request.seed, request.tolerance)
    e.for_methods = METHODS_SHARE * request.budget
    pilot = e.pilot()
    found = []
    for name in subject.values:
        batches = np.stack([gradients[name] for gradients in pilot])  # (PILOT, K, ...)
        sizes = np.linalg.norm(batches.mean(axis=0).reshape(len(adjoints), -1), axis=1)
        batches = batches[:, int(np.argmax(sizes))]
        e.prices.append(price.price(name, batches, e.base.cost / len(adjoints)))
        kept, notes = directions(name, batches.mean(axis=0), batches.std(axis=0, ddof=1))
        # A sun's direction shifts and nothing changes: what the pilot sees comes first.
        found.append(sorted(kept, key=lambda direction: not direction.along(batches).any()))
        e.notes += notes
    chosen = [of_parameter[0] for of_parameter in found if of_parameter]
    rest = [d for rank in range(1, MOST_DIRECTIONS) for of_parameter in found for d in of_parameter[rank : rank + 1]]
    most = int(PILOT_SHARE * request.budget / (image * slope.LEAST_IMAGES))
    e.take(chosen + rest[: max(most - len(chosen), 0)], pilot)
    return e


def _finding(row: Row, p_value: float, level: float) -> Finding:
    verdict, note = UNDECIDED, ""
    if not row.seen:
        verdict, note = NOT_SEEN, "neither the image nor its derivative changes"
    elif p_value <= 1.0 - level:
        verdict = UNDECIDED if row.heavy else BIASED
        note = "one batch holds most of the variance: errors are not to be trusted" if row.heavy else ""
    elif row.decided:
        verdict = WITHIN
    return Finding(
        check=row.check,
        parameter=row.parameter,
        what=row.what,
        verdict=verdict,
        slope=row.slope,
        p_value=p_value,
        batches=(len(row.a.batches), len(row.b.batches)),
        seconds=row.needed,
        leans=row.seen and row.slope is not None and row.p_value <= LEANS,
        note=note,
    )

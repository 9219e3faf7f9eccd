"""``psdr.certify``: checks of gradients at the present values of a scene, within a budget of time."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_psdr.accuracy.report import positive
from warp_psdr.certify import estimators, slope
from warp_psdr.certify.certificate import BIASED, NOT_SEEN, UNDECIDED, WITHIN, Certificate, Finding
from warp_psdr.certify.directions import Direction, directions_of, random_adjoints
from warp_psdr.certify.examination import Examination
from warp_psdr.certify.spending import Row, spend
from warp_psdr.certify.statistics import holm
from warp_psdr.certify.subject import SceneSubject, adjoints_of, untouched
from warp_psdr.estimate.arguments import checked_seed, flat_tangents, requested
from warp_psdr.options.integrator import Integrator
from warp_psdr.plan.integrator import integrator_of
from warp_psdr.plan.transient import require_steady
from warp_psdr.scene.loaded import check_loaded
from warp_psdr.topology import contacts

if TYPE_CHECKING:
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene

#: Name -> rows of a check.
CHECKS: dict[str, Callable[[Examination], list[Row]]] = {slope.NAME: slope.rows, estimators.NAME: estimators.rows}
#: Share of the budget that pilots and the least batches of differences may take, and those of other methods; every
#: parameter has one direction at least.
PILOT_SHARE, METHODS_SHARE = 0.25, 0.25
MOST_DIRECTIONS = 8
#: p-value of a comparison by itself from which on it leans away from 1.
LEANS = 0.05


def certify(
    scene: Scene,
    params: Parameters,
    adjoint: Any = None,
    *,
    integrator: Integrator | None = None,
    sensor: int | str = 0,
    budget: float = 60.0,
    level: float = 0.99,
    tolerance: float = 0.02,
    checks: str | Sequence[str] = "all",
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Certificate:
    """Examine the gradients of the requested parameters: are they right, at the scene's present values?

    Each is compared with differences of images along several directions, and with every other method that covers it.
    The scene, the requests, gradients and what guiding has built stay as they are.

    Args:
        scene: a loaded scene.
        params: its parameters, after ``requires_grad``.
        adjoint: derivative of a loss with respect to the image, (H, W, 3), whose gradient is examined. None: three
            smooth random ones.
        integrator: as of ``render``; default: what the scene file names. Methods that are left to the plan are those of
            a first gradient.
        sensor: which camera, by its number or its id.
        budget: seconds that samples may take, compiling left out. A pilot and eight batches of every comparison are
            taken whatever it is.
        level: probability with which no right gradient is called biased, and with which intervals hold.
        tolerance: a slope within 1 +- tolerance is right.
        checks: "all", or names: "slope", "estimators".
        seed: of all random numbers. How many batches there are depends on the clock.
        progress: called with the finished fraction.

    Returns:
        The certificate; ``print`` it, or ask it for ``.ok`` and ``["name"].slope``.

    Raises:
        ValueError: nothing is requested, an option out of range, a value of the scene that is not finite, or a
            derivative that is refused.
    """
    check_loaded(scene)
    names = requested(scene, params)
    budget = positive("budget", budget)
    for name, value, low in (("level", level, 0.5), ("tolerance", tolerance, 0.0)):
        if not low < value < 1.0:
            raise ValueError(f"{name}: got {value!r}, expected a number between {low:g} and 1")
    wanted = list(CHECKS) if checks == "all" else [checks] if isinstance(checks, str) else list(checks)
    for name in wanted:
        if name not in CHECKS:
            raise ValueError(f"checks: got {name!r}, expected 'all' or some of {', '.join(map(repr, CHECKS))}")
    seed, integrator = checked_seed(seed), integrator_of(scene, integrator)
    number = scene.description.sensor_number(sensor)
    require_steady(scene, number, "psdr.certify")
    with untouched(scene) as ledger:
        subject = SceneSubject.of(scene, names, integrator, number)
        adjoints = (
            random_adjoints(subject.shape, seed)
            if adjoint is None
            else adjoints_of(scene, number, adjoint, subject.shape)
        )
        subject = subject.sized(adjoints, budget)
        start = time.perf_counter()
        examination = _prepared(subject, adjoints, seed, tolerance, PILOT_SHARE * budget)
        examination.for_methods = METHODS_SHARE * budget
        rows = [row for name in wanted for row in CHECKS[name](examination)]
        start += examination.compiling
        spend(rows, budget - (time.perf_counter() - start), tolerance, level, progress)
        examination.notes += _dropped(ledger.snapshot())
    if progress is not None:
        progress(1.0)
    return Certificate(
        parameters=tuple(names),
        findings=tuple(_findings(rows, level)),
        refused=tuple(examination.refused),
        notes=tuple(examination.notes),
        level=level,
        tolerance=tolerance,
        budget=budget,
        seconds=time.perf_counter() - start,
    )


def _prepared(subject: SceneSubject, adjoints: np.ndarray, seed: int, tolerance: float, seconds: float) -> Examination:
    """Return an examination with directions: as many as there is time for, but one a parameter at least."""
    begun = time.perf_counter()
    subject.image({}, 1)
    image = time.perf_counter() - begun
    examination = Examination(subject, adjoints, [], seed, tolerance)
    pilot = examination.pilot()
    found = []
    for name in subject.names:
        batches = np.stack([gradients[name].sum(axis=0) for gradients in pilot])
        candidates = directions_of(
            subject.scene.parameters[name],
            subject.values[name],
            batches.mean(axis=0),
            batches.std(axis=0, ddof=1),
            subject.scene.radius,
            max(subject.shape),
            seed,
        )
        kept, notes = _smooth(subject, candidates)
        found.append(kept)
        examination.notes += notes
    chosen = [directions[0] for directions in found if directions]
    rest = [d for rank in range(1, MOST_DIRECTIONS) for directions in found for d in directions[rank : rank + 1]]
    most = int(seconds / (image * slope.LEAST_IMAGES))
    examination.take(chosen + rest[: max(most - len(chosen), 0)], pilot)
    return examination


def _smooth(subject: SceneSubject, found: list[Direction]) -> tuple[list[Direction], list[str]]:
    """Return the directions along which the image has a derivative, one of each name, and notes on the others."""
    kept: dict[str, Direction] = {}
    left_out: dict[str, str] = {}
    for direction in found:
        if direction.what in kept:
            continue
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            tangents = {direction.parameter: direction.tangent}
            contacts.warn(subject.scene, flat_tangents(subject.scene, subject.params, tangents).numpy())
        if caught:
            left_out[direction.what] = f"{direction.parameter}, {direction.what}: {caught[0].message}"
        else:
            kept[direction.what] = direction
    return list(kept.values()), [text for what, text in left_out.items() if what not in kept]


def _dropped(counts: dict[str, tuple[int, int]]) -> list[str]:
    return [
        f"{dropped} of {samples} samples of {kind!r} were not finite, and were dropped: that is a bias"
        for kind, (samples, dropped) in counts.items()
        if dropped
    ]


def _findings(rows: list[Row], level: float) -> list[Finding]:
    adjusted = holm([row.p_value for row in rows])
    return [_finding(row, p, level) for row, p in zip(rows, adjusted, strict=True)]


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

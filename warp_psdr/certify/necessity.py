"""Check 5: what a gradient loses without an effect that it pays for, and what that would save.

No boundary term and shorter paths are tried, until these lose much. Batches with and without an effect share their
random numbers, so that small shares stand out. They are no tests, and do not take part in verdicts: they say what could
be left out.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
from scipy import stats

from warp_psdr.certify.certificate import Effect
from warp_psdr.certify.examination import Examination
from warp_psdr.certify.spending import LEAST
from warp_psdr.certify.subject import SceneSubject
from warp_psdr.plan.plan import decide

NAME = "necessity"
#: Share of the budget that all effects together may take.
SHARE = 0.2
#: Path lengths that are tried, of paths without a limit as well; none is once a longer one loses more than so much.
DEPTHS, LOSES = (12, 8, 6, 4, 3, 2), 0.1


def effects(e: Examination, budget: float) -> list[Effect]:
    """Return what each parameter's gradient loses without each effect.

    Args:
        e: the examination, after its pilot.
        budget: of the certificate, seconds.
    """
    subject, found, left = e.scene_subject, [], SHARE * budget
    if subject is None or not e.directions:
        return []
    lost = 0.0
    for option, other, shortens in _without(subject):
        if shortens and lost > LOSES:
            break
        least = 2.0 * LEAST * e.base.cost
        if least > left:
            e.notes.append(f"{option} is not tried: its batches take {least:.2g} s, raise the budget")
            continue
        e.compile(e.derivatives(other))
        begun = time.perf_counter()
        compared = _compared(e, option, subject, other)
        if shortens:
            lost = max((abs(effect.lost) for effect in compared), default=0.0)
        found += compared
        left -= time.perf_counter() - begun
    return found


def _without(subject: SceneSubject) -> Iterator[tuple[str, SceneSubject, bool]]:
    """Yield (option, subject, whether it shortens paths) of each effect that can be left out."""
    plan = decide(subject.scene, integrator=subject.integrator, sensor=subject.sensor, names=list(subject.names))
    if plan.boundary is not None and plan.discontinuities:
        yield "boundary=None", subject.by(boundary=None), False
    depth = subject.integrator.max_depth
    for shorter in DEPTHS:
        if depth == -1 or shorter < depth:
            yield f"max_depth={shorter}", subject.by(max_depth=shorter), True


def _compared(e: Examination, option: str, subject: SceneSubject, other: SceneSubject) -> list[Effect]:
    """Return what is lost without an effect, and saved, from batches with equal random numbers in turns."""
    batches: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    seconds = [0.0, 0.0]
    for batch in range(LEAST):
        seed = e.stream(NAME, batch)
        for side, of_side in enumerate((subject, other)):
            begun = time.process_time()
            batches[side].append(e.derivatives(of_side)(seed))
            seconds[side] += time.process_time() - begun
    whole, less = (np.stack(side) for side in batches)
    pilot = np.stack(e.base.pilot).mean(axis=0)
    found = []
    for number, direction in e.telling():
        a, b = (values[:, :, number] @ pilot[:, number] for values in (whole, less))
        if a.mean() == 0.0:
            continue
        rest = float(b.mean() / a.mean())
        error = float(np.std(b - rest * a, ddof=1) / (np.sqrt(LEAST) * abs(a.mean())))
        bar = float(stats.t.ppf(0.975, LEAST - 1)) * error
        saved = 1.0 - seconds[1] / seconds[0]
        found.append(Effect(option, direction.parameter, 1.0 - rest, error, bar, saved))
    return found

"""Check 3: identities of derivatives, each from one gradient. Only those are here that find a planted defect.

Forward and reverse mode are transposes of each other: <w, J t> = <J^T w, t>. With equal random numbers both sides hold
the same samples, so that their difference has next to no noise: a factor on a gradient of reverse mode shows to a
thousandth. What both modes share cancels, and is for the other checks. (Moving everything together with the camera, and
a floor in its own plane, change nothing with or without a boundary term: such identities find no defect.)
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from warp_psdr.certify.examination import Examination
from warp_psdr.certify.spending import Row, Sampler

NAME = "identities"
WHAT = "forward · adjoint = reverse"


def rows(e: Examination) -> list[Row]:
    """Return the rows: one a parameter."""
    subject = e.scene_subject
    if subject is None:
        return []
    chosen = [direction for _number, direction in e.telling()]
    adjoint = e.adjoints[:1]

    def draw(seed: int) -> np.ndarray:
        """Return derivatives (directions, 2) by forward and by reverse mode."""
        reverse = subject.gradients(adjoint, seed)
        found = []
        for d in chosen:
            image = subject.derivative(d.parameter, d.tangent, seed)
            found.append([float((adjoint[0] * image).sum()), float(d.along(reverse[d.parameter])[0])])
        return np.array(found)

    e.compile(draw)
    both = Sampler(draw, e.stream(NAME, 0))
    both.try_out(1)
    if not e.affords(both, NAME):
        return []
    both.try_out()
    return [
        compared_with_one(e, NAME, d.parameter, WHAT, both, ratios(scale, i, 0, 1))
        for i, d in enumerate(chosen)
        if (scale := size_of_sides(both, i, 0, 1)) > 0.0
    ]


def compared_with_one(
    e: Examination, check: str, parameter: str, what: str, sampler: Sampler, of_a: Callable[[np.ndarray], np.ndarray]
) -> Row:
    """Return a row that compares what batches of a sampler say with 1."""
    exact = Sampler(lambda seed: np.ones(1), e.stream(check, 1))
    exact.try_out()
    return Row(
        check=check,
        parameter=parameter,
        what=what,
        a=sampler,
        b=exact,
        of_a=of_a,
        of_b=lambda values: (values[:, 0], np.zeros(len(values))),
    )


def size_of_sides(sampler: Sampler, number: int, one: int, other: int) -> float:
    """Return the mean size of two sides of a direction in a pilot (n, directions, sides)."""
    return float(np.abs(np.stack(sampler.pilot)[:, number, [one, other]]).mean())


def ratios(scale: float, number: int, one: int, other: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return batches (n, directions, sides) -> 1 plus the difference of a direction's sides over a size, (n,)."""
    return lambda values: np.asarray(1.0 + (values[:, number, other] - values[:, number, one]) / scale)

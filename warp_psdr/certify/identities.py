"""Check 3: identities of derivatives, each from one gradient. Only those are here that find a planted defect.

Forward and reverse mode are transposes of each other: <w, J t> = <J^T w, t>. With equal random numbers both sides hold
the same samples, so that their difference has next to no noise: a factor on a gradient of reverse mode shows to a
thousandth. What both modes share cancels, and is for the other checks. (Moving everything together with the camera, and
a floor in its own plane, change nothing with or without a boundary term: such identities find no defect.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from warp_psdr.certify.directions import Direction
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

    return compared_sides(e, NAME, chosen, (WHAT,), draw)


def compared_sides(
    e: Examination, check: str, chosen: list[Direction], whats: Sequence[str], draw: Callable[[int], np.ndarray]
) -> list[Row]:
    """Return rows that compare derivatives of equal random numbers; none where there is no time for a test.

    Args:
        e: the examination.
        check: its name.
        chosen: directions.
        whats: what the sides after the first are.
        draw: seed -> derivatives (directions, 1 + sides). Each side is compared with the first: 1 plus their difference
            over the size of both, with 1.
    """
    e.compile(draw)
    sides = Sampler(draw, e.stream(check, 0))
    sides.try_out(1)
    if not e.affords(sides, check):
        return []
    sides.try_out()
    exact = Sampler(lambda seed: np.ones(1), e.stream(check, 1))
    exact.try_out()
    sizes = np.abs(np.stack(sides.pilot))
    return [
        Row(
            check=check,
            parameter=d.parameter,
            what=what,
            a=sides,
            b=exact,
            of_a=_ratios(i, side, size),
            of_b=lambda values: (values[:, 0], np.zeros(len(values))),
        )
        for i, d in enumerate(chosen)
        for side, what in enumerate(whats, 1)
        if (size := float(sizes[:, i, [0, side]].mean())) > 0.0
    ]


def _ratios(number: int, side: int, size: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return batches (n, directions, sides) -> 1 plus the difference of a direction's sides over their size, (n,)."""
    return lambda values: np.asarray(1.0 + (values[:, number, side] - values[:, number, 0]) / size)

"""Check 1: derivatives along directions against differences with equal random numbers on both sides.

A batch of differences holds images at two steps, h and 2h, all from one seed. The derivative is compared with
Richardson's extrapolation of the quotients, F(h) + (F(h) - F(2h)) / 3, which is off by at most 2/3 |F(h) - F(2h)|
whether the remainder of F is of first or of second order. That bound is a part of the error (``statistics.py``). The
step is the one of a ladder by which, as a pilot says, fewest batches decide: short steps are noisy, long ones inexact.
Steps that shorter ones contradict do not count. A bias has to show at steps an eighth as long, too.

Derivation: ``docs/theory/certificates.md#differences``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from warp_psdr.certify.directions import Direction
from warp_psdr.certify.examination import Examination, weighted
from warp_psdr.certify.spending import LEAST, LEAST_ROOM, PILOT, Row, Sampler, size_of
from warp_psdr.kernels.rng import mix_seed

NAME = "slope"
#: Steps in units of the direction; the last is only ever the shorter one of a pair.
LADDER = tuple(2.0**-k for k in range(7))
#: By how much steps are shorter that confirm a bias.
SHORTER = 1.0 / 8.0
#: Standard errors by which quotients of two steps differ where one contradicts the other: of five batches, two of a
#: hundred do so by chance.
CONTRADICTS = 4.0
#: Images that a direction takes at least, of its pilot and of its test.
LEAST_IMAGES = 2 * (PILOT * len(LADDER) + LEAST * 2)
#: Differences are relative to this share of the largest derivative of a parameter, of directions of equal size, at
#: least: a direction in which hardly anything changes says little about the gradient.
FLOOR = 0.1
#: A direction that a pilot did not see at all is not compared with less than this multiple of what it saw.
MOST_FLOOR = 1.0e6
#: Derivatives below so many of their standard errors do not stand out of a pilot's noise.
SEEN = 3.0


def rows(e: Examination) -> list[Row]:
    """Return the rows, one a direction."""
    found: list[Row] = []
    sizes: list[tuple[str, float, float]] = []
    for number, direction in enumerate(e.directions):
        ladder = Sampler(quotients(e, direction, LADDER), e.stream(NAME, number))
        ladder.try_out()
        pilot = np.stack(ladder.pilot)
        i, weights, size, error = chosen(pilot, e.tolerance)
        steps = LADDER[i - 1 : i + 1]
        sampler = Sampler(quotients(e, direction, steps), mix_seed(ladder.seed, 1))
        shorter = tuple(SHORTER * step for step in steps)
        sampler.pilot = list(pilot[:, i - 1 : i + 1])
        sampler.seconds, sampler.calls = ladder.seconds * 2.0 / len(LADDER), ladder.calls
        sizes.append((direction.parameter, size / float(np.linalg.norm(direction.tangent)), error))
        found.append(
            Row(
                check=NAME,
                parameter=direction.parameter,
                what=direction.what,
                a=e.base,
                b=sampler,
                of_a=weighted(number, weights),
                of_b=_of_pairs(weights),
                finer=Sampler(quotients(e, direction, shorter), mix_seed(ladder.seed, 2)),
            )
        )
    for row, (_name, size, _error) in zip(found, sizes, strict=True):
        of_parameter = [s for name, s, error in sizes if name == row.parameter and error <= 1.0 / SEEN]
        if size > 0.0 and of_parameter:
            row.floor = min(FLOOR * max(of_parameter) / size, MOST_FLOOR)
    return found


def quotients(e: Examination, direction: Direction, steps: tuple[float, ...]) -> Callable[[int], np.ndarray]:
    """Return seed -> quotients of differences (steps, K), all images from one seed."""
    return lambda seed: np.einsum("khwc,shwc->sk", e.adjoints, difference_images(e, direction, steps, seed))


def difference_images(e: Examination, direction: Direction, steps: tuple[float, ...], seed: int) -> np.ndarray:
    """Return quotients of differences of images (steps, H, W, 3), all of them from one seed."""
    base = e.subject.values[direction.parameter]
    images: dict[float, np.ndarray] = {}
    found = []
    for step in steps:
        total = np.zeros((*e.subject.shape, 3))
        for at, weight in direction.stencil:
            place = at * step
            if place not in images:
                moved = {} if place == 0.0 else {direction.parameter: base + place * direction.tangent}
                images[place] = e.subject.image(moved, seed)
            total = total + weight * images[place]
        found.append(total / step)
    return np.stack(found)


def _of_pairs(weights: np.ndarray) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Return batches (n, 2, K) of quotients -> derivatives and remainders, adjoints weighted."""
    return lambda values: extrapolated(values @ weights)


def extrapolated(pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Richardson's extrapolation of quotients (n, 2), the longer step first, and what it may lack."""
    change = pairs[:, 1] - pairs[:, 0]
    return pairs[:, 1] + change / 3.0, 2.0 / 3.0 * change


def chosen(pilot: np.ndarray, tolerance: float) -> tuple[int, np.ndarray, float, float]:
    """Return the shorter step's number, weights of the adjoints, and size and relative error of the derivative.

    Args:
        pilot: (n, steps, K) quotients.
        tolerance: of slopes.

    The weighted sum of the quotients at the chosen step is about 1.
    """
    best: tuple[float, int, np.ndarray, float, float] | None = None
    noise = 0.0
    for i in range(1, pilot.shape[1]):
        mean = pilot[:, i].mean(axis=0)
        size = float(np.linalg.norm(mean))
        if size == 0.0:
            continue
        weights = mean / size**2
        b, r = extrapolated(pilot[:, i - 1 : i + 1] @ weights)
        noise = max(noise, float(b.std(ddof=1)))  # it grows as steps become shorter; few batches may not show that
        room = max(tolerance - size_of(r), LEAST_ROOM * tolerance)
        score = (noise + size_of(r)) / room
        shorter = [extrapolated(pilot[:, j - 1 : j + 1] @ weights)[0] for j in range(i + 1, pilot.shape[1])]
        if any(_contradicts(other - b, r) for other in shorter):
            score = np.inf
        if best is None or score <= best[0]:
            best = score, i, weights, size, noise / float(np.sqrt(len(pilot)))
    if best is None:
        return pilot.shape[1] // 2, np.ones(pilot.shape[2]), 0.0, np.inf
    return best[1:]


def _contradicts(change: np.ndarray, remainder: np.ndarray) -> bool:
    """Return whether batches of a change exceed the remainder that was to bound it."""
    beyond = abs(float(change.mean())) - abs(float(remainder.mean()))
    return beyond > CONTRADICTS * float(change.std(ddof=1)) / np.sqrt(len(change))

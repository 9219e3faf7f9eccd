"""Slopes of two sets of batches: intervals, p-values of a bias beyond a tolerance, Holm's correction.

Batches a_i estimate a derivative by one method, batches b_j by another, independently. Batches r_j come with b_j and
tell a remainder: the mean of b is off by at most the size of the mean of r. The slope is rho = E a / E b. The contrast

    U(rho, s) = mean a - rho mean b - s mean r,    s = -1 or 1,

is linear in means of independent batches, so its standard error is known and a t-test applies (Welch's degrees of
freedom). No quotient of noisy numbers occurs. Intervals are Fieller's.

Derivation: ``docs/theory/certificates.md``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

#: Share of the sum of squares about the mean that one batch holds, from which on, in at least so many batches, tails
#: count as heavy: normal batches reach it in less than one set of a thousand.
STANDS_OUT, LEAST_STANDING = 0.75, 12


@dataclass(frozen=True)
class Slope:
    """A slope; 1 is right.

    Attributes:
        value: the quotient of the means.
        error: its standard error, for values below 1 the one at 1.
        low, high: the interval at the certificate's level, remainder included; infinite where the denominator does not
            stand out of its noise.
        remainder: of differences of finite steps, as a share of the derivative (part of the interval).
    """

    value: float
    error: float
    low: float
    high: float
    remainder: float = 0.0

    def within(self, tolerance: float) -> bool:
        """Whether the interval lies inside of 1 +- tolerance."""
        return 1.0 - tolerance <= self.low and self.high <= 1.0 + tolerance


@dataclass(frozen=True)
class Batches:
    """What is compared.

    Attributes:
        a: (n,) batches of the derivative that is examined.
        b: (m,) batches of what it is compared with.
        r: (m,) batches of the remainder of ``b``.
        floor: least size of the mean of ``b`` that differences are relative to.
    """

    a: np.ndarray
    b: np.ndarray
    r: np.ndarray
    floor: float = 0.0

    @property
    def seen(self) -> bool:
        """Whether any batch is not zero."""
        return bool(np.any(self.a) or np.any(self.b))

    @property
    def heavy(self) -> bool:
        """Whether one batch holds most of the variance of its side: errors are then not to be trusted."""
        return any(_stands_out(x) for x in (self.a, self.b))

    def _parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (a, x, y) of the contrast mean a - mean x - rho mean y, with a positive mean of y."""
        sign = -1.0 if self.b.mean() < 0.0 else 1.0
        a, b = sign * self.a, sign * self.b
        if b.mean() >= self.floor:
            return a, np.zeros_like(b), b
        return a, b - self.floor, np.full_like(b, self.floor)  # slope 1 + (E a - E b) / floor

    def contrast(self, rho: float, s: float) -> tuple[float, float, float]:
        """Return mean, standard error and degrees of freedom of U(rho, s)."""
        a, x, y = self._parts()
        z = x + rho * y + s * self.r
        of_a, of_z = a.var(ddof=1) / len(a), z.var(ddof=1) / len(z)
        total = of_a + of_z
        freedom = total**2 / (of_a**2 / (len(a) - 1) + of_z**2 / (len(z) - 1)) if total > 0.0 else math.inf
        return float(a.mean() - z.mean()), math.sqrt(total), float(freedom)

    def p_value(self, tolerance: float) -> float:
        """Return the p-value of the hypothesis that the slope is 1 within a tolerance and the remainder."""
        above = max(_beyond(*self.contrast(1.0 + tolerance, s)) for s in (-1.0, 1.0))
        below = max(_beyond(-mean, error, freedom) for mean, error, freedom in self._contrasts(1.0 - tolerance))
        return min(1.0, 2.0 * min(above, below))

    def _contrasts(self, rho: float) -> list[tuple[float, float, float]]:
        return [self.contrast(rho, s) for s in (-1.0, 1.0)]

    def slope(self, level: float) -> Slope:
        """Return the slope and Fieller's interval at a level, widened by the remainder on both sides."""
        a, x, y = self._parts()
        if y.mean() == 0.0:
            return Slope(math.nan, math.inf, -math.inf, math.inf)
        value = float((a.mean() - x.mean()) / y.mean())
        # For slopes below 1 the error that it would have at 1: where the denominator is noise, the slope is small.
        _mean, error, _freedom = self.contrast(max(1.0, abs(value)), 0.0)
        remainder = float(abs(self.r.mean()) / y.mean())
        low, high = math.inf, -math.inf
        for s in (-1.0, 1.0):
            _mean, _error, freedom = self.contrast(1.0, s)
            ends = _fieller(a, x + s * self.r, y, float(stats.t.isf(0.5 - 0.5 * level, freedom)))
            low, high = min(low, ends[0]), max(high, ends[1])
        return Slope(value, float(error / y.mean()), low, high, remainder)


def _stands_out(x: np.ndarray) -> bool:
    squares = (x - x.mean()) ** 2
    return len(x) >= LEAST_STANDING and bool(squares.max() > STANDS_OUT * squares.sum() > 0.0)


def _beyond(mean: float, error: float, freedom: float) -> float:
    """Return the probability of a mean as large as this one where the true one is zero or less."""
    if error == 0.0:
        return 0.0 if mean > 0.0 else 1.0
    return float(stats.t.sf(mean / error, freedom))


def _fieller(a: np.ndarray, x: np.ndarray, y: np.ndarray, factor: float) -> tuple[float, float]:
    """Return the ends of {rho: |mean a - mean x - rho mean y| <= factor times its standard error}."""
    covariance = np.cov(np.stack([x, y])) / len(x)
    d = a.mean() - x.mean()
    f2 = factor**2
    # (d - rho y)^2 - f^2 (var a + var x + 2 rho cov + rho^2 var y) <= 0
    square = y.mean() ** 2 - f2 * covariance[1, 1]
    half = d * y.mean() + f2 * covariance[0, 1]
    rest = d**2 - f2 * (a.var(ddof=1) / len(a) + covariance[0, 0])
    if square <= 0.0:
        return -math.inf, math.inf
    root = math.sqrt(max(half**2 - square * rest, 0.0))
    return float((half - root) / square), float((half + root) / square)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for their number by Holm's step-down method: one at most alpha rejects at level alpha.

    The probability that any true hypothesis is rejected is at most alpha, whatever the dependence.
    """
    count, largest = len(p_values), 0.0
    adjusted = [0.0] * count
    for rank, i in enumerate(sorted(range(count), key=lambda i: p_values[i])):
        largest = max(largest, min(1.0, (count - rank) * p_values[i]))
        adjusted[i] = largest
    return adjusted

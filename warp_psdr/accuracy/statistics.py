"""Variances of batches, and their own uncertainty.

The file holds the unbiased variance of batches, the squared norm without its noise, the error over parameters of
different units, and jackknife spreads of all of these.

Derivation: ``docs/theory/accuracy.md#variances-of-batches``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

#: A squared norm counts as seen when it exceeds its standard error by this factor.
SEEN = 2.0


@dataclass(frozen=True)
class Moments:
    """Variances and squared norms, of all batches and with each of them left out.

    Attributes:
        batches: B.
        variance: (terms, blocks), V of one batch.
        variance_without: (B, terms, blocks).
        squares: (terms, blocks), the sum of the squared variances of the components: normal components, were they
            independent, would tell V with the relative variance 2 squares / (B V^2); those that are not tell it worse.
        norm2: (blocks,), |g|^2 without the noise's share; may be negative where there is nothing but noise.
        norm2_without: (B, blocks).
        largest: (terms,), the largest share that one batch has in the sum of squares about the mean, of any block; some
            1 / B where no batch stands out.
        kurtosis: (terms,), mean |x_b - m|^4 over the square of mean |x_b - m|^2, of the block where it is largest: some
            3 for one normal component, less for several; large where rare samples carry the variance.
    """

    batches: int
    variance: np.ndarray
    variance_without: np.ndarray
    squares: np.ndarray
    norm2: np.ndarray
    norm2_without: np.ndarray
    largest: np.ndarray
    kurtosis: np.ndarray

    @property
    def variance_error(self) -> np.ndarray:
        """Standard errors of ``variance``."""
        return jackknife(self.variance_without)

    @property
    def norm2_error(self) -> np.ndarray:
        """Standard errors of ``norm2``."""
        return jackknife(self.norm2_without)

    @property
    def seen(self) -> np.ndarray:
        """Blocks whose gradient stands out of its noise."""
        return self.norm2 > SEEN * self.norm2_error


def moments(batches: list[list[np.ndarray]], blocks: list[slice]) -> Moments:
    """Return the moments of batches.

    Args:
        batches: for every term its B batches, (D,) each.
        blocks: components that belong together.
    """
    terms, count = len(batches), len(batches[0])
    variance, largest, kurtosis = np.zeros((terms, len(blocks))), np.zeros(terms), np.zeros(terms)
    variance_without, of_components = np.zeros((count, terms, len(blocks))), np.zeros((terms, len(blocks)))
    norm2, norm2_without = np.zeros(len(blocks)), np.zeros((count, len(blocks)))
    for p, block in enumerate(blocks):
        total = np.zeros((count, block.stop - block.start))
        for k, of_term in enumerate(batches):
            x = np.array([batch[block] for batch in of_term], np.float64)
            total += x
            deviations2 = (x - x.mean(axis=0)) ** 2
            squares = deviations2.sum(axis=1)
            variance[k, p] = squares.sum() / (count - 1)
            of_components[k, p] = squared(deviations2.sum(axis=0) / (count - 1))
            shares = squares / max(squares.sum(), 1e-300)
            largest[k] = max(largest[k], shares.max())
            kurtosis[k] = max(kurtosis[k], count * (shares**2).sum())
            # Without batch b the sum of squares about the mean falls by B/(B-1) |x_b - m|^2.
            without = squares.sum() - count / (count - 1) * squares
            variance_without[:, k, p] = np.maximum(without, 0.0) / max(count - 2, 1)
        mean = total.mean(axis=0)
        length2 = squared(mean)
        norm2[p] = length2 - variance[:, p].sum() / count
        rest = count * (count * length2 - 2.0 * (total * mean).sum(axis=1)) + (total**2).sum(axis=1)
        rest /= (count - 1) ** 2
        norm2_without[:, p] = rest - variance_without[:, :, p].sum(axis=1) / (count - 1)
    return Moments(count, variance, variance_without, of_components, norm2, norm2_without, largest, kurtosis)


def pooled(found: Moments, second: list[Moments | None], scale: np.ndarray, weight: float) -> Moments:
    """Return the moments of batches whose variance batches of another size tell, too.

    Where rare samples carry the variance, as many samples tell as much in few batches as in many; where batches are
    normal, as many batches do. A weight in between loses little of either. Standard errors are those of normal batches.

    Args:
        found: of the batches.
        second: of those of the other size, a term each; None: there are none.
        scale: (terms,), by which the variance of a batch exceeds that of the other size.
        weight: of a batch of the other size, in batches.
    """
    variance, without, squares = found.variance.copy(), found.variance_without.copy(), found.squares.copy()
    for k, other in enumerate(second):
        if other is not None:
            own = found.batches / (found.batches + weight * other.batches)
            variance[k] = own * found.variance[k] + (1.0 - own) * scale[k] * other.variance[0]
            met = found.variance[k] > 0.0
            squares[k, met] *= (variance[k, met] / found.variance[k, met]) ** 2
            change = found.variance_without[:, k] - found.variance[k]
            less = math.sqrt(own**2 + (1.0 - own) ** 2 * found.batches / other.batches)
            without[:, k] = np.maximum(variance[k] + less * change, 0.0)
    return replace(found, variance=variance, variance_without=without, squares=squares)


def squared(x: np.ndarray) -> float:
    """Return |x|^2, without the threads with which a dot product of this size may be computed: they would be timed."""
    return float(np.square(x).sum())


def jackknife(without: np.ndarray) -> np.ndarray:
    """Return the standard error of a statistic from its values with each batch left out, (B, ...)."""
    count = len(without)
    return np.sqrt((count - 1) / count * ((without - without.mean(axis=0)) ** 2).sum(axis=0))


def relative_variance(variance: np.ndarray, norm2: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return (..., terms): the mean over the blocks that are seen of variance over squared norm.

    Args:
        variance: (..., terms, blocks).
        norm2: (..., blocks).
        seen: (blocks,).
    """
    return (variance[..., seen] / np.maximum(norm2[..., None, seen], 1e-300)).mean(axis=-1)


class Running:
    """Sums over batches of one term that are not kept.

    Attributes:
        count: batches so far.
        total: of the raw batches.
        sums: of the components.
        squares: (blocks,), sums of squared components.
    """

    def __init__(self, blocks: list[slice]):
        self._blocks = blocks
        self.count = 0
        self.total: np.ndarray | float = 0.0
        self.sums: np.ndarray | float = 0.0
        self.squares = np.zeros(len(blocks))

    def add(self, raw: np.ndarray, components: np.ndarray) -> None:
        """Add a batch: as it came, and its components (``Quantity.finish``)."""
        self.count += 1
        self.total = self.total + raw
        self.sums = self.sums + components
        self.squares += [squared(components[block]) for block in self._blocks]

    def merge(self, more: Running) -> None:
        """Add the batches of another one."""
        self.count += more.count
        self.total = self.total + more.total
        self.sums = self.sums + more.sums
        self.squares = self.squares + more.squares

    def variance(self) -> np.ndarray:
        """Return (blocks,): V of one batch; zeros of fewer than two."""
        if self.count < 2:
            return np.zeros(len(self._blocks))
        sums = np.asarray(self.sums)
        about = np.array([squared(sums[block]) for block in self._blocks]) / self.count
        return np.maximum(self.squares - about, 0.0) / (self.count - 1)

"""Distributions for the sampling of lights, as cumulative arrays for ``kernels/distribution.py``.

Cumulative values are multiples of 2^-24, like the random numbers. An entry is therefore drawn exactly with the
probability ``cdf[i + 1] - cdf[i]`` that the device reads, and an entry of positive weight, however small, keeps a
probability of at least 2^-24.
"""

from __future__ import annotations

import numpy as np

from warp_psdr.kernels.distribution import LEVELS
from warp_psdr.scene.materials.spectra import LUMINANCE

#: Share of all samples that is uniform over the sphere: black regions have derivatives, and light behind corners.
UNIFORM_SPHERE = 0.05
#: The same where scattering finds light, too.
UNIFORM_COMPENSATED = 0.002
#: What is taken off a map where scattering finds light, too, over its mean: the first that leaves LEAST of its light.
COMPENSATIONS, LEAST = (1.0, 0.75, 0.5, 0.25), 1.0 / 3.0


def cumulative(weights: np.ndarray) -> np.ndarray:
    """Return the normalised cumulative sums of ``weights`` along the last axis.

    Args:
        weights: non-negative, finite, shape ``(..., n)`` with n < 2^24. Rows without any weight become uniform.

    Returns:
        float32, shape ``(..., n + 1)``, from exactly 0 to exactly 1.

    Raises:
        ValueError: a weight is negative, NaN or infinite, or n is out of range.
    """
    weights = np.asarray(weights, dtype=np.float64)
    count = weights.shape[-1] if weights.ndim else 0
    if not 0 < count < LEVELS:
        raise ValueError(
            f"got weights of shape {weights.shape}; expected 1 to {LEVELS - 1} entries along the last axis"
        )
    # Scaled by the largest first: the sum of large weights cannot overflow.
    largest = weights.max(axis=-1, keepdims=True)
    if not (weights.min(initial=0.0) >= 0.0 and largest.max(initial=0.0) < np.inf):  # nor NaN
        raise ValueError("got a negative, NaN or infinite weight; weights must be finite and non-negative")
    p = weights / np.where(largest > 0.0, largest, 1.0)
    p[largest[..., 0] <= 0.0] = 1.0
    if p.min(initial=1.0) < np.finfo(np.float64).tiny:  # nor do the least vanish in the next line
        np.maximum(p, np.finfo(np.float64).tiny, out=p, where=p > 0.0)
    p /= p.sum(axis=-1, keepdims=True)
    sums = np.cumsum(_lifted(p), axis=-1)
    # floor(x + 1/2) grows by at least one level where x does. Divided by the last sum, which rounding keeps off 1.
    sums *= LEVELS / sums[..., -1:]
    sums += 0.5
    levels = np.minimum(np.floor(sums, out=sums), LEVELS, out=sums)
    out = np.zeros((*weights.shape[:-1], count + 1), dtype=np.float32)
    out[..., 1:] = levels / LEVELS
    return out


def guide(cdf: np.ndarray) -> np.ndarray:
    """Return a guide to the search in each row of cumulative values (``kernels/distribution.py``).

    Args:
        cdf: as `cumulative` returns them, shape ``(..., n + 1)``.

    Returns:
        int64, shape ``(..., m + 1)``, m the greatest power of two up to n: the entries that hold 0, 1/m, 2/m, ... and
        the last one.
    """
    count = cdf.shape[-1] - 1
    buckets = 1 << (count.bit_length() - 1)
    rows = cdf.reshape(-1, count + 1)
    # The first b whose b / m lies behind an entry: as many entries lie before a bucket as have one up to it.
    ends = np.ceil(rows[:, 1:].astype(np.float64) * buckets).astype(np.int64)
    ends += (buckets + 1) * np.arange(len(rows))[:, None]
    passed = np.bincount(ends.reshape(-1), minlength=len(rows) * (buckets + 1)).reshape(len(rows), buckets + 1)
    found = np.minimum(np.cumsum(passed, axis=1), count - 1)
    return found.reshape(*cdf.shape[:-1], buckets + 1)


def with_guide(cdf: np.ndarray) -> np.ndarray:
    """Return the flat cumulative values, and behind them the number of buckets and the guides of all rows."""
    found = guide(cdf)
    return np.concatenate([cdf.reshape(-1), [found.shape[-1] - 1], found.reshape(-1)]).astype(np.float32)


def _lifted(p: np.ndarray) -> np.ndarray:
    """Raise positive probabilities to at least one level and scale the others down to keep the sum at one."""
    # A hair above one level, so that rounding in the cumulative sum cannot lose it.
    unit = (1.0 + 1e-6) / LEVELS
    if p.min(initial=1.0) >= unit and (p.sum(axis=-1) <= 1.0).all():
        return p
    scale = np.ones((*p.shape[:-1], 1))
    while True:
        small = (p > 0.0) & (p * scale < unit)
        rest = np.where(small, 0.0, p).sum(axis=-1, keepdims=True)
        left = 1.0 - unit * small.sum(axis=-1, keepdims=True)
        lower = np.minimum(scale, np.where(rest > 0.0, left / np.where(rest > 0.0, rest, 1.0), 1.0))
        # The set of small entries only grows, so this ends after as many rounds as it grows; usually one or two.
        if np.all(lower == scale):
            return np.where(small, unit, p * scale)
        scale = lower


def build_env_distribution(data: np.ndarray, compensated: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return the cumulative arrays from which an environment map is sampled.

    Args:
        data: texels, shape ``(H, W, C)``, H >= 2. Negative values count as black.
        compensated: for light that scattered rays look for as well. These find what is dim, so the map's
            mean is taken off [KSV*19]. It takes less off a map without contrast, of which little would be left.

    Returns:
        ``marginal`` over the rows of cells, shape ``(H,)``, and ``conditional`` over the cells of each row, shape
        ``(H - 1, W + 1)``; float32. The weight of a cell is the mean luminance of its corners (of one or two channels:
        their mean) times its solid angle, plus a uniform share.

    Raises:
        ValueError: wrong shape, or a texel is NaN or infinite.
    """
    data = np.asarray(data)
    if data.ndim != 3 or data.shape[0] < 2 or data.shape[1] < 1 or data.shape[2] < 1:
        raise ValueError(f"got an environment map of shape {data.shape}; expected (H, W, C) with at least two rows")
    if not np.all(np.isfinite(data)):
        raise ValueError("got an environment map with NaN or infinite texels; replace them before rendering")
    height, width = data.shape[:2]
    grey = data.astype(np.float64) @ LUMINANCE if data.shape[2] == 3 else data.mean(axis=2, dtype=np.float64)
    brightness = np.maximum(grey, 0.0)
    pairs = brightness + np.roll(brightness, -1, axis=1)
    corners = pairs[:-1] + pairs[1:]
    theta = np.linspace(0.0, np.pi, height)
    # cos a - cos b as a product: exact for the thin rows at the poles.
    solid_angle = 2.0 * np.sin(0.5 * (theta[1:] + theta[:-1])) * np.sin(0.5 * (theta[1:] - theta[:-1]))
    uniform = np.broadcast_to(solid_angle[:, None] / (2.0 * width), corners.shape)
    weights = corners * solid_angle[:, None]
    total = weights.sum()
    if compensated:
        mean = total / (width * solid_angle.sum()) * solid_angle[:, None]
        for part in COMPENSATIONS:
            left = np.maximum(weights - part * mean, 0.0)
            if left.sum() >= LEAST * total:
                weights, total = left, left.sum()
                break
    if total > 0.0:
        share = UNIFORM_COMPENSATED if compensated else UNIFORM_SPHERE
        weights = (1.0 - share) * weights / total + share * uniform
    else:
        weights = uniform
    return cumulative(weights.sum(axis=1)), cumulative(weights)

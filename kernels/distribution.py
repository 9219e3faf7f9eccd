"""Discrete distributions as cumulative arrays: `cumulative` on the host, `find_interval` on the device.

Cumulative values are multiples of 2^-24, like the random numbers (``kernels/rng.py``). So an entry is drawn exactly
with the probability ``cdf[i + 1] - cdf[i]`` that the device reads (that difference has no rounding error), and an
entry of positive weight, however small, keeps a probability of at least 2^-24.
"""

import numpy as np
import warp as wp

from warp_psdr.kernels.constants import ONE_MINUS_EPSILON

#: 2^24, the number of distinct random numbers in [0, 1).
LEVELS = 1 << 24


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
    if not np.all(np.isfinite(weights)) or np.any(weights < 0.0):
        raise ValueError("got a negative, NaN or infinite weight; weights must be finite and non-negative")
    # Scaled by the largest first: the sum of large weights cannot overflow.
    largest = weights.max(axis=-1, keepdims=True)
    p = np.where(largest > 0.0, weights / np.where(largest > 0.0, largest, 1.0), 1.0)
    p = p / p.sum(axis=-1, keepdims=True)
    sums = np.cumsum(_lifted(p), axis=-1)
    # floor(x + 1/2) grows by at least one level where x does. Divided by the last sum, which rounding keeps off 1.
    levels = np.minimum(np.floor(sums * (LEVELS / sums[..., -1:]) + 0.5), LEVELS)
    out = np.zeros((*weights.shape[:-1], count + 1), dtype=np.float32)
    out[..., 1:] = levels / LEVELS
    return out


def _lifted(p: np.ndarray) -> np.ndarray:
    """Raise positive probabilities to at least one level and scale the others down to keep the sum at one."""
    # A hair above one level, so that rounding in the cumulative sum cannot lose it.
    unit = (1.0 + 1e-6) / LEVELS
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


@wp.func
def find_interval(cdf: wp.array(dtype=wp.float32), first: wp.int32, count: wp.int32, u: wp.float32) -> wp.int32:
    """Return the entry i in [0, count) with cdf[first + i] <= u < cdf[first + i + 1].

    Never an entry of probability zero. ``u`` lies in [0, 1) and is clamped to it.
    """
    v = wp.clamp(u, 0.0, ONE_MINUS_EPSILON)
    low = wp.int32(0)
    high = wp.int32(count)
    while high - low > 1:
        middle = (low + high) // 2
        if cdf[first + middle] <= v:
            low = middle
        else:
            high = middle
    return low

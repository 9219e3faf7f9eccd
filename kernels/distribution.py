"""Sampling of discrete distributions that are given as cumulative arrays.

Cumulative values are multiples of 2^-24, like the random numbers (``kernels/rng.py``). So an entry is drawn exactly
with the probability ``cdf[i + 1] - cdf[i]`` that the device reads (that difference has no rounding error).
"""

import warp as wp

from warp_psdr.kernels.constants import ONE_MINUS_EPSILON

#: 2^24, the number of distinct random numbers in [0, 1).
LEVELS = 1 << 24


@wp.func
def find_interval(cdf: wp.array(dtype=wp.float32), first: wp.int32, count: wp.int32, u: wp.float32) -> wp.int32:
    """Return the entry i in [0, count) with cdf[first + i] <= u < cdf[first + i + 1].

    Never an entry of probability zero. ``u`` lies in [0, 1) and is clamped to it.
    """
    # No branch depends on the data: mispredicted ones would take most of the time.
    v = wp.clamp(u, 0.0, ONE_MINUS_EPSILON)
    low = wp.int32(0)
    length = wp.int32(count)
    while length > 1:
        half = length // 2
        low = wp.where(cdf[first + low + half] <= v, low + half, low)
        length -= half
    return low


@wp.func
def stratified_entry(
    cdf: wp.array(dtype=wp.float32),
    entries: wp.array(dtype=wp.int32),
    sample: wp.int32,
    samples: wp.int32,
    jitter: wp.float32,
) -> tuple[wp.int32, wp.float32]:
    """Draw one of the entries, stratified over the samples; return it and its probability."""
    u = wp.float32((wp.float64(sample) + wp.float64(jitter)) / wp.float64(samples))
    i = find_interval(cdf, 0, entries.shape[0], u)
    return entries[i], cdf[i + 1] - cdf[i]


@wp.func
def find_interval_64(cdf: wp.array(dtype=wp.float32), first: wp.int32, count: wp.int32, u: wp.float64) -> wp.int32:
    """``find_interval`` for a number in double precision, whose position within the entry is needed."""
    v = wp.clamp(u, wp.float64(0.0), wp.float64(0.9999999999999999))
    low = wp.int32(0)
    high = wp.int32(count)
    while high - low > 1:
        middle = (low + high) // 2
        if wp.float64(cdf[first + middle]) <= v:
            low = middle
        else:
            high = middle
    return low

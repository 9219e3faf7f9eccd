"""Sampling of discrete distributions that are given as cumulative arrays.

Cumulative values are multiples of 2^-24, like the random numbers (``kernels/rng.py``). An entry is therefore drawn
exactly with the probability ``cdf[i + 1] - cdf[i]`` that the device reads, since this difference has no rounding error.

A *guide* shortens the search [Chen and Asau 1974, On Generating Random Variates from an Empirical Distribution]. It has
n buckets, and the b-th holds the entry of b / n. A number u in [b / n, (b + 1) / n) lies between the entries of two
neighbouring buckets, ends included. n is a power of two, so n u and its integer part are exact, and the guide finds
what the whole search finds. A guide lies behind the array's cumulative values: n, then the entries of n + 1 buckets.
"""

import warp as wp

from warp_psdr.kernels.constants import ONE_MINUS_EPSILON
from warp_psdr.kernels.reading import load_float

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
def bucket_of(buckets: wp.int32, u: wp.float32) -> wp.int32:
    """Bucket of a number in [0, 1)."""
    return wp.int32(wp.float32(buckets) * u)


@wp.func
def find_guided(
    cdf: wp.array(dtype=wp.float32), first: wp.int32, guide: wp.int32, buckets: wp.int32, u: wp.float32
) -> wp.int32:
    """``find_interval`` with the guide whose buckets start at ``guide``."""
    v = wp.clamp(u, 0.0, ONE_MINUS_EPSILON)
    at = guide + bucket_of(buckets, v)
    low = wp.int32(load_float(cdf, at))
    return low + find_interval(cdf, first + low, wp.int32(load_float(cdf, at + 1)) - low + 1, v)


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

"""Worker threads: a launch is split into fixed shards, and idle workers take the next shard.

Warp's CPU launches run on one thread and release the interpreter lock, so threads scale with the cores. The split
into shards does not depend on the number of workers, and every shard accumulates into a gradient buffer of its own, so
results are the same bit for bit for any number of workers.
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait

import numpy as np

from warp_psdr import forks

#: Lanes of a launch. More shards balance better and scale to more cores, fewer need fewer gradient buffers.
SHARDS = 16
#: The shards' buffers together hold at most this many numbers (128 MB of gradients).
SHARD_FLOATS = 1 << 24
#: Pixels of one launch: small enough to balance, large enough to hide the launch (10 us).
MIN_CHUNK, MAX_CHUNK = 64, 4096

_workers = 0
_pool: ThreadPoolExecutor | None = None


def set_workers(n: int | None) -> None:
    """Set the number of worker threads for CPU rendering.

    Args:
        n: threads; None: one for every core that this process may use (the default).

    Raises:
        ValueError: ``n`` is not a positive integer.
    """
    global _workers, _pool
    if n is not None and (isinstance(n, bool) or not isinstance(n, int) or n < 1):
        raise ValueError(f"workers: got {n!r}, expected a positive integer, or None for all cores")
    if _pool is not None:
        _pool.shutdown()
        _pool = None
    _workers = n or 0


def workers() -> int:
    """Return the number of worker threads in use."""
    if _workers:
        return _workers
    if hasattr(os, "sched_getaffinity"):  # the cores that this process may use; not on every system
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_shards(shard: Callable[[int], None], shards: int) -> None:
    """Call ``shard(i)`` for every i below ``shards`` on the worker threads and wait for all; an error is raised."""
    global _pool
    n = min(workers(), shards)
    if n <= 1:
        for i in range(shards):
            shard(i)
        return
    if _pool is None:
        _pool = ThreadPoolExecutor(workers(), thread_name_prefix="warp_psdr")
    futures = [_pool.submit(shard, i) for i in range(shards)]
    wait(futures)  # also after an error: the others write into buffers that the caller holds
    for future in futures:
        future.result()


def shard_count(floats: int) -> int:
    """Return how many shards a launch with gradient buffers of ``floats`` values gets; independent of the workers."""
    return max(2, min(SHARDS, SHARD_FLOATS // max(floats, 1)))


def chunks(pixels: int, shards: int, least: int = MIN_CHUNK) -> list[list[tuple[int, int]]]:
    """Split ``pixels`` into launches (first, count) and deal them out to shards in turn.

    ``least``: so many in each, as long as every shard gets some.
    """
    size = min(max(pixels // (4 * shards), MIN_CHUNK, min(least, math.ceil(pixels / shards))), MAX_CHUNK)
    result: list[list[tuple[int, int]]] = [[] for _ in range(shards)]
    for i, first in enumerate(range(0, pixels, size)):
        result[i % shards].append((first, min(size, pixels - first)))
    return result


@functools.lru_cache(maxsize=32)
def pixel_order(width: int, height: int) -> np.ndarray:
    """Return all pixel numbers (row * width + column) along a Morton curve.

    Pixels that are rendered one after the other are neighbours, so their rays visit the same nodes.
    """
    y, x = np.mgrid[0:height, 0:width].astype(np.uint64)
    code = np.zeros_like(x)
    for bit in range(16):
        one = np.uint64(1)
        code |= ((x >> np.uint64(bit)) & one) << np.uint64(2 * bit)
        code |= ((y >> np.uint64(bit)) & one) << np.uint64(2 * bit + 1)
    return np.argsort(code.reshape(-1), kind="stable").astype(np.int32)


@forks.in_child
def _forget_threads() -> None:
    """Forget the pool: a forked process has none of its threads, and would wait for them for ever."""
    global _pool
    _pool = None

"""Worker threads: a launch is split into fixed shards, and idle workers take the next shard.

Warp's CPU launches run on one thread and release the interpreter lock, so threads scale with the cores. The split
into shards does not depend on the number of workers. Every shard adds to sums of its own, and these are added pairwise,
in a binary tree by the shards' numbers. Results are therefore the same bit for bit for any number of workers, and also
where other processes run some of the shards (``Share``): a share is a node of the tree.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr import forks

if TYPE_CHECKING:
    import warp as wp

#: Shards of a launch, a power of two. More shards balance better and scale to more cores and processes.
SHARDS = 64
#: Numbers that the sums of ``SHARDS`` shards hold together at most, and those of ``FEWER`` (128 MB of gradients):
#: beyond, there are fewer shards.
SHARD_NUMBERS, FEWER_NUMBERS, FEWER = 1 << 22, 1 << 24, 16
#: Launches of a pass, about, and pixels of one: small enough to balance, large enough to hide the launch (10 us).
LAUNCHES, MIN_CHUNK, MAX_CHUNK = 64, 64, 4096
#: (first item, number of items) of every launch of a shard.
Chunks = list[tuple[int, int]]


@dataclass(frozen=True)
class Share:
    """One of equal parts of a pass: some of its shards.

    Attributes:
        number: of the part.
        parts: how many there are, a power of two; more than shards: some parts are empty.
    """

    number: int = 0
    parts: int = 1

    def of(self, shards: int) -> range:
        """Return the shards, of a power of two, that belong to the part."""
        first, stop = (-(-n * shards // self.parts) for n in (self.number, self.number + 1))
        return range(first, stop)

    def stretch(self, items: int) -> tuple[int, int]:
        """Return the first item and the number of those that belong to the part where there is one shard, on CUDA."""
        first, stop = (n * items // self.parts for n in (self.number, self.number + 1))
        return first, stop - first


#: All shards.
WHOLE = Share()

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


def run_shards(shard: Callable[[int], None], shards: range) -> None:
    """Call ``shard(i)`` for every shard of a range on the worker threads and wait for all; an error is raised."""
    global _pool
    n = min(workers(), len(shards))
    if n <= 1:
        for i in shards:
            shard(i)
        return
    if _pool is None:
        _pool = ThreadPoolExecutor(workers(), thread_name_prefix="warp_psdr")
    futures = [_pool.submit(shard, i) for i in shards]
    wait(futures)  # also after an error: the others write into buffers that the caller holds
    for future in futures:
        future.result()


def shard_count(numbers: int) -> int:
    """Return how many shards a launch gets, each of which sums up so many numbers: a power of two, two or more."""
    numbers = max(numbers, 1)
    return below(max(2, min(FEWER, FEWER_NUMBERS // numbers), min(SHARDS, SHARD_NUMBERS // numbers)))


def below(number: int) -> int:
    """Return the largest power of two that is not above a positive number."""
    return 1 << (number.bit_length() - 1)


def chunks(items: int, shards: int, least: int = MIN_CHUNK) -> list[Chunks]:
    """Split items into launches and deal them out to shards in turn; ``least``: so many in each, if there are."""
    size = min(max(items // LAUNCHES, MIN_CHUNK, least), MAX_CHUNK)
    firsts = range(0, items, size)
    result: list[Chunks] = [[] for _ in range(shards)]
    for i, first in enumerate(firsts):
        shard = i % shards if len(firsts) >= shards else i * shards // len(firsts)
        result[shard].append((first, min(size, items - first)))
    return result


def even_chunks(items: int) -> list[Chunks]:
    """Return one launch for every worker, for what does not depend on the split."""
    size = max(-(-items // workers()), MIN_CHUNK)
    return [[(first, min(size, items - first))] for first in range(0, items, size)]


def stretches(ends: np.ndarray) -> list[Chunks]:
    """Return the launches of shards that each take the items from the end of the one before to their own."""
    result = []
    for first, stop in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True):
        result.append([(i, min(MAX_CHUNK, stop - i)) for i in range(first, stop, MAX_CHUNK)])
    return result


def tree_sum(lanes: wp.array) -> wp.array:
    """Return the sum over the first axis, a power of two long, added pairwise; it overwrites what it is given."""
    if lanes.shape[0] > 1:  # never on CUDA
        add_pairs(lanes.numpy())
    return lanes[0]


def add_pairs(lanes: np.ndarray) -> np.ndarray:
    """Return the sum over the first axis, as ``tree_sum``."""
    stride = 1
    while stride < len(lanes):
        lanes[:: 2 * stride] += lanes[stride :: 2 * stride]
        stride *= 2
    return lanes[0]


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

"""Kernel launches of the library's own, which a user's tape must not record."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_psdr import compiler, workers


def active_tape() -> wp.Tape | None:
    """Return the tape in whose ``with`` block the program is; None: in none."""
    runtime = wp._src.context.runtime  # Warp 1.19 has no public name for it
    return None if runtime is None else runtime.tape


def launch(kernel: wp.Kernel, dim, inputs: list, outputs: list, device) -> None:
    """Launch a kernel without recording it on the tape that may be active."""
    compiler.ensure([kernel], device)
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, record_tape=False)


def shared_copy(record: Any) -> Any:
    """Return a copy of a kernel's record whose own members can be set anew; it shares the arrays.

    ``record.to(device)`` goes member by member, which takes .12 ms of a scene, for each shard of each term. Members of
    nested records are not to be set through it.
    """
    copy = object.__new__(type(record))
    copy.__dict__.update(record.__dict__)
    copy.__dict__["_ctype"] = type(record._ctype).from_buffer_copy(record._ctype)
    return copy


def move_on(record: Any, name: str, step: int) -> None:
    """Let an array of a record of one's own begin so many bytes later; slices of Warp arrays take ten times as long."""
    getattr(record._ctype, name).data += step


def launch_shards(
    kernel: wp.Kernel,
    count: int,
    arguments: Callable[[int, int, int], tuple[list, list]],
    *,
    shards: int,
    device,
    progress: Callable[[float], None] | None = None,
    least: int = workers.MIN_CHUNK,
    share: workers.Share = workers.WHOLE,
    chunks: list[workers.Chunks] | None = None,
) -> None:
    """Run a kernel over items: in one launch on CUDA, in shards on the worker threads on the CPU.

    Args:
        kernel: one thread an item.
        count: number of items.
        arguments: (first item, number of items, shard) -> inputs and outputs. Launches of different shards run side by
            side, so they must not write to the same place.
        shards: on the CPU; independent of the number of workers.
        device: Warp device.
        progress: called with the finished fraction, by one worker at a time; not on CUDA.
        least: items of a launch, if there are so many.
        share: which of the shards are run.
        chunks: the launches of every shard; None: the items are dealt out in turn.
    """
    compiler.ensure([kernel], device)
    if not device.is_cpu:
        first, own = share.stretch(count)
        if own:
            launch(kernel, own, *arguments(first, own, 0), device)
        return
    dealt = workers.chunks(count, shards, least) if chunks is None else chunks
    run = share.of(shards)
    items = sum(n for i in run for _first, n in dealt[i])
    done, lock = 0, threading.Lock()

    def shard(i: int) -> None:
        nonlocal done
        for first, n in dealt[i]:
            launch(kernel, n, *arguments(first, n, i), device)
            if progress is not None:
                with lock:
                    done += n
                    progress(done / items)

    workers.run_shards(shard, run)


def launch_on_host(kernel: wp.Kernel, count: int, inputs: list, outputs: list) -> list[np.ndarray]:
    """Run a kernel over items on the host's processor, whatever device the scene is on; its lists are the same then.

    Args:
        kernel: one thread an item; behind the inputs it takes the first item's number.
        count: number of items.
        inputs: NumPy arrays are not copied; those of vectors have one axis more.
        outputs: type of each output, an array of ``count``; or the array that is filled.

    Returns:
        The outputs.
    """
    host = wp.get_device("cpu")
    kinds = [argument.type for argument in kernel.adj.args[: len(inputs)]]
    taken = [_on_host(x, kind) if isinstance(x, np.ndarray) else x for x, kind in zip(inputs, kinds, strict=True)]
    made = [x if isinstance(x, wp.array) else wp.empty(count, dtype=x, device=host) for x in outputs]
    dealt = workers.even_chunks(count)
    launch_shards(kernel, count, partial(_behind, taken, made), shards=len(dealt), device=host, chunks=dealt)
    return [array.numpy() for array in made]


def _on_host(values: np.ndarray, kind: Any) -> wp.array:
    return wp.array(np.ascontiguousarray(values), dtype=kind.dtype, ndim=kind.ndim, device="cpu", copy=False)


def _behind(inputs: list, outputs: list, first: int, _count: int, _shard: int) -> tuple[list, list]:
    return [*inputs, first], outputs

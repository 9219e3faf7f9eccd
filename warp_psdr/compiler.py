"""Compile kernels side by side, on threads of their own, before they are launched.

Warp generates a module's code under a lock and compiles it outside of the interpreter's, so N modules compile on N
cores (``wp.load_module`` from several threads is what Warp's own ``force_load`` does). What is in the kernel cache is
loaded by whoever asks for it, at once. Results do not depend on when or where a kernel is compiled.
"""

from __future__ import annotations

import importlib
import math
import sys
import threading
import time
from collections.abc import Collection, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import warp as wp

from warp_psdr import forks, headers, kernel_cache, workers
from warp_psdr.kernels.modules import FILES
from warp_psdr.progress import draws_bars, progress

#: Most threads that compile.
MOST_THREADS = 8
#: Seconds that a kernel takes, before this process has compiled one.
TYPICAL_SECONDS = 5.0
#: How often a bar is drawn anew.
BAR_SECONDS = 0.2


@dataclass
class Compiled:
    """What a process has compiled.

    Attributes:
        name: the kernel's, or that of the module that several kernels share.
        seconds: from its start to its end; several run side by side.
    """

    name: str
    seconds: float


_lock = threading.Lock()
#: (module, name of the device)
_loaded: set[tuple[wp.Module, str]] = set()
_jobs: dict[tuple[wp.Module, str], Future] = {}
#: Jobs since the last time when none was running, which a bar counts.
_batch: list[Future] = []
_pool: ThreadPoolExecutor | None = None
_pool_size = 0
_said: set[Future | None] = set()
#: What this process has compiled, in the order in which it was done.
done: list[Compiled] = []
_reason: ContextVar[str] = ContextVar("reason", default="")


def begin(kernels: Iterable[wp.Kernel], device: wp.Device) -> int:
    """Start to compile kernels that are neither loaded nor in the cache, and return how many modules that starts.

    An error is kept until a kernel is needed (``ensure``).
    """
    started = 0
    if not threading.main_thread().is_alive():
        return started  # the interpreter takes no more threads
    for module in dict.fromkeys(kernel.module for kernel in kernels):
        key = (module, device.alias)
        if key in _loaded or key in _jobs:
            continue
        _complete(module)
        if kernel_cache.contains(module, device):
            continue
        if device.is_cpu:
            headers.begin()
        with _lock:
            if key not in _loaded and key not in _jobs:
                if all(job.done() for job in _batch):
                    _batch.clear()
                _jobs[key] = _threads().submit(_compile, module, device)
                _batch.append(_jobs[key])
                started += 1
    return started


def ensure(kernels: Collection[wp.Kernel], device: wp.Device | str | None) -> None:
    """Load kernels, and wait for those that are being compiled.

    Raises:
        Exception: a kernel cannot be compiled; as Warp raises it.
    """
    if not isinstance(device, wp.Device):
        device = wp.get_device(device)
    missing = [module for module in {k.module: None for k in kernels} if (module, device.alias) not in _loaded]
    if not missing:
        return
    begin((kernel for kernel in kernels if kernel.module in missing), device)
    for module in missing:
        key = (module, device.alias)
        job = _jobs.get(key)
        try:
            if job is not None:
                _await(job)
            else:
                kernel_cache.load(module, device)
            _loaded.add(key)
        finally:
            with _lock:
                _jobs.pop(key, None)
                _said.discard(job)


@contextmanager
def because(reason: str) -> Iterator[None]:
    """Say why kernels are compiled that are first needed meanwhile: "to compare ...", in the line about them."""
    token = _reason.set(reason)
    try:
        yield
    finally:
        _reason.reset(token)


def _await(job: Future) -> None:
    """Wait for a job; say once what is being compiled, and show a bar on a terminal and in a notebook."""
    if not job.done():
        with _lock:
            running = [j for j in _jobs.values() if not j.done()]
            news = job not in _said
            _said.update(running)
        if news:
            print(_line(len(running)), file=sys.stderr, flush=True)
        if draws_bars(sys.stderr):
            _show(job)
    job.result()


def _line(kernels: int) -> str:
    """Return what is being compiled, why, and about how long that takes."""
    taken = [c.seconds for c in done]
    seconds = max(sum(taken) / len(taken) if taken else TYPICAL_SECONDS, 1.0)
    seconds *= math.ceil(kernels / max(_pool_size, 1))
    what = f"{kernels} kernels" if kernels != 1 else "1 kernel"
    reason = f" {_reason.get()}" if _reason.get() else ""
    return f"warp_psdr: compiling {what}{reason} (first use; kept for next time), about {seconds:.0f} s"


def _show(job: Future) -> None:
    """Show how many jobs of the batch are done, until ``job`` is."""
    with _lock:
        batch = list(_batch)
    with progress("compiling", len(batch), transient=True) as report:
        while not job.done():
            report(sum(j.done() for j in batch), "")
            wait([job], timeout=BAR_SECONDS)


def _complete(module: wp.Module) -> None:
    """Import all files whose kernels share a module, for one that joins later would compile it anew."""
    for file in FILES.get(module.name, ()):
        importlib.import_module(f"warp_psdr.kernels.{file}")


def _compile(module: wp.Module, device: wp.Device) -> None:
    """Compile and load a module, on a thread of the pool."""
    if not threading.main_thread().is_alive():
        return  # the program ends, and nobody waits for this
    start = time.perf_counter()
    kernel_cache.load(module, device)
    done.append(Compiled(_name(module), time.perf_counter() - start))


def _name(module: wp.Module) -> str:
    """Return what a module holds, for people: its kernel's name, or its own."""
    kernels = list(module.kernels)
    return kernels[0].rpartition("__")[2] if len(kernels) == 1 else module.name


def _threads() -> ThreadPoolExecutor:
    """Return the threads that compile, one for every worker."""
    global _pool, _pool_size
    size = min(workers.workers(), MOST_THREADS)
    if _pool is None or size != _pool_size:
        if _pool is not None:
            _pool.shutdown(wait=False)
        _pool, _pool_size = ThreadPoolExecutor(size, thread_name_prefix="warp_psdr-compile"), size
    return _pool


@forks.before
def _finish() -> None:
    """Wait for what is being compiled: a child that is forked meanwhile would find the compiler's locks taken."""
    with _lock:
        running = list(_jobs.values())
    wait(running)


@forks.in_child
def _forget_threads() -> None:
    """Forget the threads, which a forked process does not have."""
    global _lock, _pool
    _lock, _pool = threading.Lock(), None
    _jobs.clear()
    _batch.clear()
    _said.clear()

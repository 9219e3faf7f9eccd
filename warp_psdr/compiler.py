"""Compile kernels side by side, on threads of their own, before they are launched.

Warp generates a module's code under a lock and compiles it outside of the interpreter's, so N modules compile on N
cores (``wp.load_module`` from several threads is what Warp's own ``force_load`` does). What is in the kernel cache is
loaded by whoever asks for it, at once. Results do not depend on when or where a kernel is compiled.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Collection, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import warp as wp

from warp_psdr import headers, workers
from warp_psdr.quiet import quiet

#: Most threads that compile.
MOST_THREADS = 8
#: Threads of a block on CUDA, ``wp.launch``'s default.
CUDA_BLOCK = 256
#: What a compiled module leaves in the kernel cache.
BINARIES = (".o", ".ptx", ".cubin")


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
_pool: ThreadPoolExecutor | None = None
_pool_size = 0
_said: set[Future | None] = set()
#: What this process has compiled, in the order in which it was done.
done: list[Compiled] = []


def begin(kernels: Iterable[wp.Kernel], device: wp.Device) -> int:
    """Start to compile kernels that are neither loaded nor in the cache, and return how many modules that starts.

    An error is kept until a kernel is needed (``ensure``).
    """
    started = 0
    if not threading.main_thread().is_alive():
        return started  # the interpreter takes no more threads
    for module in dict.fromkeys(kernel.module for kernel in kernels):
        key = (module, device.alias)
        if key in _loaded or key in _jobs or _cached(module, device):
            continue
        if device.is_cpu:
            headers.begin()
        with _lock:
            if key not in _loaded and key not in _jobs:
                _jobs[key] = _threads().submit(_compile, module, device)
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
                with quiet():
                    wp.load_module(module, device=device, block_dim=_block(device))
            _loaded.add(key)
        finally:
            with _lock:
                _jobs.pop(key, None)
                _said.discard(job)


def start_warp() -> None:
    """Initialise Warp without its greeting; a program that calls ``wp.init()`` itself gets to see it."""
    with quiet():
        wp.init()


def _await(job: Future) -> None:
    """Wait for a job, and say once what is being compiled if that is not done."""
    if not job.done():
        with _lock:
            running = [j for j in _jobs.values() if not j.done()]
            news = job not in _said
            _said.update(running)
        if news:
            kernels = f"{len(running)} kernels" if len(running) != 1 else "1 kernel"
            print(f"warp_psdr: compiling {kernels}, once (cached)", file=sys.stderr, flush=True)
    job.result()


def _compile(module: wp.Module, device: wp.Device) -> None:
    """Compile and load a module, on a thread of the pool."""
    if not threading.main_thread().is_alive():
        return  # the program ends, and nobody waits for this
    start = time.perf_counter()
    with quiet():
        wp.load_module(module, device=device, block_dim=_block(device))
    done.append(Compiled(_name(module), time.perf_counter() - start))


def _name(module: wp.Module) -> str:
    """Return what a module holds, for people: its kernel's name, or its own."""
    kernels = list(module.kernels)
    return kernels[0].rpartition("__")[2] if len(kernels) == 1 else module.name


def _cached(module: wp.Module, device: wp.Device) -> bool:
    """Return whether the kernel cache has a module's binary.

    A binary for another machine in the same place is taken for it: the thread that loads it compiles then.
    """
    identifier = module.get_module_identifier(_block(device))
    try:
        files = os.listdir(os.path.join(wp.config.kernel_cache_dir or "", identifier))
    except OSError:
        return False
    return any(name.endswith(BINARIES[:1] if device.is_cpu else BINARIES[1:]) for name in files)


def _block(device: wp.Device) -> int:
    """Return how many threads a launch's block has: a module is compiled for each number."""
    return 1 if device.is_cpu else CUDA_BLOCK


def _threads() -> ThreadPoolExecutor:
    """Return the threads that compile, one for every worker."""
    global _pool, _pool_size
    size = min(workers.workers(), MOST_THREADS)
    if _pool is None or size != _pool_size:
        if _pool is not None:
            _pool.shutdown(wait=False)
        _pool, _pool_size = ThreadPoolExecutor(size, thread_name_prefix="warp_psdr-compile"), size
    return _pool

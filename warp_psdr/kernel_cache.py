"""Load a module's binary from Warp's kernel cache, and mend the cache where a file in it is damaged.

A crash or a full disk can leave an empty or cut binary, and Warp 1.19 takes every file that exists for a whole one: the
module then fails to load in every later run. ``load`` removes the folder of such a module and compiles it once more.
What cannot be seen is a binary that loads and has every kernel, but other instructions.

Processes that share a cache compile a module once: the others wait for the one that has begun.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
from collections.abc import Iterator

import warp as wp

from warp_psdr.quiet import quiet

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

#: What a compiled module leaves in the kernel cache, on the CPU and on CUDA.
BINARIES = (".o", ".ptx", ".cubin")
#: Folder of the kernel cache with an empty file for every module that was compiled: its lock.
LOCKS = "warp_psdr_locks"
#: Threads of a block on CUDA, ``wp.launch``'s default.
CUDA_BLOCK = 256


def load(module: wp.Module, device: wp.Device) -> None:
    """Compile a module if the cache lacks it, and load it; a damaged entry of the cache is compiled again.

    Raises:
        Exception: the module cannot be compiled or loaded; as Warp raises it.
    """
    cached = contains(module, device)
    try:
        if cached:
            _load(module, device)
        else:
            with _compiling(module, device):
                _load(module, device)
    except Exception as error:
        if not cached:
            raise
        folder = _folder(module, device)
        print(
            f"warp_psdr: the kernel cache is damaged ({type(error).__name__}), compiling again: {folder}",
            file=sys.stderr,
            flush=True,
        )
        shutil.rmtree(folder, ignore_errors=True)
        module.unload()  # what was loaded of the damaged file, and the recorded failure
        _load(module, device)


def contains(module: wp.Module, device: wp.Device) -> bool:
    """Return whether the kernel cache has a module's binary.

    A binary for another machine in the same place is taken for it: the thread that loads it compiles then.
    """
    try:
        files = os.listdir(_folder(module, device))
    except OSError:
        return False
    return any(name.endswith(BINARIES[:1] if device.is_cpu else BINARIES[1:]) for name in files)


@contextlib.contextmanager
def _compiling(module: wp.Module, device: wp.Device) -> Iterator[None]:
    """Keep other processes from compiling the same module meanwhile; one that dies lets go of it."""
    cache, name = os.path.split(_folder(module, device))
    try:
        os.makedirs(os.path.join(cache, LOCKS), exist_ok=True)
        file = os.open(os.path.join(cache, LOCKS, name), os.O_CREAT | os.O_RDWR)
    except OSError:  # a cache that cannot be written to: Warp says so
        yield
        return
    try:
        if fcntl is not None:
            with contextlib.suppress(OSError):  # a network file system without locks
                fcntl.flock(file, fcntl.LOCK_EX)
        yield
    finally:
        os.close(file)


def _load(module: wp.Module, device: wp.Device) -> None:
    """Load a module, and look every kernel of it up: a cut binary may load without them."""
    with quiet():
        wp.load_module(module, device=device, block_dim=_block(device))
    if device.is_cpu:  # CUDA refuses damaged binaries itself
        executable = module.execs[device.context, _block(device)]
        for kernel in list(module.kernels.values()):
            if executable.get_kernel_hooks(kernel).forward is None:
                raise RuntimeError(f"module '{module.name}' has no kernel '{kernel.key}'")


def _folder(module: wp.Module, device: wp.Device) -> str:
    return os.path.join(wp.config.kernel_cache_dir or "", module.get_module_identifier(_block(device)))


def _block(device: wp.Device) -> int:
    """Return how many threads a launch's block has: a module is compiled for each number."""
    return 1 if device.is_cpu else CUDA_BLOCK

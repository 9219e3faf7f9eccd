"""Warp's headers, parsed once for all threads and processes.

Before a process compiles its first kernel for the CPU, Warp parses its headers, which takes two seconds: as long as a
kernel of a path loop. It does so once for every thread that compiles, and throws the result away when the process
ends. ``begin`` parses them on a thread of its own as soon as a scene is built, while code is still generated, and
keeps the result (5 MB) in the kernel cache; threads that come to their compiler earlier wait for it. A folder belongs
to one installation of Warp and one kind of processor. Compiled kernels are the same.
"""

from __future__ import annotations

import hashlib
import os
import threading
from typing import Any

import warp as wp

from warp_psdr import forks, kernel_cache
from warp_psdr.kernels.headers import include_headers

_lock = threading.Lock()
_parsing: threading.Thread | None = None


def begin() -> None:
    """Let all threads share the parsed headers of the kernel cache, and begin to parse them if it has none.

    Warp 1.19 has no public way to say where they are; a Warp that does not ask for the folder by this name keeps to
    its own ways, one folder a thread.
    """
    global _parsing
    runtime: Any = wp._src.context.runtime
    if not hasattr(runtime, "get_clang_pch_dir") or runtime.llvm is None or not wp.config.use_precompiled_headers:
        return
    with _lock:
        if _parsing is not None:
            return
        _parsing = threading.Thread(target=_parse, name="warp_psdr-headers")
        runtime.get_clang_pch_dir = _shared_folder
        _parsing.start()


@forks.in_child
def _forget_parsing() -> None:
    """Let a forked process parse again: the thread that did so may not have come to its end."""
    global _lock, _parsing
    _lock, _parsing = threading.Lock(), None


def _parse() -> None:
    """Parse the headers, in one process; an error is for who compiles a kernel, and meets it again."""
    kernel_cache.load(include_headers.module, wp.get_device("cpu"))


def _shared_folder() -> str:
    """Return the folder of the parsed headers, for who is about to compile, when they are there."""
    if _parsing is not None and _parsing.ident not in (None, threading.get_ident()):
        _parsing.join()
    return _folder()


def _folder() -> str:
    """Return the folder in the kernel cache for this installation and processor."""
    header = os.path.join(os.path.dirname(wp.__file__), "native", "builtin.h")
    target = wp._src.context._get_cpu_target_hash("-march=native")
    key = hashlib.sha256(f"{header} {os.stat(header).st_mtime_ns} {target}".encode()).hexdigest()[:8]
    folder = os.path.join(wp.config.kernel_cache_dir or "", f"wp_warp_psdr.parsed_headers_{key}")
    os.makedirs(folder, exist_ok=True)
    return folder

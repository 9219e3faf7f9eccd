"""Warp's own lines, kept from standard output."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp

from warp_psdr import forks

_lock = threading.Lock()


@contextmanager
def quiet() -> Iterator[None]:
    """Keep Warp's lines about what this thread loads from standard output, but for those that a debug level asks for.

    The logger that the program has set gets everything else, and everything of other threads.
    """
    global _quiet_users
    if wp.config.log_level <= wp.LOG_DEBUG:
        yield
        return
    with _lock:
        if _quiet_users == 0:
            wp.set_logger(_Quiet(wp.get_logger()))
        _quiet_users += 1
    _quiet.depth = getattr(_quiet, "depth", 0) + 1
    try:
        yield
    finally:
        _quiet.depth -= 1
        with _lock:
            _quiet_users -= 1
            logger = wp.get_logger()
            if _quiet_users == 0 and isinstance(logger, _Quiet):
                wp.set_logger(logger.inner)


_quiet = threading.local()
_quiet_users = 0


class _Quiet:
    """A logger in front of the program's own, which does not see what quiet threads have to tell."""

    def __init__(self, inner):
        self.inner = inner

    def debug(self, message: str) -> None:
        self.inner.debug(message)

    def info(self, message: str) -> None:
        if not getattr(_quiet, "depth", 0):
            self.inner.info(message)

    def warning(self, message: str, category=None, stacklevel: int = 1) -> None:
        self.inner.warning(message, category=category, stacklevel=stacklevel + 1)

    def error(self, message: str) -> None:
        self.inner.error(message)


@forks.in_child
def _new_lock() -> None:
    global _lock
    _lock = threading.Lock()

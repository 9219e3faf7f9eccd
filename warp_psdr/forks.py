"""What a process that is forked has to forget: its threads, and locks that threads of its parent may hold."""

from __future__ import annotations

import os
from collections.abc import Callable


def in_child(function: Callable[[], None]) -> Callable[[], None]:
    """Call a function in every forked process, before anything else runs there; a decorator."""
    if hasattr(os, "register_at_fork"):  # not on Windows, which does not fork
        os.register_at_fork(after_in_child=function)
    return function


def before(function: Callable[[], None]) -> Callable[[], None]:
    """Call a function before this process forks; a decorator."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(before=function)
    return function

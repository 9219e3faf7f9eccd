"""Processes of tests: which there are, and programs that run in a session of their own for a bounded time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: Seconds that anything takes at most; only what hangs gets there.
LONGEST = 120.0


def wait_until(done: Callable[[], object], what: str) -> None:
    """Wait until something is so.

    Raises:
        AssertionError: it is not for a long time.
    """
    end = time.monotonic() + LONGEST
    while not done():
        assert time.monotonic() < end, what
        time.sleep(0.02)


def below(ancestor: int | None = None) -> set[int]:
    """Return the living processes below one, this one's by default; Python's own tracker of resources is none."""
    parents = {int(p.name): _stat(p) for p in Path("/proc").iterdir() if p.name.isdigit()}
    found, size = {os.getpid() if ancestor is None else ancestor}, 0
    while len(found) > size:
        size = len(found)
        found |= {pid for pid, (state, parent, _session) in parents.items() if parent in found and state not in "ZX"}
    return found - {os.getpid() if ancestor is None else ancestor, resource_tracker._resource_tracker._pid}


def of_session(session: int) -> set[int]:
    """Return the living processes of a session."""
    every = {int(p.name): _stat(p) for p in Path("/proc").iterdir() if p.name.isdigit()}
    return {pid for pid, (state, _parent, own) in every.items() if own == session and state not in "ZX"}


def _stat(process: Path) -> tuple[str, int, int]:
    """Return a process's state, its parent and its session."""
    try:
        state, parent, _group, session = (process / "stat").read_text().rpartition(")")[2].split()[:4]
    except OSError:  # it has ended since
        return "X", 0, 0
    return state, int(parent), int(session)


@contextmanager
def program(output: Path, *arguments: object) -> Iterator[subprocess.Popen]:
    """Run a module of Python in a session of its own, which has ended afterwards; it writes to a file.

    Args:
        output: the file.
        arguments: of ``python -m``.
    """
    command = [sys.executable, "-m", *map(str, arguments)]
    with output.open("w") as file:
        process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True
        )
    try:
        yield process
    finally:
        for pid in of_session(process.pid):
            os.kill(pid, signal.SIGKILL)
        process.wait()

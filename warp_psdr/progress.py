"""Progress of a long run: a bar with the time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

__all__ = ["progress"]

#: Lines that a run without a terminal prints about: enough to follow it in a log, few enough to read.
PLAIN_LINES = 20

#: ``report(done, text)``: how many steps are done, and what to say about the last one.
Report = Callable[[int, str], None]


@contextmanager
def progress(title: str, total: int, *, start: int = 0, stream: TextIO | None = None) -> Iterator[Report]:
    """Show how far a run of ``total`` steps has come.

    Args:
        title: What is running.
        total: Number of steps.
        start: Steps that were done before, for a resumed run.
        stream: Where to write; standard error unless given.

    Yields:
        A function ``report(done, text)``, to be called after every step.
    """
    stream = sys.stderr if stream is None else stream
    if stream.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
        )
        with Progress(*columns, console=Console(file=stream)) as bar:
            task = bar.add_task(title, total=total, completed=start, text="", left="")
            clock = _Clock(total, start)

            def report(done: int, text: str) -> None:
                bar.update(task, completed=done, text=text, left=clock.left(done))

            yield report
        return
    clock = _Clock(total, start)
    every = max(1, total // PLAIN_LINES)
    lock = threading.Lock()  # worker threads report too
    printed = start // every - 1  # so that the first report is printed

    def report_line(done: int, text: str) -> None:
        nonlocal printed
        with lock:
            if done // every > printed or done == total:
                printed = done // every
                said = f"{title} {done}/{total}  {text}".rstrip()
                print(f"{said}  {clock.elapsed()}, {clock.left(done)}", file=stream, flush=True)

    yield report_line


class _Clock:
    """Time gone and time left, of the steps of this process alone."""

    def __init__(self, total: int, start: int):
        self._total, self._start = total, start
        self._began = time.monotonic()

    def elapsed(self) -> str:
        return duration(time.monotonic() - self._began)

    def left(self, done: int) -> str:
        here = done - self._start
        if here <= 0:
            return "time left unknown"
        seconds = (time.monotonic() - self._began) / here * (self._total - done)
        return f"{duration(seconds)} left"


def duration(seconds: float) -> str:
    """Return a time span for people: ``4.2 s``, ``3:07 min``, ``2:05 h``."""
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes}:{rest:02d} min"
    return f"{minutes // 60}:{minutes % 60:02d} h"

"""Progress of a long run: a bar with the time left on a terminal and in a notebook, plain lines elsewhere."""

from __future__ import annotations

import importlib.util
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, TextIO

import warp as wp

if TYPE_CHECKING:
    from rich.progress import TaskID

__all__ = ["progress"]

#: Lines that a run without a terminal prints about: enough to follow it in a log, few enough to read.
PLAIN_LINES = 20

#: ``report(done, text)``: how many steps are done, and what to say about the last one.
Report = Callable[[int, str], None]


_silent: ContextVar[bool] = ContextVar("silent", default=False)


@contextmanager
def silence() -> Iterator[None]:
    """Show no progress of what runs inside: whoever has started it shows that of several."""
    token = _silent.set(True)
    try:
        yield
    finally:
        _silent.reset(token)


@contextmanager
def progress(
    title: str, total: int, *, start: int = 0, stream: TextIO | None = None, transient: bool = False
) -> Iterator[Report]:
    """Show how far a run of ``total`` steps has come: from its first report to its last, and nothing else.

    What comes before the first step (loading, compiling) and after the last one (writing results) shows no bar.

    Args:
        title: What is running.
        total: Number of steps.
        start: Steps that were done before, for a resumed run.
        stream: Where to write; standard error unless given.
        transient: Whether a bar goes away when its run ends.

    Yields:
        A function ``report(done, text)``, to be called after every step.
    """
    if _silent.get():
        yield lambda _done, _text: None
        return
    stream = sys.stderr if stream is None else stream
    clock = _Clock(total, start)
    lock = threading.Lock()  # worker threads report too
    if draws_bars(stream):
        bar = _Bar(title, total, clock, stream, transient)
        try:

            def report(done: int, text: str) -> None:
                with lock:
                    bar.report(done, text)

            yield report
        finally:
            bar.stop()
        return
    every = max(1, total // PLAIN_LINES)
    printed = start // every - 1  # so that the first report is printed

    def report_line(done: int, text: str) -> None:
        nonlocal printed
        with lock:
            if done // every > printed or done == total:
                printed = done // every
                said = f"{title} {done}/{total}  {text}".rstrip()
                print(f"{said}  {clock.elapsed()}, {clock.left(done)}", file=stream, flush=True)

    yield report_line


def say(what: str, seconds: float) -> None:
    """Write a line to standard error about what begins and takes a while.

    Args:
        what: after "warp_psdr:", as "listing the edges of 1,000,000 triangles".
        seconds: how long it takes, about. Nothing is written below a second, or where Warp's log level
            (``wp.config.log_level``) leaves out what is no warning.
    """
    if seconds >= 1.0 and wp.config.log_level <= wp.LOG_INFO:
        print(f"warp_psdr: {what}, about {seconds:.0f} s", file=sys.stderr, flush=True)


def draws_bars(stream: TextIO) -> bool:
    """Whether progress on a stream is a bar: on a terminal, and in a notebook."""
    return stream.isatty() or shows_widgets()


def shows_widgets() -> bool:
    """Whether this is a notebook in which rich can draw a bar; without ipywidgets it gets plain lines."""
    if "IPython" not in sys.modules or importlib.util.find_spec("ipywidgets") is None:
        return False
    shell = sys.modules["IPython"].get_ipython()
    return type(shell).__name__ == "ZMQInteractiveShell"


class _Bar:
    """A bar of rich: on a terminal, or in a notebook."""

    def __init__(self, title: str, total: int, clock: _Clock, stream: TextIO, transient: bool):
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[text]}"),
            TextColumn("{task.fields[elapsed]}"),
            TextColumn("{task.fields[left]}"),
        )
        self._bar = Progress(*columns, console=Console(file=stream), transient=transient)
        self._title, self._total, self._clock = title, total, clock
        self._task: TaskID | None = None

    def report(self, done: int, text: str) -> None:
        if self._task is None:
            self._task = self._bar.add_task(self._title, total=self._total, text="", elapsed="", left="")
            self._bar.start()
        clock = self._clock
        self._bar.update(self._task, completed=done, text=text, elapsed=clock.elapsed(), left=clock.left(done))
        if done >= self._total:
            self.stop()

    def stop(self) -> None:
        if self._bar.live.is_started:
            self._bar.stop()


class _Clock:
    """Time gone and time left, of the steps of this process alone."""

    def __init__(self, total: int, start: int):
        self._total, self._start = total, start
        self._began = time.monotonic()
        self._first: tuple[int, float] | None = None

    def elapsed(self) -> str:
        return duration(time.monotonic() - self._began)

    def left(self, done: int) -> str:
        now = time.monotonic()
        # Steps after the first report tell more of what is left: kernels are compiled before it.
        since, began = (self._start, self._began) if self._first is None else self._first
        if self._first is None:
            self._first = (done, now)
        if done <= since:
            since, began = self._start, self._began
        if done <= since:
            return "time left unknown"
        return f"{duration((now - began) / (done - since) * (self._total - done))} left"


def duration(seconds: float) -> str:
    """Return a time span for people: ``4.2 s``, ``3:07 min``, ``2:05 h``."""
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes}:{rest:02d} min"
    return f"{minutes // 60}:{minutes % 60:02d} h"

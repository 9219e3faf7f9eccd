"""Progress: a few plain lines in a log, a bar on a terminal, and time spans that people read."""

import importlib.util
import io
import re
import sys
from types import SimpleNamespace

import pytest

import warp_psdr.progress
from warp_psdr.progress import PLAIN_LINES, duration, progress, shows_widgets


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def run(stream: io.StringIO, total: int, start: int = 0) -> str:
    with progress("fit", total, start=start, stream=stream) as report:
        for done in range(start + 1, total + 1):
            report(done, f"loss {1 / done:.2f}")
    return stream.getvalue()


def test_a_log_gets_a_few_whole_lines() -> None:
    lines = run(io.StringIO(), 1000).splitlines()
    assert PLAIN_LINES <= len(lines) <= PLAIN_LINES + 2
    assert re.fullmatch(r"fit 1/1000  loss 1\.00  \S+ s, \S+ \S+ left", lines[0])
    assert lines[-1].startswith("fit 1000/1000  loss 0.00")
    assert lines[-1].endswith("0.0 s left")


def test_short_runs_say_every_step() -> None:
    assert len(run(io.StringIO(), 3).splitlines()) == 3


def test_resumed_runs_start_where_they_were() -> None:
    lines = run(io.StringIO(), 100, start=90).splitlines()
    assert lines[0].startswith("fit 91/100")


def test_a_terminal_gets_a_bar() -> None:
    shown = run(Terminal(), 5)
    assert "5/5" in shown
    assert "loss 0.20" in shown
    assert "\x1b[" in shown or "\r" in shown


def test_a_bar_is_there_from_the_first_report_to_the_last() -> None:
    stream = Terminal()
    with progress("render", 3, stream=stream) as report:
        assert stream.getvalue() == "", "nothing has been done yet: kernels are compiled"
        report(1, "")
        assert "render" in stream.getvalue()
        report(3, "")
        ended = stream.getvalue()
        assert "3/3" in ended and ended.endswith("\x1b[?25h"), "the cursor is back: the bar has ended"
        stream.write("results are written")
    assert stream.getvalue() == f"{ended}results are written"
    silent = Terminal()
    with progress("render", 3, stream=silent):
        pass
    assert silent.getvalue() == ""


def test_what_is_compiled_before_the_first_step_is_not_told_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(warp_psdr.progress.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    with progress("fit", 11, stream=stream) as report:
        for done, seconds in ((1, 30.0), (2, 31.0), (3, 32.0)):
            now[0] = seconds
            report(done, "")
    lines = stream.getvalue().splitlines()
    assert lines[0].endswith("30.0 s, 5:00 min left") and lines[1].endswith("9.0 s left")
    assert lines[2].endswith("8.0 s left")


def test_a_notebook_without_widgets_gets_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    class ZMQInteractiveShell:
        pass

    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=ZMQInteractiveShell))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert not shows_widgets() and len(run(io.StringIO(), 3).splitlines()) == 3
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    assert shows_widgets()
    monkeypatch.delitem(sys.modules, "IPython")
    assert not shows_widgets()


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.0, "0.0 s"), (59.94, "59.9 s"), (187.2, "3:07 min"), (7500.0, "2:05 h")]
)
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text

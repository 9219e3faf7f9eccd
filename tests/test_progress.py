"""Progress: a few plain lines in a log, a bar on a terminal, and time spans that people read."""

import io
import re

import pytest

from warp_psdr.progress import PLAIN_LINES, duration, progress


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


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.0, "0.0 s"), (59.94, "59.9 s"), (187.2, "3:07 min"), (7500.0, "2:05 h")]
)
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text

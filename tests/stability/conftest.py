"""Checks the cases of the stability families and prints what was measured at the end of a run of this folder."""

from collections.abc import Callable

import pytest

from .record import Case, Row, details, loose, measured, require, summary

#: Under which name a test's report carries its row; reports travel from the workers of a parallel run.
PROPERTY = "stability"


@pytest.fixture
def check(request: pytest.FixtureRequest) -> Callable[[Case], None]:
    """Measure a case, keep the row for the table, and fail where the error exceeds the bound."""

    def run(case: Case) -> None:
        row = measured(case)
        request.node.user_properties.append((PROPERTY, list(row)))
        require(case, row)

    return run


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reports = [report for kind in ("passed", "failed") for report in terminalreporter.stats.get(kind, [])]
    properties = [p for report in reports for p in getattr(report, "user_properties", [])]
    rows = [Row(*value) for name, value in properties if name == PROPERTY]
    if rows:
        verbose = terminalreporter.config.get_verbosity() > 0
        terminalreporter.section("stability")
        for line in (details if verbose else summary)(rows):
            terminalreporter.write_line(line)
        for name in loose(rows):
            terminalreporter.write_line(f"holds with half of its bound too: {name}")

"""What a stability case is, and the table of what was measured.

A family is one file with a table ``CASES`` and one test that checks each of them:

    @pytest.mark.parametrize("case", parameters(CASES))
    def test_light(case, check):
        check(case)

A case sweeps over the range in which its kind of input is hard, and its ``measure`` returns the worst error that it
met, as a plain number: programs that print or draw the table call it without pytest.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import pytest


@dataclass(frozen=True, kw_only=True)
class Case:
    """One row of a family's table.

    Attributes:
        family: "materials", "light", ...
        name: unique within the family; says what is swept and over which range.
        hard: what is hard about it.
        naive: what a naive implementation does there.
        bound: largest error allowed, in the unit of ``measure``; 0: exact. Tight: some error found is above half of it.
        measure: () -> the worst error of the sweep, in general relative; infinite where something is not finite.
        slow: takes more than some five seconds.
        quantile: the error is a statistic of noise over its quantile at 1e-3, and 1/2 is as good as 1.
    """

    family: str
    name: str
    hard: str
    naive: str
    bound: float
    measure: Callable[[], float]
    slow: bool = False
    quantile: bool = False


class Row(NamedTuple):
    """What was measured for a case."""

    family: str
    name: str
    error: float
    bound: float
    quantile: bool = False

    @property
    def cell(self) -> str:
        """The name as a cell of a Markdown table: |z| would be three."""
        return self.name.replace("|", "\\|")

    @property
    def share(self) -> float:
        """Error over bound: above 1 the case fails, below 1/2 its bound is loose."""
        if self.bound == 0.0:
            return 0.0 if self.error == 0.0 else math.inf
        return self.error / self.bound


def measured(case: Case) -> Row:
    """Run a case."""
    return Row(case.family, case.name, float(case.measure()), case.bound, case.quantile)


def require(case: Case, row: Row) -> None:
    """Fail if the error exceeds the bound; written so that an error that is no number fails too."""
    assert row.error <= row.bound, f"{case.name}: error {row.error:.3g} > {row.bound:.3g}; hard: {case.hard}"


def parameters(cases: Iterable[Case]) -> list:
    """Return the cases as parameters of a test, the slow ones marked."""
    return [pytest.param(c, id=c.name, marks=[pytest.mark.slow] if c.slow else []) for c in cases]


def summary(rows: Iterable[Row]) -> list[str]:
    """Return the lines of the table: a row a family, with the case that comes closest to its bound."""
    families: dict[str, list[Row]] = {}
    for row in rows:
        families.setdefault(row.family, []).append(row)
    lines = ["| family | cases | worst case | error | bound |", "|---|---|---|---|---|"]
    for family, found in sorted(families.items()):
        worst = max(found, key=lambda row: row.share)
        lines.append(f"| {family} | {len(found)} | {worst.cell} | {worst.error:.2g} | {worst.bound:.2g} |")
    return lines


def loose(rows: Iterable[Row]) -> list[str]:
    """Return the names of the cases that would still pass if their bounds were halved."""
    return [f"{r.family}: {r.name}" for r in sorted(rows) if r.bound > 0.0 and r.share <= 0.5 and not r.quantile]


def details(rows: Iterable[Row]) -> list[str]:
    """Return the lines of the long table: a row a case."""
    lines = ["| family | case | error | bound |", "|---|---|---|---|"]
    return lines + [f"| {r.family} | {r.cell} | {r.error:.2g} | {r.bound:.2g} |" for r in sorted(rows)]

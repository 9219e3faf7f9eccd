"""The record of the stability cases: it fails what it has to, and its table names the worst."""

import pytest

from .record import Case, Row, details, loose, measured, require, summary


def case(error: float, bound: float) -> Case:
    return Case(family="f", name="n", hard="", naive="", bound=bound, measure=lambda: error)


@pytest.mark.parametrize(("error", "bound"), [(1.1, 1.0), (float("nan"), 1.0), (float("inf"), 1.0), (1e-30, 0.0)])
def test_a_case_beyond_its_bound_fails(error: float, bound: float) -> None:
    broken = case(error, bound)
    with pytest.raises(AssertionError, match="hard"):
        require(broken, measured(broken))


def test_a_case_within_its_bound_passes() -> None:
    for error, bound, share in ((0.5, 1.0, 0.5), (0.0, 0.0, 0.0)):
        row = measured(case(error, bound))
        require(case(error, bound), row)
        assert row.share == share


def test_the_table_names_the_case_closest_to_its_bound() -> None:
    lines = summary([Row("a", "near", 0.9, 1.0), Row("a", "far", 5.0, 100.0), Row("b", "exact", 0.0, 0.0)])
    assert lines[2:] == ["| a | 2 | near | 0.9 | 1 |", "| b | 1 | exact | 0 | 0 |"]
    assert details([Row("a", "largest |z|", 0.9, 1.0)])[2:] == ["| a | largest \\|z\\| | 0.9 | 1 |"]


def test_loose_bounds_are_named() -> None:
    rows = [Row("a", "tight", 0.6, 1.0), Row("a", "loose", 0.4, 1.0), Row("a", "exact", 0.0, 0.0)]
    assert loose([*rows, Row("a", "noise", 0.1, 1.0, quantile=True)]) == ["a: loose"]

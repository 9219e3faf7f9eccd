"""Budgets of batches: what is right is called so, what is wrong too, the level holds over two looks, time is kept."""

import numpy as np
from scipy import stats

from warp_psdr.certify.spending import LEAST, LOOKS, MOST, Planning, Row, Sampler, spend

TOLERANCE, LEVEL = 0.02, 0.99
#: Simulated certificates, rows of each, and the probability with which a right program fails.
SETS, ROWS, CHANCE = 60, 4, 1.0e-4


def sampler(seed: int, mean: float, noise: float, tried: int = 5) -> Sampler:
    def draw(at: int) -> np.ndarray:
        return np.array([mean + noise * np.random.default_rng(at).normal()])

    made = Sampler(draw, seed)
    made.try_out(tried)
    return made


def row(a: Sampler, b: Sampler, remainder: float = 0.0) -> Row:
    return Row(
        check="slope",
        parameter="p",
        what="",
        a=a,
        b=b,
        of_a=lambda values: values[:, 0],
        of_b=lambda values: (values[:, 0], np.full(len(values), remainder)),
    )


def test_right_slopes_are_decided_with_little_more_than_it_takes() -> None:
    a = sampler(1, 1.0, 0.05)
    rows = [row(a, sampler(10 + i, 1.0, 0.05)) for i in range(3)]
    spend(rows, 60.0, TOLERANCE, LEVEL)
    assert all(r.decided and r.p_value == 1.0 for r in rows)
    # Two means of n batches: 2 (0.05)^2 / n <= (0.02 / 2.8)^2 at n = 98; a pilot of five batches tells that roughly.
    assert all(30 < len(s.batches) < 1500 for r in rows for s in (r.a, r.b))


def test_a_wrong_slope_is_found_among_right_ones() -> None:
    wrong = row(sampler(2, 0.9, 0.02), sampler(3, 1.0, 0.02))
    right = row(sampler(4, 1.0, 0.02), sampler(5, 1.0, 0.02))
    spend([right, wrong], 60.0, TOLERANCE, LEVEL)
    assert right.decided and not wrong.decided and wrong.p_value < 1e-3


def test_the_level_holds_over_all_looks_and_rows() -> None:
    # Slopes at the edge of the tolerance; short budgets end some runs after the first look, and some later.
    alarms = 0
    for i in range(SETS):
        a = sampler(1000 + i, 1.0 + TOLERANCE, 0.03)
        rows = [row(a, sampler(2000 + ROWS * i + j, 1.0, 0.03)) for j in range(ROWS)]
        spend(rows, 0.05, TOLERANCE, 0.9)
        alarms += any(ROWS * r.p_value <= 0.1 for r in rows)
    assert alarms <= stats.binom.ppf(1.0 - CHANCE, SETS, 0.1)


def test_what_does_not_change_is_not_seen() -> None:
    nothing = row(sampler(6, 0.0, 0.0), sampler(7, 0.0, 0.0))
    spend([nothing], 1.0, TOLERANCE, LEVEL)
    assert not nothing.seen and nothing.slope is None and not nothing.decided
    assert len(nothing.a.batches) == LEAST


def test_a_budget_that_is_too_small_says_how_much_would_do() -> None:
    small = row(sampler(8, 1.0, 1.0), sampler(9, 1.0, 1.0))
    spend([small], 1.0e-3, TOLERANCE, LEVEL)
    assert not small.decided and small.needed > 1.0e-3
    assert len(small.a.batches) == LEAST


def test_no_time_decides_where_the_remainder_is_too_large() -> None:
    inexact = row(sampler(11, 1.0, 0.01), sampler(12, 1.0, 0.01), remainder=0.05)
    spend([inexact], 0.2, TOLERANCE, LEVEL)
    assert inexact.needed == np.inf and not inexact.decided


def test_batches_go_to_the_noisier_side_and_cheap_rows_come_first() -> None:
    a, noisy, quiet = sampler(13, 1.0, 0.001), sampler(14, 1.0, 0.2), sampler(15, 1.0, 0.001)
    for s in (a, noisy, quiet):
        s.seconds, s.calls = 1.0, 1
    plan = Planning(TOLERANCE, (1.0 - LEVEL) / LOOKS)
    rows = [row(a, noisy), row(a, quiet)]
    assert plan.alone(rows[0]) > plan.alone(rows[1])
    counts = plan.counts(rows, 100.0, 0)
    assert counts[id(quiet)] == LEAST and counts[id(a)] < counts[id(noisy)] <= 100 - 2 * LEAST
    assert plan.counts(rows, 1.0e9, 0)[id(noisy)] < MOST


def test_a_bias_that_shorter_steps_do_not_show_is_none() -> None:
    # Long steps see a slope of 1.1: what they are compared with is off, whatever the remainder says.
    inexact = row(sampler(16, 1.0, 0.01), sampler(17, 0.9, 0.01))
    inexact.finer = sampler(18, 1.0, 0.02)
    spend([inexact], 60.0, TOLERANCE, LEVEL)
    assert inexact.finer is None and inexact.decided and inexact.p_value > 0.5
    assert abs(inexact.slope.value - 1.0) < 0.02


def test_a_bias_that_shorter_steps_show_too_is_one() -> None:
    wrong = row(sampler(19, 1.1, 0.01), sampler(20, 1.0, 0.01))
    wrong.finer = sampler(21, 1.0, 0.05)
    spend([wrong], 60.0, TOLERANCE, LEVEL)
    assert not wrong.decided and wrong.p_value < 1.0 - LEVEL
    assert len(wrong.b.batches) >= LEAST and wrong.b.seed == 21

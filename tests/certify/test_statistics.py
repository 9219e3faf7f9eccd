"""Slopes of batches: p-values are uniform where nothing is wrong, intervals cover, Holm, what noise cannot tell."""

import numpy as np
import pytest
from scipy import stats

from warp_psdr.certify.statistics import Batches, holm

#: Simulated certificates, and the probability with which a right program fails a test of theirs.
SETS, CHANCE = 400, 1.0e-4
LEVEL = 0.95


def batches(random, slope=1.0, remainder=0.0, of_a=0.2, of_b=0.4, counts=(9, 14), floor=0.0) -> Batches:
    a = slope + of_a * random.normal(size=counts[0])
    b = 1.0 + of_b * random.normal(size=counts[1])
    return Batches(a, b, np.full(counts[1], remainder), floor)


def test_p_values_of_right_derivatives_are_uniform() -> None:
    random = np.random.default_rng(1)
    found = [batches(random).p_value(0.0) for _ in range(SETS)]
    assert stats.kstest(found, "uniform").pvalue > CHANCE


def test_a_tolerance_and_a_remainder_are_no_bias() -> None:
    random = np.random.default_rng(2)
    # At the edge of what is right, 0.05 of the sets are called biased at most.
    for slope, remainder, tolerance in ((1.1, 0.0, 0.1), (0.9, 0.0, 0.1), (1.15, 0.05, 0.1), (0.85, -0.05, 0.1)):
        found = [batches(random, slope, remainder).p_value(tolerance) <= 0.05 for _ in range(SETS)]
        assert sum(found) <= stats.binom.ppf(1.0 - CHANCE, SETS, 0.05)


def test_intervals_cover_the_slope() -> None:
    random = np.random.default_rng(3)
    slopes = [batches(random, 1.3, of_b=0.9).slope(LEVEL) for _ in range(SETS)]
    covered = sum(s.low <= 1.3 <= s.high for s in slopes)
    assert stats.binom.ppf(CHANCE, SETS, LEVEL) <= covered <= stats.binom.ppf(1.0 - CHANCE, SETS, 0.99)


def test_interval_and_p_value_agree() -> None:
    # The tolerance is inside of the interval's far side exactly where the p-value is above 1 - level: normal data of
    # many batches, whose degrees of freedom hardly depend on the slope.
    random = np.random.default_rng(4)
    for _ in range(50):
        found = batches(random, 1.08, 0.01, counts=(60, 70))
        slope = found.slope(LEVEL)
        assert (slope.low > 1.02) == (found.p_value(0.02) <= 1.0 - LEVEL)


def test_a_bias_is_found_and_its_size_told() -> None:
    found = batches(np.random.default_rng(5), 0.9, of_a=0.02, of_b=0.02)
    assert found.p_value(0.02) < 1e-3
    assert abs(found.slope(LEVEL).value - 0.9) < 3.0 * found.slope(LEVEL).error
    assert not found.slope(LEVEL).within(0.02)


def test_the_sign_of_the_derivative_does_not_matter() -> None:
    found = batches(np.random.default_rng(6), 1.1, 0.02)
    other = Batches(-found.a, -found.b, -found.r)
    assert other.p_value(0.02) == found.p_value(0.02)
    assert other.slope(LEVEL) == found.slope(LEVEL)


def test_the_remainder_widens_the_interval_on_both_sides() -> None:
    random = np.random.default_rng(7)
    a, b = 1.0 + 0.01 * random.normal(size=(2, 12))
    narrow, wide = (Batches(a, b, np.full(12, r)).slope(LEVEL) for r in (0.0, 0.05))
    np.testing.assert_allclose([narrow.low - wide.low, wide.high - narrow.high], 0.05 / b.mean(), rtol=0.02)


def test_noise_alone_tells_nothing() -> None:
    noise = np.tile([1.0, -0.8], 4)
    slope = Batches(noise, noise, np.zeros(8)).slope(LEVEL)
    assert slope.low == -np.inf and slope.high == np.inf and not slope.within(0.5)


def test_differences_of_small_derivatives_are_relative_to_the_floor() -> None:
    random = np.random.default_rng(9)
    a, b = 0.01 + 0.01 * random.normal(size=(2, 40))  # of a parameter whose other directions have derivatives of 10
    found = Batches(a, b, np.zeros(40), floor=1.0)
    assert found.slope(LEVEL).within(0.02) and found.p_value(0.02) == 1.0
    wrong = Batches(a + 0.1, b, np.zeros(40), floor=1.0)
    assert wrong.p_value(0.02) < 1e-6 and abs(wrong.slope(LEVEL).value - 1.1) < 0.02


def test_numbers_without_noise() -> None:
    one = np.ones(8)
    assert Batches(one, one, 0.0 * one).p_value(0.02) == 1.0
    assert Batches(0.9 * one, one, 0.0 * one).p_value(0.02) == 0.0
    assert not Batches(0.0 * one, 0.0 * one, 0.0 * one).seen
    missing = Batches(0.0 * one, one, 0.0 * one)  # a derivative that the method does not have at all
    assert missing.seen and missing.p_value(0.02) == 0.0


def test_one_batch_that_holds_the_variance_is_noticed() -> None:
    random = np.random.default_rng(10)
    assert not any(batches(random, counts=(16, 16)).heavy for _ in range(SETS))
    a = 1.0 + 0.01 * random.normal(size=16)
    a[3] = 2.0
    assert Batches(a, np.ones(16), np.zeros(16)).heavy


@pytest.mark.parametrize(
    ("given", "adjusted"),
    [
        ([0.01, 0.04, 0.03, 0.005], [0.03, 0.06, 0.06, 0.02]),
        ([0.5, 0.9], [1.0, 1.0]),
        ([], []),
    ],
)
def test_holm(given, adjusted) -> None:
    np.testing.assert_allclose(holm(given), adjusted)

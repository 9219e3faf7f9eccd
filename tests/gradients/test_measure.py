"""The assertion of the gradient table fails where it has to."""

import numpy as np
import pytest

from .measure import BATCHES, Comparison, assert_agrees, assert_steps_agree


def batches(mean, noise=0.0, seed=0):
    return mean + noise * np.random.default_rng(seed).normal(size=BATCHES)


def test_equal_values_agree():
    assert_agrees(Comparison(batches(-2.0, 0.1), batches(-2.0, 0.1)))
    assert_agrees(Comparison(batches(2.0, 0.005, 1), batches(2.0, 0.005, 2)))


@pytest.mark.parametrize(
    ("comparison", "message"),
    [
        (Comparison(batches(0.0), batches(1.0)), "slope 0"),
        (Comparison(batches(-1.0), batches(1.0)), "slope -1"),
        (Comparison(batches(1.03), batches(1.0)), "slope 1.03"),
        (Comparison(batches(1.01), batches(1.0)), "z-test"),
        (Comparison(batches(0.0), batches(0.0)), "lost in noise"),
        (Comparison(batches(0.0), batches(0.0, 1.0)), "lost in noise"),
        (Comparison(batches(1.0, 0.1, 1), batches(1.0, 0.1, 2)), "too noisy"),
        (Comparison(batches(np.nan), batches(1.0)), "finite"),
    ],
)
def test_what_must_not_pass_fails(comparison, message):
    with pytest.raises(AssertionError, match=message):
        assert_agrees(comparison)


def test_a_difference_that_depends_on_its_step_fails():
    assert_steps_agree(batches(1.0, 0.01, 1), batches(1.001, 0.01, 2))
    with pytest.raises(AssertionError, match="depends on its step"):
        assert_steps_agree(batches(1.0, 0.01, 1), batches(1.1, 0.01, 2))

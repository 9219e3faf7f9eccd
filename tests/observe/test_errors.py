"""Error bars from residuals that go together: over some pixels, and over whole photographs."""

import numpy as np
import pytest

from warp_psdr.observe.errors import _widest

HEIGHT, WIDTH = 24, 32


def maps(scores):
    """Scores of one number, (photographs, H, W), as ``_widest`` takes them, and the inverse of H for their mean."""
    share = np.full(scores.shape[1:], 1.0 / scores.size)
    found = [(np.array([0]), np.stack([s, share]), np.ones(s.shape)) for s in scores]
    return found, np.array([[1.0 / scores.size]])


def test_independent_residuals_have_the_textbooks_bar():
    scores = np.random.default_rng(1).normal(size=(2, HEIGHT, WIDTH))
    covariance, freedom, _block = _widest(*maps(scores))
    # The widest of several estimates lies above, by some of their scatter.
    assert 1.0 < covariance[0, 0] * scores.size < 2.0
    assert freedom[0] >= 30


@pytest.mark.parametrize("edge", [3, 6])
def test_residuals_that_go_together_over_pixels_widen_bars(edge):
    coarse = np.random.default_rng(2).normal(size=(3, HEIGHT // edge, WIDTH // edge + 1))
    scores = np.kron(coarse, np.ones((edge, edge)))[:, :, :WIDTH]
    covariance, _freedom, block = _widest(*maps(scores))
    assert 0.7 < covariance[0, 0] * scores.size / edge**2 < 2.0
    assert block >= edge


def test_photographs_that_differ_as_wholes_are_left_out_as_wholes():
    rng, count = np.random.default_rng(3), 12
    apart = rng.normal(size=count)
    scores = (apart - apart.mean())[:, None, None] + 0.1 * rng.normal(size=(count, HEIGHT, WIDTH))
    covariance, freedom, block = _widest(*maps(scores))
    assert 0.7 < covariance[0, 0] / (apart.var(ddof=1) / count) < 1.5
    assert freedom[0] == count - 1 and block == WIDTH
    few, _freedom, _block = _widest(*maps(scores[:3]))
    assert few[0, 0] < 0.5 * apart[:3].var(ddof=1) / 3, "three photographs are too few to be left out"

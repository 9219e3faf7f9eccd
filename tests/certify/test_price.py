"""What gradients cost: seconds to relative errors, from batches."""

import math

import numpy as np
import pytest

from warp_psdr.certify.certificate import ERRORS
from warp_psdr.certify.price import price


def test_seconds_fall_with_the_square_of_the_error():
    rng, seconds = np.random.default_rng(5), 0.2
    gradient, deviation = rng.normal(size=4000), 0.5
    found = price("x", gradient + deviation * rng.normal(size=(5, 4000)), seconds)
    relative = deviation**2 * gradient.size / (gradient**2).sum()
    np.testing.assert_allclose(found.seconds, [seconds * relative / e**2 for e in ERRORS], rtol=0.1)
    assert found.cells()[0] == "x" and found.cells()[1].endswith(" s")


def test_noise_alone_has_no_price():
    noise = np.random.default_rng(6).normal(size=(5, 1))
    noise -= noise.mean()
    found = price("x", noise, 1.0)
    assert all(math.isinf(s) for s in found.seconds) and found.cells()[1:] == ("?",) * len(ERRORS)
    assert price("x", np.ones((5, 3)), 1.0).seconds == pytest.approx((0.0,) * len(ERRORS))

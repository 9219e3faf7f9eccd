"""No ray passes the surface of a grid, a network, a tube or a cone, from near and from 10^4 times its size away.

Random rays against tubes meet what float64 finds circle by circle (``dense.py``).
"""

import numpy as np
import pytest

from . import dense
from .crossings import BODIES, check

#: How many ``ROUNDING``s below the surface a ray that passes it may be.
ROUNDINGS = 1.0


@pytest.mark.slow
@pytest.mark.parametrize("far", [1.0, 300.0])
@pytest.mark.parametrize("name", BODIES)
def test_no_ray_passes_the_surface(name: str, far: float) -> None:
    random = np.random.default_rng(int(far))
    found = check(BODIES[name](random), random, 100_000, far)
    assert found.confirmed > 50_000
    assert found.deepest < ROUNDINGS, str(found)


@pytest.mark.parametrize("count", [60_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_no_random_ray_passes_a_tube(count: int) -> None:
    found = dense.check(np.random.default_rng(count), count)
    assert found.confirmed > 0.4 * count
    assert found.missed == 0, str(found)

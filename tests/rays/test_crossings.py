"""No ray passes the surface of a grid, a network, a tube or a cone, from near and from 10^4 times its size away."""

import numpy as np
import pytest

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

"""No ray at random passes a grid, a network or a cone deeper than rounding, by a dense search in float64."""

import numpy as np
import pytest

from .crossings import unit
from .dense_grids import KINDS, Body, Tally, check, cones_of, depths, traced


@pytest.mark.slow_rows("network")
@pytest.mark.parametrize("kind", KINDS)
def test_no_ray_passes(kind: str) -> None:
    random, tally = np.random.default_rng(2), Tally()
    for _body in range(5):
        check(KINDS[kind](random), random, 4_000, tally)
    assert tally.met > 4_000
    assert tally.deepest < 1.0, tally
    assert tally.farthest < 2.0, tally


@pytest.mark.slow_rows("network")
@pytest.mark.parametrize("kind", KINDS)
def test_the_search_finds_what_rays_miss(kind: str) -> None:
    """Rays that are said to meet nothing, or to meet it farther or nearer than they do."""
    random = np.random.default_rng(3)
    body = KINDS[kind](random)
    o, d, found, moved = (x[:2_000] for x in traced(body, random, 4_000))
    hit = found >= 0.0
    assert hit.sum() > 200
    for told in (np.full(len(found), -1.0), found + 0.01 * hit):
        deep = depths(body, o, d, told, moved)[0]
        assert (deep > 1.0)[hit].mean() > 0.5
        assert not (deep > 1.0)[~hit].any()
    off = depths(body, o, d, np.where(hit, 0.9 * found, found), moved)[1]
    assert (off > 1.0)[hit].mean() > 0.5


def test_rays_that_run_along_cones() -> None:
    """The point of such a ray that is next to the axis is hundreds of lengths away."""
    points = np.float32([[0.1, 0.2, 0.3, 0.2], [0.2, 0.25, 0.55, 0.17], [0.35, 0.2, 0.8, 0.22]])

    def rays(body: Body, random: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        node, other = body.nodes[[0, 1]] if random.random() < 0.5 else body.nodes[[1, 2]]
        around = unit(random.standard_normal((count, 3)))
        sine = np.exp(random.uniform(np.log(1e-5), np.log(1e-2), (count, 1)))
        w = random.choice([-1.0, 1.0], (count, 1)) * unit(unit(other - node) + sine * around)
        aim = node + random.random((count, 1)) * (other - node) + 0.25 * unit(random.standard_normal((count, 3)))
        return aim - np.exp(random.uniform(-3.0, 1.0, (count, 1))) * w, w

    body = cones_of(points, [0])
    o, d, found, moved = traced(body, np.random.default_rng(6), 50_000, rays)
    deep, off = depths(body, o, d, found, moved)
    assert (found >= 0.0).sum() > 5_000
    assert max(deep.max(), off.max()) < 1.0, (deep.max(), off.max())

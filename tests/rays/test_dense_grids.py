"""No ray at random passes a grid, a network or a cone deeper than rounding, by a dense search in float64."""

import numpy as np
import pytest

from .dense_grids import KINDS, Tally, check, depths, traced


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

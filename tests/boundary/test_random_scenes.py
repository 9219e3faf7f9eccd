"""Derivatives of scenes drawn at random: the seeds whose slopes a few samples tell to three hundredths."""

import pytest

from .measure import REMAINDER, STANDARD_ERRORS
from .random_scenes import LARGEST_ERROR, WORLDS, draw, measure
from .scenes import load

SEEDS = (77, 43, 65, 45, 67, 124, 62)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("seed", SEEDS)
def test_derivatives_equal_finite_differences(seed: int, mode: str) -> None:
    value, error, case = measure(draw(seed), mode)
    assert error <= LARGEST_ERROR, f"{case}: too noisy to tell: slope {value:.4f} +- {error:.4f}"
    assert abs(value - 1.0) <= STANDARD_ERRORS * error + REMAINDER, f"{case}: slope {value:.4f} +- {error:.4f}"


def test_a_seed_is_a_scene() -> None:
    for seed in range(len(WORLDS)):
        case = draw(seed)
        _scene, params = load(case.scene)
        assert all(params[n].numpy().size for n in case.names)
        again = draw(seed)
        assert (again.names, again.depth, again.hidden) == (case.names, case.depth, case.hidden)
        values = {n: params[n].numpy() for n in case.names}
        assert all((again.tangent(v) == case.tangent(v)).all() and case.tangent(v).any() for v in values.values())

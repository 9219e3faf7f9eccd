"""Two effects at once: pairs of ``together.py``, by the camera and by what each effect brings."""

import pytest

import warp_psdr as psdr

from .measure import REMAINDER, STANDARD_ERRORS
from .random_scenes import LARGEST_ERROR, measure
from .scenes import load
from .together import PAIRS, REFUSED, cases

#: Pairs whose derivatives a few samples tell to three hundredths.
MEASURED = [("checkers", "smoke"), ("mirror", "grid"), ("leaf", "sun"), ("glass", "sky"), ("mirror", "smoke")]


@pytest.mark.slow
@pytest.mark.parametrize("pair", MEASURED, ids=", ".join)
def test_derivatives_of_a_pair_equal_finite_differences(pair) -> None:
    for case in cases(*pair):
        value, error, taken = measure(case)
        assert error <= LARGEST_ERROR, f"{taken}: too noisy to tell: slope {value:.4f} +- {error:.4f}"
        assert abs(value - 1.0) <= STANDARD_ERRORS * error + REMAINDER, f"{taken}: slope {value:.4f} +- {error:.4f}"


def test_every_pair_is_taken_or_refused_with_a_sentence() -> None:
    for pair in PAIRS:
        for case in cases(*pair):
            scene, _params = load(case.scene)
            asked = {"names": list(case.names), "integrator": case.integrator()}
            if pair in REFUSED:
                with pytest.raises(ValueError, match=REFUSED[pair]):
                    psdr.plan(scene, **asked)
            else:
                assert psdr.plan(scene, **asked).boundary is not None

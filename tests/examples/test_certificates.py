"""Mitsuba's gradients under ``certify_function``: an albedo's are right, those of a hard shadow are found wrong."""

import pytest

import warp_psdr as psdr

pytestmark = pytest.mark.slow

BUDGET = 60.0


def test_a_right_and_a_wrong_gradient_of_mitsuba(modules) -> None:
    mi = pytest.importorskip("mitsuba")
    if "llvm_ad_rgb" not in mi.variants():
        pytest.skip("Mitsuba has no LLVM variant here")
    cases = modules("certificates_mitsuba")
    render, gradient, values, options = cases.renderers(2)["a hard shadow"]
    certificate = psdr.certify_function(render, gradient, values, budget=BUDGET, **options)
    assert certificate[cases.ALBEDO].verdict == "within"
    shift = certificate[cases.SHIFT]
    assert shift.verdict == "biased" and shift.slope.value < 0.9

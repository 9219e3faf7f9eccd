"""The benchmark of certificates: it goes on where it was stopped, and finds what is wrong in Mitsuba's gradients."""

from pathlib import Path

import pytest

import warp_psdr as psdr

BUDGET = 60.0


def test_certificates_that_are_done_are_kept(modules, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    certificates = modules("certificates")
    asked = []

    def verdict(case, seed, budget):
        asked.append(seed)
        return "within" if seed else "undecided"

    monkeypatch.setattr(certificates, "_verdict", verdict)
    kept = tmp_path / "kept.jsonl"
    assert certificates.alarms(1.0, kept, 2)[0]["certificates"] == 2 and asked == [0, 1]
    (row,) = certificates.alarms(1.0, kept, 3)
    assert asked == [0, 1, 2]
    assert row == {"certificates": 3, "within": 2, "undecided": 1, "not seen": 0, "biased": 0, "refused": 0}


@pytest.mark.slow
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

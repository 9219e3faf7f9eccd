"""Which method of the interior term takes the least time: pilots of those that can, reasons of those that cannot."""

import time

import numpy as np
import pytest

import warp_psdr as psdr
from tests.interior import test_resampled as resampled
from warp_psdr.accuracy.methods import ranked
from warp_psdr.accuracy.report import Report, TermReport

ALPHA = "ball.bsdf.alpha.value"
REPLAY = psdr.interior.Replay()


def report(variance: float, seconds: float, norm2: float) -> Report:
    term = TermReport(
        name="interior", spp=4, samples=1024, seconds=seconds, seconds_error=0.0, fixed_seconds=0.0,
        sample_seconds=seconds / 1024, setup_seconds=0.0, variance={"a": variance, "b": 0.0},
        variance_error={"a": 0.0, "b": 0.0}, exponent=1.0, exponent_error=0.0, largest=0.1, kurtosis=3.0,
    )  # fmt: skip
    norms = {"a": norm2, "b": 0.0}
    return Report(
        role="reverse", clock="cpu", batches=8, pilot_seconds=1.0, terms=(term,), norm2=norms, norm2_error=norms,
        seen=("a",), spread=0.1, measured=(), tile=0, deviations=(),
    )  # fmt: skip


def test_methods_are_ranked_by_variance_times_time_over_one_norm():
    slow, fast = psdr.interior.Replay(), psdr.interior.Resampled()
    rows = ranked({slow: report(4.0, 1.0, 6.0), fast: report(0.5, 3.0, 10.0)})
    assert [row.method for row in rows] == [fast, slow]
    # The norm is 8, and an error of 1 % takes variance / 8 / 1e-4 batches, and the pilot's own uncertainty more.
    expected = np.array([0.5 * 3.0, 4.0]) / 8.0 / 1e-4
    np.testing.assert_allclose([row.seconds for row in rows], expected, rtol=0.05)


def test_what_one_method_alone_estimates_needs_no_pilot():
    scene, params = resampled.load("metal")
    params.requires_grad_only("floor.bsdf.reflectance.value")
    found = psdr.interior.compare(scene, params, resampled.adjoint(), integrator=resampled.integrator(REPLAY))
    assert found.best == psdr.interior.Replay() and np.isnan(found.rows[0].seconds)
    assert [type(row.method).__name__ for row in found.rows[1:]] == [
        *("Resampled", "Antithetic", "Attached", "DifferentialRatioTracking")
    ]
    assert all("interior.Re" in row.refused for row in found.rows[1:])
    assert "shapes of lobes" in str(found)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "adjoint"),
        ({"adjoint": resampled.adjoint(), "clock": "sun"}, "clock: got 'sun'"),
        ({"adjoint": resampled.adjoint(), "seconds": 0.0}, "seconds"),
        ({"adjoint": resampled.adjoint(), "methods": [psdr.interior.Resampled()]}, "no method can"),
    ],
)  # fmt: skip
def test_what_cannot_be_compared_is_named(options, message):
    scene, params = resampled.load("metal")
    params.requires_grad_only("floor.bsdf.reflectance.value")
    with pytest.raises(ValueError, match=message):
        psdr.interior.compare(scene, params, **options)


@pytest.mark.slow
def test_the_best_method_for_a_roughness_is_found():
    """A ball of metal under a lamp and a sky, where resampled branches have a fraction of the noise."""
    scene, params = resampled.load("metal")
    params.requires_grad_only(ALPHA)
    found = psdr.interior.compare(
        scene, params, resampled.adjoint(), integrator=resampled.integrator(REPLAY), clock="cpu", seconds=2.0
    )
    times = {type(row.method).__name__: row.seconds for row in found.rows if not row.refused}
    assert set(times) == {"Replay", "Resampled"} and np.isfinite(list(times.values())).all()
    measured = {}
    for method in (REPLAY, psdr.interior.Resampled()):
        start = time.process_time()
        values = resampled.backward("metal", [ALPHA], method, range(24), spp=256)
        measured[type(method).__name__] = values.var(ddof=1) * (time.process_time() - start)
    ratio, other = (t["Replay"] / t["Resampled"] for t in (times, measured))
    assert abs(np.log(ratio / other)) < np.log(3.0), (times, measured)

"""A pilot's rounds: who gets the time, what two sizes of batches tell, and how certain a prediction is."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from warp_psdr.accuracy import pilot, statistics
from warp_psdr.accuracy.report import Report, TermReport
from warp_psdr.accuracy.rounds import LARGER, Rounds
from warp_psdr.accuracy.statistics import moments

Z = 4.0


def made_up(
    monkeypatch,
    *terms: tuple[float, float],
    exponent: float = 1.0,
    heavy: bool = False,
    components: int = 1,
    sample_seconds: float = 1e-3,
):
    """A quantity without a scene: terms of (standard deviation of a sample's component, fixed seconds)."""
    now = [0.0]
    monkeypatch.setitem(pilot.CLOCKS, "cpu", lambda: now[0])

    def part(number: int, deviation: float, fixed: float) -> SimpleNamespace:
        def run(spp: int, seed: int) -> np.ndarray:
            now[0] += fixed + sample_seconds * spp
            rng = np.random.default_rng((number, seed))
            if heavy:  # a sample in twenty carries all of the variance
                x = (
                    math.sqrt(20.0)
                    * (rng.random((spp, components)) < 0.05)
                    * rng.choice((-1.0, 1.0), (spp, components))
                )
                return 1.0 + deviation * x.mean(axis=0)
            return 1.0 + deviation * spp ** (-0.5 * exponent) * rng.normal(size=components)

        return SimpleNamespace(name=f"term {number}", run=run, prepare=None)

    what = SimpleNamespace(
        role="reverse", parts=tuple(part(i, *term) for i, term in enumerate(terms)), blocks={"x": slice(0, components)},
        raster=(1, 1, 0), finished=lambda x: x, adjoint=None, sensor=0, each=(),
        scene=SimpleNamespace(camera=lambda _sensor: SimpleNamespace(crop_width=1, crop_height=1)),
        plan=SimpleNamespace(interior=None, boundary=None, discontinuities=(), wanted=None),
    )  # fmt: skip
    what.tiled = lambda _tiling: what
    return what


def piloted(what, **options) -> Report:
    return pilot.run(what, **{"spp": None, "seed": 1, "seconds": 4.0, "tiles": False, "clock": "cpu"} | options)


def test_terms_that_do_not_vary_take_little_of_the_time(monkeypatch):
    # A derivative that is zero costs as much a sample as one that is not.
    what = made_up(monkeypatch, (0.3, 0.01), (0.0, 0.01), (0.01, 0.01))
    report = piloted(what)
    first, second, third = (t.seconds - t.fixed_seconds for t in report.terms)
    assert second < 0.3 * first and third < 0.3 * first
    assert report.batches > 30
    # Those that matter are worth what is fixed in their time.
    assert report.terms[0].spp >= 8


def test_batches_are_small_enough_for_many(monkeypatch):
    (term,) = piloted(made_up(monkeypatch, (0.3, 1e-4))).terms
    assert term.seconds < 2.0 * 4.0 / 64.0


@pytest.mark.slow
@pytest.mark.parametrize(("heavy", "gain"), [(True, 0.87), (False, 1.0)])
def test_both_sizes_tell_the_variance(monkeypatch, heavy, gain):
    what = made_up(monkeypatch, (1.0, 0.0), heavy=heavy)
    (run,), rng = (part.run for part in what.parts), np.random.default_rng(3)

    def told() -> tuple[float, float]:
        seeds = rng.integers(1 << 40, size=50)
        own = moments([[run(4, int(s)) for s in seeds[:40]]], [slice(0, 1)])
        other = moments([[run(16, int(s)) for s in seeds[40:]]], [slice(0, 1)])
        both = statistics.pooled(own, [other], np.array([4.0]), 2.0)
        return float(own.variance[0, 0]), float(both.variance[0, 0])

    own, both = np.array([told() for _ in range(1500)]).T
    for values in (own, both):
        assert abs(values.mean() - 0.25) < Z * values.std(ddof=1) / math.sqrt(len(values))
    assert both.std() < gain * own.std()


@pytest.mark.slow_rows("6")
@pytest.mark.parametrize("components", [1, 6])
def test_a_spread_is_how_far_predictions_lie_apart(monkeypatch, components):
    # A few batches lie close to one another by chance, and say that they are certain: none is more than normal ones.
    what, true = made_up(monkeypatch, (0.3, 0.0), components=components), 0.09 * components / 8
    deviates, spreads = [], []
    for seed in range(400):
        known = Rounds(what, [8], (2 * seed, 2 * seed + 1), pilot.CLOCKS["cpu"]).run(
            0.3, lambda _known: 0.0, pilot.CLOCKS["cpu"](), None
        )
        spreads.append(known.spread())
        norm2 = float(known.found.norm2[0])
        deviates.append(math.log(float(known.found.variance[0, 0]) / norm2 / (true / components)) / spreads[-1])
    assert 0.8 < np.std(deviates) < 1.2
    assert min(spreads) > 0.9 * math.sqrt(2.0 / components / known.found.batches)


def test_stratified_terms_have_larger_batches_in_every_round(monkeypatch):
    def rounds(exponent: float) -> Rounds:
        what = made_up(monkeypatch, (0.3, 0.0), exponent=exponent, components=20)
        found = Rounds(what, [8], (1, 2), pilot.CLOCKS["cpu"])
        found.run(2.0, lambda _known: 0.0, pilot.CLOCKS["cpu"](), None)
        return found

    for exponent, share in ((1.0, 0.3), (2.0, 0.7)):
        found = rounds(exponent)
        small, large = (len(batches[0]) for batches in found.kept)
        assert (large < share * small) if exponent == 1.0 else (share * small < large <= small)


@pytest.mark.parametrize("exponent", [1.0, 2.0])
def test_larger_batches_cost_and_vary_as_predicted(monkeypatch, exponent):
    # Samples along an edge are better together than other samples; what larger batches are worth is measured.
    what = made_up(monkeypatch, (0.2, 0.1), exponent=exponent, components=64, sample_seconds=0.01)
    found = piloted(what, spp=4, seed=2, seconds=40.0)
    (term,) = found.terms
    assert abs(term.exponent - exponent) < Z * term.exponent_error < 0.5
    (larger,) = found.fitted(seconds=0.26).terms
    assert 14 <= larger.spp <= 16 and larger.seconds == pytest.approx(0.1 + 0.01 * larger.spp)
    log_error = Z * math.hypot(term.exponent_error * math.log(4.0), term.variance_error["x"] / term.variance["x"])
    assert abs(math.log(larger.variance["x"] / (64 * 0.04 * larger.spp**-exponent))) < log_error < 0.5


def test_intervals_hold_the_error_of_the_exponent():
    term = TermReport(
        name="x", spp=4, samples=4, seconds=1.0, seconds_error=0.0, fixed_seconds=0.5, sample_seconds=0.125,
        setup_seconds=0.0, variance={"x": 1.0}, variance_error={"x": 0.1}, exponent=2.0, exponent_error=0.2,
        largest=0.1, kurtosis=2.0,
    )  # fmt: skip
    report = Report(
        role="reverse", clock="cpu", batches=40, pilot_seconds=0.0, terms=(term,), norm2={"x": 1.0},
        norm2_error={"x": 0.0}, seen=("x",), spread=0.1,
    )  # fmt: skip
    certain = replace(report, terms=(replace(term, exponent_error=0.0),))
    for error, factor in ((0.3, 1), (0.01, LARGER)):
        (fitted,) = report.fitted(error=error).terms
        assert fitted.spp == factor * term.spp
        wide, narrow = (math.log(high / low) for low, high in (r.seconds_interval(error) for r in (report, certain)))
        counted = 0.2 * (1.0 - (1.5 * 0.2) ** 2)  # Stein's
        assert narrow == pytest.approx(2.0 * 1.96 * 0.1)
        assert wide == pytest.approx(2.0 * 1.96 * math.hypot(0.1, counted * math.log(factor)))

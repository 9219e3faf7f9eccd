"""Budgets: what they reach, and that stopping does not choose among outcomes."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import warp_psdr as psdr
from tests.accuracy.test_accuracy import ALBEDO, INTEGRATOR, POSITIONS, Z, adjoint, tangents
from tests.boundary import scenes
from warp_psdr.accuracy import Reached, Report, TermReport, budget, pilot
from warp_psdr.accuracy import report as budget_report

#: Two terms of the made-up quantity: mean of a batch, seconds of a batch.
MEANS, SECONDS = (1.0, 0.3), (1.0, 0.5)
RUNS = 3000


class Clock:
    """Time that passes when it is told to."""

    now = 0.0


def term_of_size(mean: float, seconds: float, clock: Clock):
    """Means of samples with the exponential distribution, skewed, that take the longer the larger they are."""

    def run(spp: int, seed: int) -> np.ndarray:
        x = mean * np.random.default_rng(seed).gamma(spp) / spp
        clock.now += seconds * spp * x / mean
        return np.array([x])

    return SimpleNamespace(name=f"term {mean}", run=run)


def made_up(monkeypatch) -> tuple[SimpleNamespace, Report]:
    """A quantity without a scene, and the report of a pilot that was right."""
    clock = Clock()
    monkeypatch.setitem(pilot.CLOCKS, "cpu", lambda: clock.now)
    parts = tuple(term_of_size(m, s, clock) for m, s in zip(MEANS, SECONDS, strict=True))
    what = SimpleNamespace(
        role="reverse", parts=parts, blocks={"x": slice(0, 1)}, raster=(1, 1, 0), finished=lambda x: x
    )
    terms = tuple(
        TermReport(
            name=part.name, spp=1, samples=1, seconds=s, seconds_error=0.0, fixed_seconds=0.0, sample_seconds=s,
            setup_seconds=0.0, variance={"x": m * m}, variance_error={"x": 0.0}, exponent=1.0, exponent_error=0.0,
            largest=0.1, kurtosis=2.0,
        )
        for part, m, s in zip(parts, MEANS, SECONDS, strict=True)
    )  # fmt: skip
    report = Report(
        role="reverse", clock="cpu", batches=4, pilot_seconds=0.0, terms=terms, norm2={"x": sum(MEANS) ** 2},
        norm2_error={"x": 0.0}, seen=("x",), spread=0.1,
    )  # fmt: skip
    return what, report


def deviate(values, truth: float) -> float:
    values = np.asarray(values)
    return (values.mean() - truth) / (values.std(ddof=1) / math.sqrt(len(values)))


@pytest.mark.slow
def test_stopping_at_an_error_does_not_choose(monkeypatch):
    # A relative error is estimated low where the mean is high by chance: a rule that looks at the estimate which it
    # stops stops early there. The halves do not.
    what, report = made_up(monkeypatch)
    found, rounds, naive = [], set(), []
    for seed in range(RUNS):
        values, reached = budget.spend(what, budget.Budget(0.3, None, report), seed=seed, progress=None)
        found.append(values[0])
        rounds.add(tuple(reached.batches.values()))
        half = budget._Half(what, report, report, seed)
        counts = np.ones(2)
        half.run(counts)
        while half.error(counts) > 0.5:
            counts += 1.0
            half.run(counts)
        naive.append(half.mean()[0])
    assert len(rounds) > 3  # it does stop at different times
    assert abs(deviate(found, sum(MEANS))) < Z
    assert deviate(naive, sum(MEANS)) > 1.25 * Z  # and this test would see it


@pytest.mark.slow
@pytest.mark.parametrize("enough", [math.inf, pytest.param(2.0, marks=pytest.mark.slow)])
def test_stopping_at_a_time_does_not_choose(monkeypatch, enough):
    # Large values take long here: whoever counts a round that ends late, or starts none that might, prefers some.
    what, report = made_up(monkeypatch)
    monkeypatch.setattr(budget_report, "ENOUGH_FOR_TIME", enough)
    found, rounds = [], set()
    for seed in range(RUNS if enough == math.inf else RUNS // 3):
        values, reached = budget.spend(what, budget.Budget(None, 7.5, report), seed=seed, progress=None)
        found.append(values[0])
        rounds.add(tuple(reached.batches.values()))
    assert len(rounds) >= 3
    assert abs(deviate(found, sum(MEANS))) < Z


@pytest.mark.slow
def test_reported_error_is_that_of_the_estimates(monkeypatch):
    what, report = made_up(monkeypatch)
    for wanted in (budget.Budget(0.1, None, report), budget.Budget(None, 100.0, report)):
        found = [budget.spend(what, wanted, seed=seed, progress=None) for seed in range(300)]
        true = math.sqrt(np.mean([(values[0] / sum(MEANS) - 1.0) ** 2 for values, _reached in found]))
        said = math.sqrt(np.mean([reached.error**2 for _values, reached in found]))
        assert said == pytest.approx(true, rel=0.15)  # 300 squared deviates: 8 %, and their own estimates
        if wanted.error is not None:
            assert true == pytest.approx(wanted.error, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("target", [0.2, 0.1])
def test_an_error_takes_its_time_and_no_more(monkeypatch, target):
    # Where the pilot was right; what is run beyond what was needed is wasted.
    what, report = made_up(monkeypatch)
    report = replace(report, batches=100, terms=tuple(replace(t, kurtosis=9.0) for t in report.terms))
    found = [budget.spend(what, budget.Budget(target, None, report), seed=seed, progress=None) for seed in range(600)]
    true = math.sqrt(np.mean([(values[0] / sum(MEANS) - 1.0) ** 2 for values, _reached in found]))
    assert true == pytest.approx(target, rel=0.09)  # 600 squared deviates: 3 %
    seconds = np.mean([reached.seconds for _values, reached in found])
    assert seconds == pytest.approx(report.seconds_to(target), rel=0.05)


def test_halves_are_weighed_as_they_are_counted(monkeypatch):
    what, report = made_up(monkeypatch)
    values, reached = budget.spend(what, budget.Budget(0.02, None, report), seed=1, progress=None)
    n = np.array(list(reached.spp.values()))
    np.testing.assert_allclose(n @ SECONDS, report.seconds_to(0.02), rtol=0.35)
    assert max(reached.batches.values()) < 0.3 * n.max()  # larger batches than the pilot's
    assert abs(values[0] - sum(MEANS)) < 5.0 * 0.02 * sum(MEANS)


def test_the_pilot_counts_less_of_other_sizes(monkeypatch):
    what, report = made_up(monkeypatch)
    report = replace(report, terms=tuple(replace(t, kurtosis=3.0) for t in report.terms))
    many = replace(report, terms=tuple(replace(t, kurtosis=1.1) for t in report.terms))
    drift2 = (budget.DRIFT * math.log(4.0)) ** 2
    for found, larger, known in (
        (report, 1, 3.0),
        (report, 4, 2.0 / (2.0 / 3.0 + drift2)),
        (many, 4, 0.1 / (0.1 / 3.0 + drift2)),  # batches that tell much by themselves
    ):
        now = replace(found, terms=tuple(replace(t, spp=larger * t.spp) for t in found.terms))
        half = budget._Half(what, now, found, 1)
        half.run(np.array([5.0, 5.0]))
        own = np.array([sums.variance() for sums in half.terms])
        prior = np.array([[m * m] for m in MEANS])
        np.testing.assert_allclose(half.variances(), (known * prior + 4.0 * own) / (known + 4.0))


def test_a_short_time_buys_one_round_and_fills_a_long_one(monkeypatch):
    what, report = made_up(monkeypatch)
    _values, reached = budget.spend(what, budget.Budget(None, 1e-3, report), seed=1, progress=None)
    assert list(reached.batches.values()) == [1, 1]
    seen = []
    _values, reached = budget.spend(what, budget.Budget(None, 400.0, report), seed=1, progress=seen.append)
    assert 0.8 * 400.0 < reached.seconds <= 400.0 * 1.1
    assert seen == sorted(seen) and seen[-1] == 1.0


# -- with a scene ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def soft():
    scene, params = scenes.load("soft")
    params.requires_grad(POSITIONS, ALBEDO)
    return scene, params


@pytest.fixture(scope="module")
def report(soft):
    return psdr.accuracy(*soft, adjoint(), integrator=INTEGRATOR, clock="cpu", seconds=1.5, seed=3, spp=4)


def gradient(soft, **options) -> tuple[Reached | None, dict[str, np.ndarray]]:
    scene, params = soft
    params.zero_grad()
    reached = psdr.render_backward(scene, params, adjoint(), integrator=INTEGRATOR, **options)
    return reached, {name: params[name].grad.numpy().reshape(-1).astype(np.float64) for name in (POSITIONS, ALBEDO)}


def relative_error(found, reference) -> float:
    squares = [((found[n] - reference[n]) ** 2).sum() / (reference[n] ** 2).sum() for n in reference]
    return math.sqrt(np.mean(squares))


@pytest.fixture(scope="module")
def reference(soft):
    runs = [gradient(soft, spp=2048, seed=10_000 + i)[1] for i in range(2)]
    return {name: np.mean([run[name] for run in runs], axis=0) for name in runs[0]}


def test_gradients_reach_the_error(soft, report, reference):
    for target in (0.1, 0.06):
        found = [gradient(soft, target_error=target, report=report, seed=s) for s in range(6)]
        errors = math.sqrt(np.mean([relative_error(g, reference) ** 2 for _r, g in found]))
        assert 0.6 * target < errors < 1.4 * target  # six runs
        assert all(r.error <= 1.25 * target for r, _g in found)  # a pilot's, of the sizes that are run


def test_a_report_makes_the_gradient_a_function_of_the_seed(soft, report):
    (first, a), (again, b), (_other, c) = (
        gradient(soft, target_error=0.1, report=report, seed=s) for s in (5, 5, 6)
    )  # fmt: skip
    assert first.batches == again.batches and first.pilot_seconds == 0.0
    for name in a:
        np.testing.assert_array_equal(a[name], b[name])
        assert not np.array_equal(a[name], c[name])


def test_gradients_add_to_what_is_there(soft, report):
    scene, params = soft
    _reached, once = gradient(soft, target_error=0.2, report=report, seed=5)
    psdr.render_backward(scene, params, adjoint(), integrator=INTEGRATOR, target_error=0.2, report=report, seed=5)
    for name, g in once.items():
        np.testing.assert_allclose(params[name].grad.numpy().reshape(-1), 2.0 * g, rtol=1e-6)


def test_a_time_runs_its_own_pilot(soft, reference):
    reached, found = gradient(soft, time_budget=1.0, seed=2)
    assert reached.pilot_seconds > 0.0
    assert relative_error(found, reference) < 5.0 * reached.error
    assert set(reached.spp) == {"interior", "primary boundary", "direct boundary"}


def test_without_a_budget_nothing_is_returned(soft):
    assert gradient(soft, spp=1)[0] is None


@pytest.mark.slow
def test_images_reach_the_error(soft):
    scene, params = soft
    long = psdr.render(scene, integrator=INTEGRATOR, spp=2048, seed=77).numpy()
    bought: list[Reached] = []
    image = psdr.render(scene, integrator=INTEGRATOR, target_error=0.01, reached=bought.append, seed=1).numpy()
    error = np.linalg.norm(image - long) / np.linalg.norm(long)
    assert bought[0].error <= 0.0125 and 0.005 < error < 0.015
    options = {"integrator": INTEGRATOR, "seed": 1}
    long = psdr.render_forward(scene, params, tangents(params), spp=1024, **options).numpy()
    image = psdr.render_forward(
        scene, params, tangents(params), target_error=0.1, reached=bought.append, **options
    ).numpy()
    assert 0.04 < np.linalg.norm(image - long) / np.linalg.norm(long) < 0.15
    assert bought[1].error <= 0.125


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spp": 4, "target_error": 0.1}, "spp and target_error exclude each other"),
        ({"spp": 4, "time_budget": 0.1}, "spp and time_budget exclude each other"),
        ({"target_error": 0.1, "time_budget": 1.0}, "target_error and time_budget exclude each other"),
        ({"target_error": 0.0}, r"target_error: got 0\.0, expected a positive number"),
        ({"target_error": True}, "target_error: got True"),
        ({"time_budget": math.inf}, "time_budget: got inf"),
        ({"target_error": 0.1, "report": 3}, "report: got int, expected what psdr.accuracy returned"),
        ({"target_error": 0.1, "seed": -1}, "seed: got -1"),
    ],
)
def test_what_is_out_of_range_is_named(soft, options, message):
    with pytest.raises(ValueError, match=message):
        gradient(soft, **options)


def test_a_report_of_something_else_is_refused(soft, report):
    scene, params = soft
    with pytest.raises(ValueError, match="report: its role are reverse, expected primal"):
        psdr.render(scene, integrator=INTEGRATOR, target_error=0.1, report=report)
    with pytest.raises(ValueError, match="report: needed with target_error or time_budget only"):
        psdr.render(scene, integrator=INTEGRATOR, spp=1, report=report)
    params.requires_grad_only(ALBEDO)
    try:
        with pytest.raises(ValueError, match=r"run psdr\.accuracy for this call"):
            psdr.render_backward(scene, params, adjoint(), integrator=INTEGRATOR, target_error=0.1, report=report)
    finally:
        params.requires_grad_only(POSITIONS, ALBEDO)


def test_a_tape_takes_samples(soft):
    import warp as wp

    scene, params = soft
    with pytest.raises(ValueError, match="tape: a recorded image takes spp"):
        psdr.render(scene, params, integrator=INTEGRATOR, target_error=0.1, tape=wp.Tape())


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"target_error": 0.2}, {"time_budget": 0.15}])
def test_the_mean_of_many_budgeted_gradients_is_the_gradient(soft, options, monkeypatch):
    # Own pilots with their tilings, allocations and stopping, all of it.
    monkeypatch.setattr(budget, "ERROR_PILOT", 0.2)
    spent = [gradient(soft, seed=s, **options)[1] for s in range(48)]
    plain = [gradient(soft, spp=512, seed=20_000 + s)[1] for s in range(16)]
    rng = np.random.default_rng(4)
    for name in plain[0]:
        directions = rng.normal(size=(plain[0][name].size, 6))
        a, b = (np.array([run[name] @ directions for run in runs]) for runs in (spent, plain))
        error = np.sqrt(a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b))
        assert (np.abs(a.mean(axis=0) - b.mean(axis=0)) < Z * error).all()
        assert (error < 0.1 * np.abs(b.mean(axis=0)).max()).all()

"""The pilot and its report: variances, predictions, batches that add up to what the drivers return."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

import warp_psdr as psdr
from tests.boundary import scenes
from warp_psdr.accuracy import Report, pilot, quantity, rounds, tiles
from warp_psdr.accuracy.allocation import FLOOR, batches_for_error, batches_for_time, efficiency
from warp_psdr.accuracy.statistics import Running, jackknife, moments

POSITIONS, ALBEDO = "occluder.vertex_positions", "floor.bsdf.reflectance.value"
INTEGRATOR = psdr.PathIntegrator(max_depth=2)
#: Largest deviate of a z-test whose seed is fixed: one value in 15,000.
Z = 4.0


def adjoint():
    w = np.random.default_rng(1).normal(1.0, 1.0, (scenes.SIZE, scenes.SIZE, 3)).astype(np.float32)
    w[:6] = 0.0
    return w


@pytest.fixture(scope="module")
def soft():
    scene, params = scenes.load("soft")
    params.requires_grad(POSITIONS, ALBEDO)
    return scene, params


@pytest.fixture(scope="module")
def report(soft):
    return psdr.accuracy(*soft, adjoint(), integrator=INTEGRATOR, clock="cpu", seed=3)


def tangents(params):
    return {POSITIONS: np.broadcast_to(np.float32([1.0, 0.5, 0.3]), params[POSITIONS].numpy().shape)}


# -- statistics -----------------------------------------------------------------------------------------------------


def draws(repeat, batches=6):
    """Two terms of three components in two blocks, with known means and variances; skewed."""
    rng = np.random.default_rng(5)
    scale = np.array([[1.0, 0.5, 2.0], [0.3, 1.5, 0.1]])
    mean = np.array([[0.4, -0.2, 1.0], [0.1, 0.3, -0.5]])
    x = mean[:, None] + scale[:, None] * (rng.exponential(size=(repeat, 2, batches, 3)) - 1.0)
    return x, [slice(0, 2), slice(2, 3)], scale**2, mean.sum(axis=0)


def test_variances_and_norms_are_unbiased():
    x, blocks, variance, mean = draws(4000)
    found = [moments([list(term) for term in run], blocks) for run in x]
    expected = np.stack([variance[:, b].sum(axis=1) for b in blocks], axis=1)
    norms = np.array([mean[b] @ mean[b] for b in blocks])
    for values, truth in (
        (np.array([m.variance for m in found]), expected),
        (np.array([m.norm2 for m in found]), norms),
    ):
        error = values.std(axis=0, ddof=1) / math.sqrt(len(values))
        assert (np.abs(values.mean(axis=0) - truth) < Z * error).all()


def test_leaving_out_is_what_it_says():
    x, blocks, _variance, _mean = draws(1)
    whole = moments([list(term) for term in x[0]], blocks)
    for b in range(x.shape[2]):
        rest = moments([list(np.delete(term, b, axis=0)) for term in x[0]], blocks)
        np.testing.assert_allclose(whole.variance_without[b], rest.variance, rtol=1e-9)
        np.testing.assert_allclose(whole.norm2_without[b], rest.norm2, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_a_batch_that_stands_out_is_seen(report):
    x = np.random.default_rng(6).normal(size=(1, 20, 50))
    even = moments([list(x[0])], [slice(0, 50)])
    x[0, 7] += 10.0
    odd = moments([list(x[0])], [slice(0, 50)])
    assert even.largest[0] < 0.15 < 0.8 < odd.largest[0] < 1.0
    assert even.kurtosis[0] < 1.2 and odd.kurtosis[0] > 10.0
    # What this pilot met is chance: start from none.
    report = replace(report, batches=24, terms=tuple(replace(t, largest=0.1, kurtosis=2.0) for t in report.terms))
    assert "Rare large samples" not in str(report) and report.heavy_tailed == ()
    for change in ({"largest": 0.6}, {"kurtosis": 6.0}):
        changed = replace(report, terms=(replace(report.terms[0], **change), *report.terms[1:]))
        assert changed.heavy_tailed == ("interior",)
        assert "% of the variance of 'interior'" in str(changed) and "unreliable" in str(changed)
        assert replace(changed, batches=8).heavy_tailed == (() if "largest" in change else ("interior",))
    share = report.time_share
    assert share.sum() == pytest.approx(1.0) and share[0] > 0.05


def test_kurtosis_is_that_of_the_distribution():
    rng = np.random.default_rng(7)
    for values, truth in ((rng.normal(size=40_000), 3.0), (rng.laplace(size=40_000), 6.0)):
        assert moments([list(values[:, None])], [slice(0, 1)]).kurtosis[0] == pytest.approx(truth, rel=0.1)
    vectors = rng.normal(size=(20_000, 4))
    assert moments([list(vectors)], [slice(0, 4)]).kurtosis[0] == pytest.approx(1.0 + 2.0 / 4.0, rel=0.05)


def test_jackknife_finds_the_spread_of_a_variance():
    x, blocks, _variance, _mean = draws(1000, batches=40)
    found = [moments([list(term) for term in run], blocks) for run in x]
    true = np.std([m.variance for m in found], axis=0, ddof=1)
    guess = np.sqrt(np.mean([m.variance_error**2 for m in found], axis=0))
    np.testing.assert_allclose(guess, true, rtol=0.15)
    assert jackknife(np.ones((5, 2))).tolist() == [0.0, 0.0]


def test_running_sums_agree_with_kept_batches():
    x, blocks, _variance, _mean = draws(1)
    sums, more = Running(blocks), Running(blocks)
    for i, batch in enumerate(x[0, 0]):
        (sums if i < 2 else more).add(batch, batch)
    sums.merge(more)
    np.testing.assert_allclose(sums.variance(), moments([list(x[0, 0])], blocks).variance[0], rtol=1e-9)
    np.testing.assert_allclose(sums.total / sums.count, x[0, 0].mean(axis=0))


# -- allocation -----------------------------------------------------------------------------------------------------

COST, VARIANCE = np.array([1.0, 0.2, 3.0]), np.array([0.5, 4.0, 0.01])


def test_no_split_is_better():
    best = float(efficiency(COST, VARIANCE))
    n = batches_for_time(COST, VARIANCE, 500.0)
    np.testing.assert_allclose([n @ COST, (VARIANCE / n).sum() * 500.0], [500.0, best], rtol=1e-9)
    for split in np.random.default_rng(2).uniform(0.5, 2.0, (100, 3)) * n:
        assert (VARIANCE / split).sum() * (split @ COST) >= best


def test_error_and_time_are_inverse_also_where_terms_keep_their_least():
    for error in (2.0, 1.0, 0.3, 0.05):
        n = batches_for_error(COST, VARIANCE, error)
        assert (n >= 2.0).all()
        if (n > 2.0).any():
            np.testing.assert_allclose((VARIANCE / n).sum(), error**2, rtol=1e-9)
            np.testing.assert_allclose(batches_for_time(COST, VARIANCE, float(n @ COST)), n, rtol=1e-6)


def test_a_term_without_variance_gets_the_least():
    n = batches_for_error(COST, np.array([0.5, 0.0, 0.01]), 0.01)
    assert n[0] > 100.0
    # What the pilot has not met is not known to be nothing: a hundredth of the time.
    assert n[1] * COST[1] == pytest.approx(FLOOR * (n[0] * COST[0] + n[2] * COST[2]), rel=0.02)
    np.testing.assert_allclose([0.5 / n[0] + 0.01 / n[2]], 1e-4, rtol=1e-9)
    few = batches_for_error(COST, np.array([0.5, 0.0, 0.01]), 0.3)
    assert few[1] == 2.0


# -- batches --------------------------------------------------------------------------------------------------------


def test_terms_add_up_to_the_gradient(soft):
    scene, params = soft
    what = quantity.gradient(scene, params, adjoint(), integrator=INTEGRATOR, sensor=0)
    assert [p.name for p in what.parts] == ["interior", "primary boundary", "direct boundary"]
    params.zero_grad()
    psdr.render_backward(scene, params, adjoint(), integrator=INTEGRATOR, spp=8, seed=4)
    total = sum(part.run(8, 4) for part in what.parts)
    for name, block in what.blocks.items():
        expected = params[name].grad.numpy().reshape(-1)
        np.testing.assert_allclose(total[block], expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


@pytest.mark.slow
def test_terms_add_up_to_the_derivative_image(soft):
    scene, params = soft
    what = quantity.derivative(scene, params, tangents(params), integrator=INTEGRATOR, sensor=0)
    image = psdr.render_forward(scene, params, tangents(params), integrator=INTEGRATOR, spp=8, seed=4).numpy()
    total = sum(part.run(8, 4) for part in what.parts)
    np.testing.assert_allclose(total.reshape(image.shape), image, rtol=1e-4, atol=1e-5 * np.abs(image).max())


@pytest.mark.slow_rows("soft", "silhouette box")
@pytest.mark.parametrize("name", ["silhouette box", "soft"])
def test_an_image_is_one_term(name):
    scene, _params = scenes.load(name)
    what = quantity.image(scene, integrator=INTEGRATOR, sensor=0)
    image = psdr.render(scene, integrator=INTEGRATOR, spp=8, seed=4).numpy()
    total = what.finished(what.parts[0].run(8, 4)).reshape(image.shape)
    np.testing.assert_allclose(total, image, rtol=1e-5, atol=1e-6)


def checkered(what):
    """Tiles of 5 pixels with all counts in turn, border tiles included."""
    width, height, _margin = what.raster
    count = -(-width // 5) * -(-height // 5)
    return tiles.from_exponents(what, 5, [i % 5 - 2 for i in range(count)])


def means_agree(a, b):
    """z-test of the means of two sets of batches: of every component, and of their squared deviates."""
    a, b = np.array(a), np.array(b)
    noise = a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b)
    used = noise > 1e-3 * noise.max()  # less is a rare event in a filter's tail, and no normal deviate
    z = (a.mean(axis=0) - b.mean(axis=0))[used] / np.sqrt(noise[used])
    assert used.any()
    assert np.abs(z).max() < Z + 1.5  # Student's t of two dozen batches, hundreds of components
    total = (a.sum(axis=1).mean() - b.sum(axis=1).mean()) / math.sqrt(
        a.sum(axis=1).var(ddof=1) / len(a) + b.sum(axis=1).var(ddof=1) / len(b)
    )
    assert abs(total) < Z


def test_tiles_leave_gradients_unbiased(soft):
    scene, params = soft
    what = quantity.gradient(scene, params, adjoint(), integrator=INTEGRATOR, sensor=0)
    tiled = what.tiled(checkered(what))
    batches = [[q.parts[0].run(8, 100 * i + b) for b in range(24)] for i, q in enumerate((what, tiled))]
    means_agree(*batches)


@pytest.mark.slow_rows("silhouette box")
@pytest.mark.parametrize("name", ["silhouette box", "soft"])
def test_tiles_leave_images_unbiased(name):
    # Under the tent filter of the second, neighbouring tiles share samples.
    scene, _params = scenes.load(name)
    what = quantity.image(scene, integrator=INTEGRATOR, sensor=0)
    tiled = what.tiled(checkered(what))
    batches = [[q.finished(q.parts[0].run(64, 100 * i + b)) for b in range(24)] for i, q in enumerate((what, tiled))]
    means_agree(*batches)


def test_pixels_without_an_adjoint_are_not_run(soft):
    scene, params = soft
    what = quantity.gradient(scene, params, adjoint(), integrator=INTEGRATOR, sensor=0)
    even = tiles.uniform(what)
    assert even.samples(4) == 4 * (scenes.SIZE - 6) * scenes.SIZE
    pixels = np.concatenate([pixels.numpy() for pixels, _count, _weight in even.launches(4, 0, "cpu")])
    assert sorted(pixels) == list(range(6 * scenes.SIZE, scenes.SIZE**2))
    nothing = quantity.gradient(scene, params, np.zeros_like(adjoint()), integrator=INTEGRATOR, sensor=0)
    assert tiles.uniform(nothing).launches(4, 0, "cpu") == []


def test_tiles_follow_the_adjoint(soft):
    # All of the adjoint in one corner: samples go there, the rest keeps a few.
    scene, params = soft
    w = np.full_like(adjoint(), 0.01)
    w[8:, 8:] = 1.0
    what = quantity.gradient(scene, params, w, integrator=INTEGRATOR, sensor=0)
    found = tiles.measured(replace(what, blocks={ALBEDO: what.blocks[ALBEDO]}), 16, range(6))
    assert found is not None and found[0] == 8
    exponents = tiles.spread(what, *found).exponents.reshape(w.shape[:2])
    assert exponents[8:, 8:].min() > exponents[:8].max()
    assert exponents.min() >= math.log2(tiles.EVEN) - 0.5


def test_pixels_follow_the_adjoint_within_a_tile(soft):
    scene, params = soft
    w = np.full_like(adjoint(), 0.01)
    w[5, 3] = 1.0
    what = quantity.gradient(scene, params, w, integrator=INTEGRATOR, sensor=0)
    exponents = tiles.spread(what, 8, np.ones(tiles.tile_count(what, 8))).exponents.reshape(w.shape[:2])
    rest = np.delete(exponents.reshape(-1), 5 * scenes.SIZE + 3)
    assert (rest == rest[0]).all() and exponents[5, 3] >= rest[0] + 4


def test_every_pixel_is_met_as_often_as_its_weight_says(soft):
    # Less than a sample a pixel: of the pixels of a power, every (n/k)-th from a random start on.
    scene, params = soft
    what = quantity.gradient(scene, params, np.ones_like(adjoint()), integrator=INTEGRATOR, sensor=0)
    count = tiles.tile_count(what, 5)
    thinned = tiles.from_exponents(what, 5, [-(i % 4) for i in range(count)])
    met, runs = np.zeros(scenes.SIZE**2), 4000
    for seed in range(runs):
        for pixels, samples, weight in thinned.launches(2, 7919 * seed, "cpu"):
            np.add.at(met, pixels.numpy(), samples * weight / runs)
    wanted = np.maximum(2.0 * 2.0**thinned.exponents, 1.0)
    assert wanted.min() == 1.0 and wanted.max() == 2.0
    # A pixel that is met with the probability 1 / weight, at least 1 / 4: standard error of what it adds up to.
    assert np.abs(met - wanted).max() < (Z + 0.5) * math.sqrt(3.0 / runs)
    assert thinned.samples(2) < 0.6 * 2 * scenes.SIZE**2


@pytest.mark.slow
@pytest.mark.parametrize("role", ["reverse", "forward"])
def test_thinned_batches_are_unbiased(soft, role):
    scene, params = soft
    if role == "reverse":
        what = quantity.gradient(scene, params, adjoint(), integrator=INTEGRATOR, sensor=0)
    else:
        what = quantity.derivative(scene, params, tangents(params), integrator=INTEGRATOR, sensor=0)
    thinned = what.tiled(tiles.from_exponents(what, 5, [-(i % 4) for i in range(tiles.tile_count(what, 5))]))
    batches = [[q.parts[0].run(1, 1000 * i + b) for b in range(150)] for i, q in enumerate((what, thinned))]
    a, b = (np.array(x).sum(axis=1) for x in batches) if role == "forward" else (np.array(x) for x in batches)
    noise = np.sqrt(a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b))
    used = noise > 1e-3 * noise.max()
    assert (np.abs(a.mean(axis=0) - b.mean(axis=0))[used] < Z * noise[used]).all()


# -- the report -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_report_predicts_the_scatter_of_gradients(soft):
    # The scatter of gradients of the batches' sizes, drawn otherwise and with other seeds, is the predicted variance.
    scene, params = soft
    report = psdr.accuracy(scene, params, adjoint(), integrator=INTEGRATOR, clock="cpu", tiles=False, spp=16, seed=8)
    runs = []
    for seed in range(64):
        params.zero_grad()
        psdr.render_backward(scene, params, adjoint(), integrator=INTEGRATOR, spp=16, seed=900 + seed)
        runs.append({name: params[name].grad.numpy().reshape(-1).astype(float) for name in (POSITIONS, ALBEDO)})
    for name in (POSITIONS, ALBEDO):
        x = np.array([run[name] for run in runs])
        squares = ((x - x.mean(axis=0)) ** 2).sum(axis=1)
        error = math.hypot(squares.std(ddof=1) / 8.0, sum(t.variance_error[name] for t in report.terms))
        assert abs(squares.sum() / 63.0 - sum(t.variance[name] for t in report.terms)) < Z * error
        assert error < 0.4 * squares.mean()
        norm2 = x.mean(axis=0) @ x.mean(axis=0) - squares.sum() / 63.0 / 64.0
        assert abs(norm2 - report.norm2[name]) < Z * math.hypot(report.norm2_error[name], 0.01 * norm2)


@pytest.mark.slow
def test_times_and_errors_are_inverse(report):
    # Larger batches save what is fixed in their cost, here a share that does not depend on the machine.
    fixed = ({"fixed_seconds": 0.1 * t.seconds, "sample_seconds": 0.9 * t.seconds / t.samples} for t in report.terms)
    report = replace(report, terms=tuple(replace(t, **costs) for t, costs in zip(report.terms, fixed, strict=True)))
    for error in (0.02, 0.005):
        # A time is spent in larger batches.
        assert 0.5 * error < report.error_in(report.seconds_to(error)) < 1.05 * error
        low, high = report.seconds_interval(error)
        assert low < report.seconds_to(error) < high
    assert report.error_in(1e-9) == math.inf
    split = report.allocation(seconds=100.0)
    assert split.seconds <= 100.0 + 1e-6
    assert split.spp == {t.name: t.spp * split.batches[t.name] for t in report.fitted(seconds=100.0).terms}
    # Error^2 ~ 1 / time, or better: what is fixed is saved, and stratified samples gain.
    assert 20.0 < report.seconds_to(0.001) / report.seconds_to(0.01) < 105.0


@pytest.mark.slow
def test_less_accuracy_never_costs_more(report):
    # Also where batches shrink: with a high fixed cost, and where stratified samples gain from large batches.
    halves = ({"fixed_seconds": 0.5 * t.seconds, "sample_seconds": 0.5 * t.seconds / t.samples} for t in report.terms)
    terms = tuple(replace(t, exponent=1.5, **half) for t, half in zip(report.terms, halves, strict=True))
    for what in (report, replace(report, terms=terms)):
        seconds = [what.seconds_to(error) for error in np.geomspace(3.0, 0.003, 40)]
        print(np.round(np.diff(seconds) / np.array(seconds[1:]), 2))
        assert (np.diff(seconds) >= -0.05 * np.array(seconds[1:])).all()
        errors = np.array([what.error_in(float(t)) for t in np.geomspace(1.1 * seconds[0], seconds[-1], 40)])
        assert np.isfinite(errors).all() and (np.diff(errors) <= 0.05 * errors[:-1]).all()


@pytest.mark.slow
def test_a_long_time_buys_larger_batches(report):
    # What is fixed in their cost is saved, and stratified samples are better together; both as far as they are known.
    term = replace(report.terms[0], spp=4, samples=400, seconds=1.0, fixed_seconds=0.5, sample_seconds=0.5 / 400)
    term = replace(term, variance={name: report.norm2[name] for name in report.norm2}, exponent=1.3)
    for error, exponent in ((0.2 * math.sqrt(0.3), 1.21), (0.0, 1.3), (0.2, 1.0)):
        lone = replace(report, terms=(replace(term, exponent_error=error),))
        (larger,) = lone.fitted(seconds=8.0).terms
        assert larger.spp >= 58  # 0.5 + 0.5 spp / 4 seconds: one of 60 takes all of the time
        assert larger.seconds == pytest.approx(0.5 + larger.spp / 4 * 0.5) and larger.seconds <= 8.0
        gain = (larger.spp / 4) ** exponent
        assert larger.variance[ALBEDO] == pytest.approx(term.variance[ALBEDO] / gain)
        (largest,) = lone.fitted(seconds=1e6).terms
        assert largest.spp == 64 * 4
        assert lone.fitted(seconds=1.0) is lone
        assert lone.fitted(error=0.3) is lone  # some 11 batches, all of which tell when to stop


@pytest.mark.slow
def test_report_is_written_and_read(report, tmp_path):
    report.save(tmp_path / "a.json")
    again = Report.load(tmp_path / "a.json")
    assert str(again) == str(report)
    assert again.seconds_to(0.01) == report.seconds_to(0.01)
    (tmp_path / "b.json").write_text("{}")
    with pytest.raises(ValueError, match=r"b\.json: expected what Report\.save wrote"):
        Report.load(tmp_path / "b.json")


@pytest.mark.slow
def test_report_is_drawn(report, tmp_path):
    report.plot(tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 5000
    assert report.measured and all(error > 0.0 for _seconds, error in report.measured)
    text = str(report)
    for word in ("interior", "direct boundary", POSITIONS, "where shapes touch", "processor time"):
        assert word in text


@pytest.mark.slow
def test_image_and_derivative_have_reports(soft):
    scene, params = soft
    image = psdr.accuracy(scene, integrator=INTEGRATOR, seconds=0.3)
    assert [t.name for t in image.terms] == ["image"] and image.bias  # the tent filter's quotient
    options = {"tangents": tangents(params), "integrator": INTEGRATOR, "seconds": 0.3, "spp": 4, "tiles": False}
    derivative = psdr.accuracy(scene, params, **options)
    assert [t.spp for t in derivative.terms] == [4, 4, 4]
    assert derivative.tile == 0


def rounds_of_a_pilot(soft, monkeypatch, *, uncertain=0.0, error=None):
    """Rounds of a pilot on a clock that goes by a millisecond whenever it is read."""
    scene, params = soft
    ticks = itertools.count()
    monkeypatch.setitem(pilot.CLOCKS, "cpu", lambda: 1e-3 * next(ticks))
    monkeypatch.setattr(rounds, "CERTAIN", -1.0)
    monkeypatch.setattr(pilot, "UNCERTAIN", uncertain)
    monkeypatch.setattr(rounds, "MOST_ROUNDS", 40)
    what = quantity.gradient(scene, params, adjoint(), integrator=INTEGRATOR, sensor=0)
    found = pilot.run(what, spp=2, seed=5, seconds=0.06, tiles=False, clock="cpu", error=error)
    return found.batches, found


@pytest.mark.slow
def test_an_uncertain_pilot_goes_on(soft, monkeypatch):
    enough, report = rounds_of_a_pilot(soft, monkeypatch, uncertain=math.inf)
    assert 4 <= enough < 12
    # Up to four times as long, where its prediction is less certain than wanted.
    more, _report = rounds_of_a_pilot(soft, monkeypatch, uncertain=0.0)
    assert 3 * enough <= more < 6 * enough
    # Before an error is asked for: a share of what that will take, and no less than the time.
    best = float(efficiency(report.cost, report.relative_variance))
    error = math.sqrt(pilot.SHARE * best / 0.12)
    share, _report = rounds_of_a_pilot(soft, monkeypatch, error=error)
    assert 1.4 * enough <= share <= 3 * enough
    assert rounds_of_a_pilot(soft, monkeypatch, error=10.0 * error)[0] == enough
    assert rounds_of_a_pilot(soft, monkeypatch, error=1e-6)[0] == 40


@pytest.mark.slow
@pytest.mark.parametrize(("depth", "built"), [(2, 1), pytest.param(3, 2, marks=pytest.mark.slow)])
def test_building_is_timed_and_keeps_what_was_built(depth, built):
    # A structure that a gradient has built stays; else what building takes is told apart.
    scene = psdr.load_dict({"type": "scene", **scenes.SCENES["soft"]()})
    params = psdr.traverse(scene)
    params.requires_grad(POSITIONS, ALBEDO)
    method = psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree(max_leaves=64))
    options = {"integrator": psdr.PathIntegrator(max_depth=depth, boundary=method), "seconds": 0.1, "tiles": False}
    first = psdr.accuracy(scene, params, adjoint(), **options)
    assert [t.setup_seconds > 0.0 for t in first.terms] == [False, False] + [True] * built
    kept = psdr.guiding.structures(scene)
    second = psdr.accuracy(scene, params, adjoint(), **options)
    assert [t.setup_seconds for t in second.terms] == [0.0] * (2 + built)
    assert len(kept) == built
    assert all(a is b for a, b in zip(psdr.guiding.structures(scene), kept, strict=True))


def test_a_gradient_of_zero_is_refused(soft):
    scene, params = soft
    with pytest.raises(ValueError, match="does not stand out of the noise"):
        psdr.accuracy(scene, params, np.zeros_like(adjoint()), integrator=INTEGRATOR, seconds=0.1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clock": "sun"}, "clock: got 'sun'"),
        ({"adjoint": 0, "tangents": {ALBEDO: 1.0}}, "not both"),
        ({"tangents": {}}, "tangents: got none"),
        ({"seconds": 0.0}, "seconds: got 0.0, expected a positive number"),
        ({"seed": -1}, "seed: got -1"),
        ({"spp": 0}, "spp: got 0"),
        ({"sensor": 4}, "sensor 4"),
    ],
)
def test_what_is_out_of_range_is_named(soft, options, message):
    with pytest.raises(ValueError, match=message):
        psdr.accuracy(*soft, **options)


def test_parameters_are_needed_for_gradients(soft):
    with pytest.raises(ValueError, match="params: needed"):
        psdr.accuracy(soft[0], adjoint=adjoint())

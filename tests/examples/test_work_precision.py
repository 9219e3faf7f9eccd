"""The work-precision benchmark: its statistics, its file of measurements, its tables, and one small run of it."""

import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
#: Standard errors within which an unbiased estimate lies; twice in a million tests it does not.
SIGMAS = 4.75
TRIALS, IMAGES, VALUES = 400, 6, 50


def rows(modules, case="box"):
    """Measurements of two methods: times and squared errors that are easy to divide."""
    result = []
    for method, seconds, squared in (("ours", 1.0, 0.04), ("Mitsuba a", 2.0, 0.16), ("Mitsuba b", 8.0, 0.02)):
        for spp in (4, 16):
            for repeat in range(3):
                row = {"kind": "run", "case": case, "method": method, "spp": spp, "repeat": repeat, "pixels": 8}
                noise = (0.5, 1.0, 3.0)[repeat]  # medians take the second
                row |= {"seconds": seconds * spp / 16, "squared_error": squared * 16 / spp * noise, "machine": {}}
                result.append(row)
    return result


# --- statistics --------------------------------------------------------------------------------------------------


def reference(data: ModuleType, rng, truth, noise: float):
    return data.Reference(truth + noise * rng.normal(size=(IMAGES, VALUES)))


def test_errors_do_not_count_the_noise_of_the_reference(modules) -> None:
    data, rng = modules("work_precision_data"), np.random.default_rng(1)
    truth = rng.uniform(1.0, 2.0, VALUES)
    power = float((truth**2).mean())
    errors = []
    for _ in range(TRIALS):
        # The reference is as noisy as a run: without the correction the error would come out sqrt(7 / 6) as large.
        r = reference(data, rng, truth, 0.5)
        errors.append(data.squared_error(truth + 0.5 * rng.normal(size=VALUES), r) * r.power)
    mean, error = np.mean(errors), np.std(errors, ddof=1) / TRIALS**0.5
    assert abs(mean - 0.25) < SIGMAS * error < 0.02
    assert power == pytest.approx(np.mean([reference(data, rng, truth, 0.5).power for _ in range(TRIALS)]), rel=0.01)


def test_difference_and_slope_are_unbiased_and_know_their_error(modules) -> None:
    data, rng = modules("work_precision_data"), np.random.default_rng(2)
    truth = rng.normal(size=VALUES)
    away = 0.6 * truth + 0.3 * rng.normal(size=VALUES)
    expected = {
        data.squared_difference: ((away - truth) ** 2).mean() / (truth**2).mean(),
        data.slope: (away * truth).mean() / (truth**2).mean(),
    }
    for function, value in expected.items():
        found = [
            data.jackknife(function, reference(data, rng, away, 0.3), reference(data, rng, truth, 0.3))
            for _ in range(TRIALS)
        ]
        values, errors = np.array(found).T
        # Ratios of unbiased estimates: their own bias is of the order of the power's relative variance.
        assert abs(values.mean() - value) < SIGMAS * values.std(ddof=1) / TRIALS**0.5 + 0.01 * value
        assert np.sqrt((errors**2).mean()) == pytest.approx(values.std(ddof=1), rel=0.2)


def test_equal_references_have_no_difference(modules) -> None:
    data, rng = modules("work_precision_data"), np.random.default_rng(3)
    truth = rng.uniform(1.0, 2.0, VALUES)
    exact = data.Reference(truth[None])
    assert exact.noise == 0.0
    assert data.jackknife(data.squared_difference, exact, exact) == (0.0, 0.0)
    value, error = data.jackknife(data.squared_difference, reference(data, rng, truth, 0.1), exact)
    assert abs(value) < SIGMAS * error
    assert data.root_text(value, error).startswith("<")
    biased, error = data.jackknife(data.squared_difference, data.Reference(1.1 * truth[None]), exact)
    assert data.root_text(biased, error) == "0.1"
    assert data.bias(data.Reference(1.1 * truth[None]), exact) == pytest.approx(0.1)


def test_a_reference_of_noise_is_refused(modules) -> None:
    data = modules("work_precision_data")
    blank = data.Reference(np.zeros((4, 5)))
    assert blank.blank
    with pytest.raises(ValueError, match="all noise"):
        blank.power  # noqa: B018
    assert not data.Reference(np.ones((4, 5))).blank


def test_verdicts(modules) -> None:
    data, rng = modules("work_precision_data"), np.random.default_rng(4)
    truth = rng.normal(size=VALUES)
    differences = reference(data, rng, truth, 0.05)
    right = data.verdict(reference(data, rng, truth, 0.05), differences)
    assert right.startswith("slope") and "wrong" not in right
    half = data.verdict(reference(data, rng, 0.49 * truth, 0.05), differences)
    assert half.startswith("**wrong** (slope 0.49")
    other = rng.normal(size=VALUES)
    orthogonal = truth + 0.5 * (other - truth * (other @ truth) / (truth @ truth))
    missed = data.verdict(reference(data, rng, orthogonal, 0.05), differences)
    assert missed.startswith("**wrong** (slope") and "% away" in missed  # the slope is one
    assert "too noisy" in data.verdict(reference(data, rng, truth, 5.0), differences)


# --- the file of measurements ------------------------------------------------------------------------------------


def test_finished_measurements_are_found_again(modules, tmp_path: Path) -> None:
    data = modules("work_precision_data")
    file, given = tmp_path / "new" / "results.jsonl", rows(modules)
    records = data.Records(file)
    assert given[0] not in records
    for row in given[:3]:
        records.append(row)
    again = data.Records(file)
    assert again.rows == given[:3]
    assert all(row in again for row in given[:3]) and given[3] not in again
    assert given[0] | {"seconds": 9.0} in again  # the key counts, not the value
    assert given[0] | {"pixels": 16} not in again


def test_a_torn_line_is_measured_again(modules, tmp_path: Path) -> None:
    data = modules("work_precision_data")
    file, given = tmp_path / "results.jsonl", rows(modules)
    text = "".join(json.dumps(row) + "\n" for row in given[:2])
    file.write_text(text + json.dumps(given[2])[:20])
    records = data.Records(file)
    assert records.rows == given[:2] and given[2] not in records
    records.append(given[2])
    assert data.Records(file).rows == given[:3]


# --- tables and plots --------------------------------------------------------------------------------------------


def test_summary_takes_medians(modules) -> None:
    data = modules("work_precision_data")
    found = data.summary(rows(modules))
    assert len(found) == 6
    ours = found[1]
    assert (ours["method"], ours["spp"], ours["runs"]) == ("ours", 16, 3)
    assert ours["seconds"] == 1.0
    assert ours["error"] == pytest.approx(0.2)
    assert ours["work"] == pytest.approx(0.04)


def test_gains_are_ratios_of_times_at_equal_error(modules) -> None:
    data = modules("work_precision_data")
    gains = {
        r["method"]: r["gain"]
        for r in data.gains(data.summary(rows(modules)), "box", lambda m: m.startswith("Mitsuba"))
    }
    # 8 s x 0.02 is the least of the others: they need four times our time for our error.
    assert gains == pytest.approx({"ours": 4.0, "Mitsuba a": 0.5, "Mitsuba b": 1.0})
    alone = data.gains(data.summary(rows(modules)), "box", lambda m: False)
    assert [r["gain"] for r in alone] == [None] * 3


def runs_of(seconds: tuple[float, float], error: float, cores: float | None):
    """Summaries of a method: 4 and 16 samples."""
    rows = [{"spp": n, "seconds": t, "error": error * (16 / n) ** 0.5} for n, t in zip((4, 16), seconds, strict=True)]
    return rows if cores is None else [r | {"cores": cores} for r in rows]


@pytest.mark.parametrize(
    ("own", "other", "text"),
    [
        # Twice the time for the same error, and a third of that does not grow with the samples.
        (
            ((1.0, 2.0), 0.1, 1.9), ((0.25, 1.0), 0.1, 2.0),
            "fewer samples a second (0.5×) [1.9× its processor time a sample; fixed cost 33% of our time, 0% of its], "
            "as much noise in a sample (1×)",
        ),
        (
            ((0.5, 2.0), 0.1, 1.0), ((0.25, 1.0), 0.2, 2.0),
            "fewer samples a second (0.5×) [1× its processor time a sample; 1.0 cores busy, its 2.0], "
            "less noise in a sample (4×)",
        ),
        (
            ((0.25, 1.0), 0.2, None), ((0.25, 1.0), 0.1, None),
            "more noise in a sample (0.25×), as many samples a second (1×)",
        ),
    ],
)  # fmt: skip
def test_reasons_are_the_factors_of_the_ratio(modules, own, other, text) -> None:
    reasons = modules("work_precision_reasons")
    assert reasons.why(runs_of(*own), runs_of(*other)) == text


def test_fixed_costs_are_found(modules) -> None:
    share = modules("work_precision_reasons").fixed_share
    assert share(runs_of((1.0, 1.0), 0.1, None)) == 1.0
    assert share(runs_of((0.25, 1.0), 0.1, None)) == 0.0
    assert share(runs_of((0.1, 1.0), 0.1, None)) == 0.0  # noise of the clock
    assert share(runs_of((0.4, 1.0), 0.1, None)) == pytest.approx(0.2)
    assert share([{"spp": 4, "seconds": 1.0}]) == 0.0


def test_tables_and_page(modules, tmp_path: Path) -> None:
    data, report, rng = modules("work_precision_data"), modules("work_precision_report"), np.random.default_rng(5)
    truth = rng.normal(size=VALUES)
    references = {
        ("box", "ours"): reference(data, rng, truth, 0.05),
        ("box", "Mitsuba a"): reference(data, rng, 0.5 * truth, 0.05),
        ("box", report.DIFFERENCES): reference(data, rng, truth, 0.05),
        ("furnace", "ours"): reference(data, rng, 1.1 * truth, 0.001),
        ("furnace", report.CLOSED): data.Reference(truth[None]),
    }

    def find(case, method):
        return references.get((case, method))

    given = rows(modules) + rows(modules, "furnace")
    refused = {"kind": "refused", "case": "furnace", "method": "Mitsuba c", "message": "no"}
    names = {"box": ["ours", "Mitsuba a"], "furnace": ["ours"]}
    work = report.work_rows([*given, refused], list(names))
    assert [r["method"] for r in work if r["case"] == "box"] == ["ours", "Mitsuba a", "Mitsuba b"]
    assert work[0]["× Mitsuba's best"] == "4"
    assert work[-1]["method"] == "Mitsuba c" and "raises" in work[-1]["first call [s]"]
    judged = report.bias_rows(list(names), names, find)
    assert [r["reference"] for r in judged] == ["ours", "Mitsuba a"]
    assert "wrong" not in judged[0][report.VERDICT] and "wrong" in judged[1][report.VERDICT]
    best = report.best_rows([*given, refused], judged, {"box": 3.0, "furnace": 5.0})
    assert [(r["best of ours"], r["Mitsuba's best"], r["ratio of times"], r["wanted"]) for r in best] == [
        ("ours", "Mitsuba b", "4", "≥ 3"),
        ("ours", "Mitsuba b", "4", "≥ 5"),
    ]
    assert best[0]["why it is lower"] == ""
    assert best[1]["why it is lower"] == "more noise in a sample (0.5×), more samples a second (8×)"
    assert "Mitsuba a wrong (slope" in best[0]["notes"] and best[1]["notes"] == "Mitsuba c raises"
    floors = report.floor_rows(list(names), names, find)
    assert [r[report.FLOOR] for r in floors] == ["0.1"]
    page = tmp_path / "page.png"
    report.draw(page, [*given, refused], {name: name for name in names}, floors, judged, "test")
    from warp_psdr import image_io

    assert image_io.read_image(page, raw=True).std() > 0.05


# --- closed forms ------------------------------------------------------------------------------------------------


def test_quadrature_is_converged_and_its_derivative_right(modules, monkeypatch: pytest.MonkeyPatch) -> None:
    exact = modules("work_precision_exact")
    plane = exact.Plane()
    image, derivative = plane.image(4), plane.derivative(4)
    monkeypatch.setattr(exact, "LIGHT_NODES", 24)
    monkeypatch.setattr(exact, "PIXEL_NODES", 9)
    np.testing.assert_allclose(plane.image(4), image, rtol=1e-11)
    step = 2.0**-10
    monkeypatch.setattr(exact, "LIGHT_HEIGHT", exact.LIGHT_HEIGHT + step)
    above = plane.image(4)
    monkeypatch.setattr(exact, "LIGHT_HEIGHT", exact.LIGHT_HEIGHT - 2.0 * step)
    np.testing.assert_allclose((above - plane.image(4)) / (2.0 * step), derivative, rtol=1e-5)


def test_far_away_corners_are_held_exactly(modules) -> None:
    exact = modules("work_precision_exact")
    near = exact.Plane().light().astype(np.float64)
    for away in (1e2, 1e4, 1e6):
        moved = exact.Plane(away=away)
        np.testing.assert_array_equal(moved.light().astype(np.float64) - near, np.tile(moved._offset, (4, 1)))
        np.testing.assert_array_equal(moved.image(4), exact.Plane().image(4))


# --- a small run -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")  # its light is noted to be small
def test_a_run_is_resumed_and_reported(modules, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    benchmark, cases = modules("work_precision"), modules("work_precision_cases")
    name = "light of radius 1e-3"
    from dataclasses import replace

    small = replace(cases.ALL[name], pixels=(4, 4), counts=((1, 4), (1, 4)))
    monkeypatch.setitem(cases.ALL, name, small)
    output, page = tmp_path / "results.jsonl", tmp_path / "page.png"
    command = ["work_precision.py", "--quick", "--without-mitsuba", "--cases", name, "--repeat", "2"]
    monkeypatch.setattr(sys, "argv", [*command, "--output", str(output), "--picture", str(page)])
    benchmark.main()
    printed = capsys.readouterr().out
    assert f"| {name} | ours | 4 |" in printed and "error that remains" in printed and page.is_file()
    measured = [json.loads(line) for line in output.read_text().splitlines()]
    assert sorted({r["kind"] for r in measured}) == ["cold", "long", "run"]
    assert len([r for r in measured if r["kind"] == "run"]) == 4
    # Nothing but the position within the pixel varies, by some tenths: a wrong image is off by all of it.
    assert all(abs(r["squared_error"]) < 0.02 for r in measured if r["kind"] == "run")

    lines = output.read_text().splitlines(keepends=True)
    with monkeypatch.context() as patched:
        patched.setattr(benchmark, "Ours", None)  # nothing is missing, so nothing is loaded
        benchmark.main()
    assert output.read_text().splitlines(keepends=True) == lines
    output.write_text("".join(lines[:-1]))
    benchmark.main()  # one is missing
    assert len(output.read_text().splitlines()) == len(lines)
    again = json.loads(output.read_text().splitlines()[-1])
    assert again["squared_error"] == json.loads(lines[-1])["squared_error"]  # equal seeds, equal bits


def test_quick_curves_have_four_points_and_panels_say_what_they_show(modules) -> None:
    benchmark, cases = modules("work_precision"), modules("work_precision_cases")
    for case in cases.ALL.values():
        assert all(len(counts) >= 4 for counts in case.counts or benchmark.COUNTS)
    name = "Cornell box: reflectance"
    title = benchmark.caption(name, cases.ALL[name], 32)
    assert title == "Cornell box, 32 × 32\nderivative image by white.reflectance.value"


def test_the_page_names_methods_errors_and_clock(modules, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    report, figures = modules("work_precision_report"), []
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda figure, path: figures.append(figure))
    run = {"kind": "run", "case": "box", "pixels": 8, "repeat": 0}
    measured = [
        run | {"method": method, "spp": spp, "seconds": 2.0 * spp, "cores": 0.5, "squared_error": 1.0 / spp}
        for method in ("ours, KdTree", "Mitsuba prb")
        for spp in (1, 4)
    ]
    report.draw(tmp_path / "page.png", measured, {"box": "a box, 8 × 8"}, [], [], "machine", "processor")
    axes = figures[0].axes[0]
    assert (axes.get_title(), axes.get_ylabel()) == ("a box, 8 × 8", report.ERROR)
    assert axes.get_xlabel() == report.CLOCKS["processor"]
    assert list(axes.lines[0].get_xdata()) == [1.0, 4.0]  # half of the wall clock's seconds
    legend = [text.get_text() for text in figures[0].legends[0].get_texts()]
    assert legend == ["warp_psdr, PathSpace, KdTree reused", "Mitsuba, prb"]
    assert figures[0].get_suptitle() == "machine"

"""How samples are split over the terms of a gradient: automatically, evenly, and by every fixed split of a sweep.

    python examples/benchmarks/accuracy_allocation.py [--quick] [--clock cpu] [--output results.jsonl]

*Automatic* is what budgets do: a short pilot splits samples over the terms, direct and indirect boundary apart, and
spreads those of the interior term over tiles of the image where that pays. Many more batches with seeds of their own
then say what a batch of every term really costs, C_k, and how it varies, U_k. Terms are independent, so a split into
n_k batches has error^2 * time = (sum U_k / n_k) (sum n_k C_k), and the root of that is its error at equal time. *Fixed
splits* are all ratios of samples by powers of two from 1/64 to 64, without tiles. The *equal split* is
``render_backward(spp=n)``: as many samples a pixel of all terms, run and timed as it is. "Without tiles" tells what the
split over terms alone does, "equal split / best fixed split" what any could. Adjoints are smooth over the whole image
("waves"), and those with which a fit starts ("loss": the difference to an image of the scene with what moves a
twentieth of its radius away). The last columns spend the same time both ways: the scatter of runs of the equal split
and of ``render_backward(..., time_budget=...)``.
"""

import itertools
import tempfile
import time
from pathlib import Path

import numpy as np
from accuracy_cases import PAIRS, Loaded, scatter
from common import Report, arguments, psdr

from warp_psdr.work_precision import quantity
from warp_psdr.work_precision.statistics import moments, relative_variance
from warp_psdr.work_precision.tiles import from_exponents

#: What the project asks: "equal-time error of the automatic split is never more than 5 % worse than the best fixed
#: split in a sweep, and at least 1.5 times better than equal split on at least half of the scenes".
WORSE, BETTER, SHARE = 1.05, 1.5, 0.5
WORST, GAIN, LIMIT = "automatic / best fixed split", "equal split / automatic", "equal split / best fixed split"
CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}
EXPONENTS = range(-6, 7)
#: A term without variance gets this fraction of what another one gets.
LEAST = 1e-3


def truth(loaded: Loaded, reports: list, spp: int, batches: int, clock) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return seconds and relative variance of batches, which run in turns: for each report (terms,), then of the whole.

    Args:
        loaded: the pair.
        reports: of pilots.
        spp: samples a pixel of ``render_backward``.
        batches: of each.
        clock: what is timed.
    """
    what = quantity.gradient(loaded.scene, loaded.params, loaded.adjoint, integrator=loaded.integrator, sensor=0)
    tiled = [what.tiled(from_exponents(what, r.tile, r.exponents)) if r.tile else what for r in reports]
    kept = [[[] for _ in what.parts] for _ in reports]
    times = [[[] for _ in what.parts] for _ in reports]
    whole, whole_times = [], []
    for number in range(batches):
        begun = clock()
        gradient = loaded.gradient(spp=spp, seed=90_000 + number)
        whole_times.append(clock() - begun)
        whole.append(np.concatenate(gradient))
        for i, (report, quantities) in enumerate(zip(reports, tiled, strict=True)):
            for k, (part, term) in enumerate(zip(quantities.parts, report.terms, strict=True)):
                begun = clock()
                kept[i][k].append(part.run(term.spp, 50_000 + number))
                times[i][k].append(clock() - begun)
    found = [moments(k, list(what.blocks.values())) for k in kept]
    seen = np.array([name in reports[0].seen for name in what.blocks])
    found.append(moments([whole], list(what.blocks.values())))
    return [
        (np.median(t, axis=1), relative_variance(m.variance, m.norm2, seen))
        for t, m in zip([*times, [whole_times]], found, strict=True)
    ]


def row_of(loaded: Loaded, *, pilot: float, batches: int, runs: int, seconds: float, clock: str) -> dict:
    """Return a row of the table."""
    report = loaded.accuracy(seconds=pilot, clock=clock, seed=1, tiles=False)
    tiled = loaded.accuracy(seconds=pilot, clock=clock, seed=2)
    spp = np.array([t.spp for t in report.terms], float)
    # As many samples as a round of batches takes time for.
    each = max(round(float(report.cost.sum() / (report.cost / spp).sum())), 1)
    (cost, variance), true_with_tiles, whole = truth(loaded, [report, tiled], each, batches, CLOCKS[clock])

    plain = _split(report)
    ratios = [(0, *rest) for rest in itertools.product(EXPONENTS, repeat=len(spp) - 1)]
    best = min(_error(cost, variance, 2.0 ** np.array(r, float) / spp) for r in ratios)
    equal, found = _error(*whole, np.ones(1)), _error(cost, variance, plain)
    automatic = _error(*true_with_tiles, _split(tiled))
    shares = plain * spp / (plain * spp)[0]
    row = {
        "terms": ", ".join(t.name for t in report.terms),
        "spp, automatic": " : ".join(f"{s:.2g}" for s in shares),
        "pilot, s": report.pilot_seconds,
        WORST: automatic / best,
        f"{WORST}, without tiles": found / best,
        GAIN: equal / automatic,
        f"{GAIN}, without tiles": equal / found,
        LIMIT: equal / best,
    }
    return row | (_spent(loaded, tiled, float(whole[0][0]) / each, runs, seconds) if runs else {})


def _split(report) -> np.ndarray:
    """Return (terms,): the batches that a report asks for, up to a factor."""
    split = np.sqrt(report.relative_variance / report.cost)
    return np.maximum(split, LEAST * split.max())


def _error(cost: np.ndarray, variance: np.ndarray, split: np.ndarray) -> float:
    """Return the error at the time of one second."""
    return float(np.sqrt((variance / split).sum() * (split @ cost)))


def _spent(loaded: Loaded, report, sample_seconds: float, runs: int, seconds: float) -> dict:
    """Spend a time both ways; ``sample_seconds``: of the equal split, a sample a pixel."""
    each = max(round(seconds / sample_seconds), 1)
    automatic = [loaded.spend(time_budget=seconds, report=report, seed=300 + i)[1] for i in range(runs)]
    evenly = [loaded.gradient(spp=each, seed=600 + i) for i in range(runs)]
    return {"equal, measured": scatter(evenly), "automatic, measured": scatter(automatic)}


def main() -> None:
    """Run and print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="cpu: processor time of all threads")
    parser.add_argument("--only", help="pairs whose name holds this text")
    parser.add_argument(
        "--adjoints", nargs="+", choices=("waves", "loss"), default=["waves", "loss"], help="default: both"
    )
    options = parser.parse_args()
    resolution, pilot, batches = (32, 1.0, 64) if options.quick else (64, 3.0, 256)
    runs = options.repeat or (0 if options.quick else 16)
    psdr.set_workers(options.threads)
    report = Report("accuracy, split over terms", options.output)
    rows = []
    for pair in PAIRS:
        if options.only and options.only not in str(pair):
            continue
        for adjoint in options.adjoints:
            with tempfile.TemporaryDirectory() as name:
                loaded = Loaded(pair, Path(name), resolution, adjoint)
                if not loaded.moves:
                    break
                row = row_of(loaded, pilot=pilot, batches=batches, runs=runs, seconds=0.5, clock=options.clock)
            rows.append({"pair": str(pair), "adjoint": adjoint} | row)
            print(f"  {pair}, {adjoint}: {row[WORST]:.3f}, {row[GAIN]:.2f}", flush=True)
    report.table(f"errors at equal time, {resolution}^2 pixels, {options.clock} time", rows)
    verdicts = []
    for adjoint, what in itertools.product(options.adjoints, ("", ", without tiles")):
        judged = [row for row in rows if row["adjoint"] == adjoint]
        worst = max(row[WORST + what] for row in judged)
        better = float(np.mean([row[GAIN + what] >= BETTER for row in judged]))
        name = f"{adjoint}, automatic{what or ', tiles included'}"
        on = f"on {better * len(judged):.0f} of {len(judged)}"
        asked = f"{name}: never more than 5 % worse than the best fixed split"
        verdicts.append({"asked": asked, "measured": f"{worst:.3f} at worst", "holds": worst <= WORSE})
        asked = f"{name}: ≥ {BETTER}× better than equal split on at least half of the scenes"
        most = sum(row[LIMIT] >= BETTER for row in judged)
        verdicts.append({"asked": asked, "measured": f"{on}; the best fixed split: {most}", "holds": better >= SHARE})
    report.table("equal-time error", verdicts)


if __name__ == "__main__":
    main()

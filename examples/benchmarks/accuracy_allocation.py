"""How samples are split over the terms of a gradient: automatically, evenly, and by every fixed split of a sweep.

    python examples/benchmarks/accuracy_allocation.py [--quick] [--clock cpu] [--output results.jsonl]

A short pilot splits. Many more batches with seeds of their own then say what a batch of every term really costs, C_k,
and how it varies, U_k. Terms are independent, so a split into n_k batches has error^2 * time = (sum U_k / n_k) (sum n_k
C_k), and the root of that is its error at equal time. The even split takes as many samples a pixel of all terms; the
sweep, all ratios of samples by powers of two from 1/64 to 64. "With tiles": the pilot also spreads the interior term's
samples over the image, as budgets do. The last columns spend the same time both ways: the scatter of runs of the even
split and of ``render_backward(..., time_budget=...)``.
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

#: What the project asks: not more than 5 % worse than the best split, and 1.5 times better than the even one in half.
WORSE, BETTER, SHARE = 1.05, 1.5, 0.5
CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}
EXPONENTS = range(-6, 7)
#: A term without variance gets this fraction of what another one gets.
LEAST = 1e-3


def truth(loaded: Loaded, reports: list, batches: int, clock) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return for each report (terms,): seconds and relative variance of its batches, which run in turns."""
    what = quantity.gradient(loaded.scene, loaded.params, loaded.adjoint, integrator=loaded.integrator, sensor=0)
    tiled = [what.tiled(from_exponents(what, r.tile, r.exponents)) if r.tile else what for r in reports]
    kept = [[[] for _ in what.parts] for _ in reports]
    times = [[[] for _ in what.parts] for _ in reports]
    for number in range(batches):
        for i, (report, quantities) in enumerate(zip(reports, tiled, strict=True)):
            for k, (part, term) in enumerate(zip(quantities.parts, report.terms, strict=True)):
                begun = clock()
                kept[i][k].append(part.run(term.spp, 50_000 + number))
                times[i][k].append(clock() - begun)
    found = [moments(k, list(what.blocks.values())) for k in kept]
    seen = np.array([name in reports[0].seen for name in what.blocks])
    return [
        (np.median(t, axis=1), relative_variance(m.variance, m.norm2, seen)) for t, m in zip(times, found, strict=True)
    ]


def row_of(loaded: Loaded, *, pilot: float, batches: int, runs: int, seconds: float, clock: str) -> dict:
    """Return a row of the table."""
    report = loaded.accuracy(seconds=pilot, clock=clock, seed=1, tiles=False)
    tiled = loaded.accuracy(seconds=pilot, clock=clock, seed=2)
    (cost, variance), true_with_tiles = truth(loaded, [report, tiled], batches, CLOCKS[clock])
    spp = np.array([t.spp for t in report.terms], float)

    automatic = _split(report)
    ratios = [(0, *rest) for rest in itertools.product(EXPONENTS, repeat=len(spp) - 1)]
    best = min(_error(cost, variance, 2.0 ** np.array(r, float) / spp) for r in ratios)
    even, found = _error(cost, variance, 1.0 / spp), _error(cost, variance, automatic)
    with_tiles = _error(*true_with_tiles, _split(tiled))
    shares = automatic * spp / (automatic * spp)[0]
    row = {
        "terms": ", ".join(t.name for t in report.terms),
        "spp, automatic": " : ".join(f"{s:.2g}" for s in shares),
        "pilot, s": report.pilot_seconds,
        "automatic / best": found / best,
        "even / automatic": even / found,
        "even / automatic with tiles": even / with_tiles,
    }
    return row | (_spent(loaded, tiled, cost, spp, runs, seconds) if runs else {})


def _split(report) -> np.ndarray:
    """Return (terms,): the batches that a report asks for, up to a factor."""
    split = np.sqrt(report.relative_variance / report.cost)
    return np.maximum(split, LEAST * split.max())


def _error(cost: np.ndarray, variance: np.ndarray, split: np.ndarray) -> float:
    """Return the error at the time of one second."""
    return float(np.sqrt((variance / split).sum() * (split @ cost)))


def _spent(loaded: Loaded, report, cost: np.ndarray, spp: np.ndarray, runs: int, seconds: float) -> dict:
    """Spend a time both ways."""
    each = max(round(seconds / float((cost / spp).sum())), 1)
    automatic = [loaded.spend(time_budget=seconds, report=report, seed=300 + i)[1] for i in range(runs)]
    evenly = [loaded.gradient(spp=each, seed=600 + i) for i in range(runs)]
    return {"even, measured": scatter(evenly), "automatic, measured": scatter(automatic)}


def main() -> None:
    """Run and print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="cpu: processor time of all threads")
    parser.add_argument("--only", help="pairs whose name holds this text")
    options = parser.parse_args()
    resolution, pilot, batches = (32, 1.0, 64) if options.quick else (64, 3.0, 256)
    runs = options.repeat or (0 if options.quick else 16)
    psdr.set_workers(options.threads)
    report = Report("accuracy, split over terms", options.output)
    rows = []
    for pair in PAIRS:
        if options.only and options.only not in str(pair):
            continue
        with tempfile.TemporaryDirectory() as name:
            loaded = Loaded(pair, Path(name), resolution)
            if not loaded.moves:
                continue
            row = row_of(loaded, pilot=pilot, batches=batches, runs=runs, seconds=0.5, clock=options.clock)
        rows.append({"pair": str(pair)} | row)
        print(f"  {pair}: {row['automatic / best']:.3f}, {row['even / automatic']:.2f}", flush=True)
    report.table(f"errors at equal time, {resolution}^2 pixels, {options.clock} time", rows)
    worst = max(row["automatic / best"] for row in rows)
    summary: dict = {"worst automatic / best": worst}
    for key in ("even / automatic", "even / automatic with tiles"):
        summary[f"share with {key} >= {BETTER}"] = float(np.mean([row[key] >= BETTER for row in rows]))
    summary["as asked"] = worst <= WORSE and summary[f"share with even / automatic with tiles >= {BETTER}"] >= SHARE
    report.table("summary", [summary])


if __name__ == "__main__":
    main()

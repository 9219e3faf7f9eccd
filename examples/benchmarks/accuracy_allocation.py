"""How samples are split over the terms of a gradient and over the image: automatically, evenly, and by fixed splits.

    python examples/benchmarks/accuracy_allocation.py [--quick] [--clock cpu] [--resume rows.jsonl] [--output ...]

Adjoints are those with which a fit starts: the difference to an image of the scene with what is sought elsewhere
("loss"); or "waves", smooth over the whole image. *Automatic* is what budgets do: a short pilot splits samples over the
terms, direct and indirect boundary apart, and spreads those of the interior term over the image where that pays. Many
more batches, of the sizes that a budget of some seconds asks for and with seeds of their own, then say what a batch of
every term really costs, C_k, and how it varies, U_k. Terms are independent, so a split into n_k batches has
error^2 * time = (sum U_k / n_k) (sum n_k C_k), and the root of that is its error at equal time. *Fixed splits* are all
ratios of samples by powers of two from 1/64 to 64, evenly spread. The *equal split* is ``render_backward(spp=n)`` with
the n for that budget: as many samples a pixel of all terms, run and timed as it is.

Three columns say what there was to gain over the equal split: by the best fixed split of the terms alone; that together
with the best counts of tiles of ``FINE`` pixels, from long runs of each (their cost not counted); and what was gained.
The last columns, in the full mode, spend the same time both ways: the scatter of runs of the equal split and of
``render_backward(..., time_budget=...)``.
"""

import functools
import itertools
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from accuracy_cases import PAIRS, Loaded, Pair, kept, scatter
from common import Report, arguments, psdr

from warp_psdr.accuracy import quantity
from warp_psdr.accuracy.allocation import efficiency
from warp_psdr.accuracy.budget import rounds
from warp_psdr.accuracy.statistics import moments, relative_variance
from warp_psdr.accuracy.tiles import density, measured, spread

#: What the project asks: "equal-time error of the automatic split is never more than 5 % worse than the best fixed
#: split in a sweep, and at least 1.5 times better than equal split on at least half of the scenes".
WORSE, BETTER, SHARE = 1.05, 1.5, 0.5
WORST, GAIN, LIMIT = "automatic / best fixed split", "equal split / automatic", "equal split / best fixed split"
BOUND = "equal split / best split and tiles"
CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}
#: Powers of two of the sweep; with many terms, every so manieth of them.
EXPONENTS = range(-6, 7)
STEPS = {1: 1, 2: 1, 3: 1, 4: 1, 5: 2, 6: 2}
#: Side of the tiles, pixels, whose best counts say what there is to gain, and what their deviations come from.
FINE, FINE_SPP, FINE_BATCHES = 2, 64, 8


def truth(
    loaded: Loaded, reports: list, spp: int, batches: int, evenly: int, clock
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return seconds and relative variance of batches, which run in turns: for each report (terms,), then of the whole.

    Args:
        loaded: the pair.
        reports: of pilots.
        spp: samples a pixel of ``render_backward``.
        batches: of each.
        evenly: runs of the whole.
        clock: what is timed.
    """
    what = quantity.gradient(loaded.scene, loaded.params, loaded.adjoint, integrator=loaded.integrator, sensor=0)
    tiled = [what.tiled(spread(what, r.tile, r.deviations)) if r.tile else what for r in reports]
    kept = [[[] for _ in what.parts] for _ in reports]
    times = [[[] for _ in what.parts] for _ in reports]
    whole, whole_times = [], []
    for number in range(batches):
        if number * evenly // batches != (number - 1) * evenly // batches:
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
    # Errors are relative to one estimate of the norm, so that their ratios do not depend on it.
    norm2 = found[1].norm2
    return [
        (np.median(t, axis=1), relative_variance(m.variance, norm2, seen))
        for t, m in zip([*times, [whole_times]], found, strict=True)
    ]


def row_of(loaded: Loaded, *, pilot: float, batches: int, evenly: int, seconds: float, clock: str) -> dict:
    """Return a row of the table; ``evenly``: runs of the equal split."""
    found = [loaded.accuracy(seconds=pilot, clock=clock, seed=1, tiles=tiles) for tiles in (False, True)]
    plain, tiled = (r.fitted(seconds=seconds) for r in found)
    # The boundary terms have batches of one size in all splits: what sizes do is no matter of the split.
    even = replace(tiled, tile=0, terms=(plain.terms[0], *tiled.terms[1:]))
    of_plain, spp = (np.array([t.spp for t in r.terms], float) for r in (plain, even))
    each = max(round(seconds / float((plain.cost / of_plain).sum())), 1)
    (cost, variance), with_tiles, whole = truth(loaded, [even, tiled], each, batches, evenly, CLOCKS[clock])

    fixed = np.array([t.fixed_seconds / t.seconds for t in even.terms])
    best = _best_fixed(cost, variance, fixed, spp, seconds)
    equal, split = _error(*whole, np.ones(1)), _error(cost, variance, _split(plain, seconds) * of_plain / spp)
    automatic = _error(*with_tiles, _split(tiled, seconds))
    shares = _split(tiled, seconds) * [t.spp for t in tiled.terms]
    least = variance.copy()
    least[0] /= _gain_of_tiles(loaded, FINE)
    return {
        "terms": ", ".join(t.name for t in tiled.terms),
        "spp, automatic": " : ".join(f"{s:.3g}" for s in shares),
        "spp, equal": each,
        "pilot, s": found[1].pilot_seconds,
        WORST: automatic / best,
        f"{WORST}, without tiles": split / best,
        LIMIT: equal / best,
        BOUND: equal / float(np.sqrt(efficiency(cost, least))),
        GAIN: equal / automatic,
        f"{GAIN}, without tiles": equal / split,
    }


def _gain_of_tiles(loaded: Loaded, side: int) -> float:
    """Return by how much the best counts of tiles lower the variance of the interior term at equal samples."""
    what = quantity.gradient(loaded.scene, loaded.params, loaded.adjoint, integrator=loaded.integrator, sensor=0)
    found = measured(what, FINE_SPP, range(700_000, 700_000 + FINE_BATCHES), side)
    if found is None:
        return 1.0
    root = density(what, *found)
    root = root[loaded.adjoint.reshape(-1, 3).any(axis=1)]
    return float((root**2).mean() / root.mean() ** 2)


def _split(report, seconds: float) -> np.ndarray:
    """Return (terms,): the batches that a budget runs."""
    each, most = rounds(report, seconds)
    return most * each


def _best_fixed(cost: np.ndarray, variance: np.ndarray, fixed: np.ndarray, spp: np.ndarray, seconds: float) -> float:
    """Return the error at the time of one second of the best split of a sweep; ``fixed``: share of a batch's cost.

    A share of a batch saves its share of the samples, not what is fixed.
    """
    steps = EXPONENTS[:: STEPS.get(len(spp), 3)]
    ratios = [(0, *rest) for rest in itertools.product(steps, repeat=len(spp) - 1)]
    shape = 2.0 ** np.array(ratios, float) / spp
    low, high = np.full(len(shape), 1e-9), np.full(len(shape), 1e9)
    for _ in range(80):  # the scale at which a split takes the time
        scale = np.sqrt(low * high)
        n = scale[:, None] * shape
        over = (fixed * np.maximum(n, 1.0) + (1.0 - fixed) * n) @ cost > seconds
        low, high = np.where(over, low, scale), np.where(over, scale, high)
    return float(np.sqrt((variance / (low[:, None] * shape)).sum(axis=1) * seconds).min())


def _error(cost: np.ndarray, variance: np.ndarray, split: np.ndarray) -> float:
    """Return the error at the time of one second."""
    return float(np.sqrt((variance / split).sum() * (split @ cost)))


def spent(loaded: Loaded, report, each: int, runs: int, seconds: float, clock) -> dict:
    """Spend a time both ways, in turns; ``each``: samples a pixel of the equal split."""
    found: list[list] = [[], []]
    times: list[list[float]] = [[], []]
    for i in range(runs):
        ways = (
            lambda i=i: loaded.gradient(spp=each, seed=600 + i),
            lambda i=i: loaded.spend(time_budget=seconds, report=report, seed=300 + i)[1],
        )
        for k, way in enumerate(ways):
            begun = clock()
            found[k].append(way())
            times[k].append(clock() - begun)
    equal, automatic = (scatter(f) * float(np.median(t)) ** 0.5 for f, t in zip(found, times, strict=True))
    return {f"{GAIN}, runs": equal / automatic}


def main() -> None:
    """Run and print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="cpu: processor time of all threads")
    parser.add_argument("--only", help="pairs whose name holds this text")
    parser.add_argument("--adjoints", nargs="+", choices=("loss", "waves"), default=["loss"], help="default: loss")
    parser.add_argument("--resume", type=Path, help="keep finished rows in this file, and do not measure them again")
    options = parser.parse_args()
    resolution, pilot, batches, evenly, seconds = (32, 1.0, 16, 16, 0.3) if options.quick else (64, 3.0, 32, 32, 0.5)
    runs = options.repeat or (0 if options.quick else 16)
    psdr.set_workers(options.threads)
    report = Report("accuracy, split over terms and pixels", options.output)
    rows = []

    def measure(pair: Pair, adjoint: str) -> dict:
        with tempfile.TemporaryDirectory() as name:
            loaded = Loaded(pair, Path(name), resolution, adjoint)
            row = row_of(loaded, pilot=pilot, batches=batches, evenly=evenly, seconds=seconds, clock=options.clock)
            if runs:
                found = loaded.accuracy(seconds=pilot, clock=options.clock, seed=2)
                row |= spent(loaded, found, row["spp, equal"], runs, seconds, CLOCKS[options.clock])
        return row

    for pair, adjoint in itertools.product(PAIRS, options.adjoints):
        if not pair.parameters or (options.only and options.only not in str(pair)):
            continue
        key = {"kind": "allocation", "case": str(pair), "method": f"{adjoint}, {options.clock}", "pixels": resolution}
        row = kept(options.resume, key, functools.partial(measure, pair, adjoint))
        rows.append({"pair": str(pair), "adjoint": adjoint} | row)
        print(f"  {pair}, {adjoint}: {row[WORST]:.3f}, {row[GAIN]:.2f} of {row[BOUND]:.2f}", flush=True)
    report.table(f"errors at equal time, {resolution}^2 pixels, {seconds} s, {options.clock} time", rows)
    verdicts = []
    for adjoint, what in itertools.product(options.adjoints, ("", ", without tiles")):
        judged = [row for row in rows if row["adjoint"] == adjoint]
        worst = max(row[WORST + what] for row in judged)
        better = float(np.mean([row[GAIN + what] >= BETTER for row in judged]))
        name = f"{adjoint}, automatic{what or ', tiles included'}"
        asked = f"{name}: never more than 5 % worse than the best fixed split"
        verdicts.append({"asked": asked, "measured": f"{worst:.3f} at worst", "holds": worst <= WORSE})
        asked = f"{name}: ≥ {BETTER}× better than equal split on at least half of the scenes"
        most = sum(row[LIMIT if what else BOUND] >= BETTER for row in judged)
        on = f"on {better * len(judged):.0f} of {len(judged)}; attainable on {most}"
        verdicts.append({"asked": asked, "measured": on, "holds": better >= SHARE})
    report.table("equal-time error", verdicts)


if __name__ == "__main__":
    main()

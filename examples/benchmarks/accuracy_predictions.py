"""What accuracy costs: predicted by ``psdr.accuracy``, then spent and measured.

    python examples/benchmarks/accuracy_predictions.py [--quick] [--clock cpu] [--resume rows.jsonl] [--output ...]

For every pair of a scene and a parameter pilots with seeds of their own predict the error that ``seconds`` buy. That
error is then asked for as ``render_backward(..., target_error=...)`` does with the pilot's report, again and again.
Measured are the mean time, and the error that was reached. A run of n_k batches of term k has the squared error
sum_k U_k / n_k, since its n_k are independent of the batches that it averages (``accuracy/budget.py``); U_k is
known from the batches of all runs, hundreds, and from these the norm of the gradient, too. The scatter of the runs
themselves says the same with far fewer degrees of freedom, and stands beside it. Behind a ratio is its standard error.

"New" pairs are those by which nothing was chosen. The clock "cpu" counts the processor time of all threads, for
machines that do other work. "Heavy tails" names the terms of which the pilot says that rare large samples carry their
variance, and that its prediction is therefore unreliable.
"""

import functools
import math
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from accuracy_cases import FRESH, PAIRS, Loaded, Pair, kept, scatter
from common import Report, arguments, psdr

from warp_psdr.accuracy import budget, quantity
from warp_psdr.accuracy.tiles import spread

#: What the project asks of predictions: time within 25 %, error within 20 %, in 80 % of the pairs.
TIME_WITHIN, ERROR_WITHIN, SHARE = 0.25, 0.20, 0.8
#: Least number of batches of each term in the time that is predicted.
LEAST_BATCHES = 8.0
#: Seeds of the pilots and of the runs: those with which anything was tried out are far below.
PILOT_SEED, RUN_SEED = 430_000, 530_000
#: Numbers of one term's batches that are kept for its variance, 256 MB; long gradients need few batches.
KEPT = 1 << 26


def recorded(what: quantity.Quantity, batches: list[list[np.ndarray]]) -> quantity.Quantity:
    """Return the same quantity, which leaves its terms' batches in a list each."""

    def recording(part: quantity.Part, into: list[np.ndarray]) -> Callable[[int, int], np.ndarray]:
        def run(spp: int, seed: int) -> np.ndarray:
            raw = part.run(spp, seed)
            if len(into) * raw.size < KEPT:
                into.append(what.finished(raw).astype(np.float32))
            return raw

        return run

    parts = zip(what.parts, batches, strict=True)
    return replace(what, parts=tuple(replace(part, run=recording(part, into)) for part, into in parts))


def reached(
    batches: list[list[np.ndarray]], counts: np.ndarray, blocks: list[slice], seen: np.ndarray
) -> tuple[float, float]:
    """Return the relative error of runs and its standard error.

    Args:
        batches: of each term.
        counts: (runs, terms), batches of a run.
        blocks: components that belong together.
        seen: (blocks,), which errors are relative to.
    """
    means = [np.mean(x, axis=0, dtype=np.float64) for x in batches]
    # (batches, blocks) of each term: squared distances from the mean, whose mean is the variance of a batch.
    squares = [
        np.array([[float(np.square(x[block] - mean[block]).sum()) for block in blocks] for x in of_term])
        * (len(of_term) / (len(of_term) - 1))
        for of_term, mean in zip(batches, means, strict=True)
    ]
    total = np.sum(means, axis=0)
    norm2 = np.array([float(np.square(total[block]).sum()) for block in blocks])
    norm2 -= np.sum([x.mean(axis=0) / len(x) for x in squares], axis=0)
    # E[1/n]: of the squared error in the mean.
    shares = [n * (x / norm2)[:, seen].mean(axis=1) for n, x in zip((1.0 / counts).mean(axis=0), squares, strict=True)]
    error = math.sqrt(sum(float(x.mean()) for x in shares))
    squared_error = math.sqrt(sum(float(x.var(ddof=1)) / len(x) for x in shares))
    return error, squared_error / (2.0 * error)


def measured(loaded: Loaded, *, seconds: float, pilot: float, pilots: int, runs: int, clock: str) -> list[dict]:
    """Return rows of the table, one a pilot."""
    return [
        _of_pilot(loaded, seconds=seconds, pilot=pilot, number=number, runs=runs, clock=clock)
        for number in range(pilots)
    ]


def _of_pilot(loaded: Loaded, *, seconds: float, pilot: float, number: int, runs: int, clock: str) -> dict:
    report = loaded.accuracy(seconds=pilot, clock=clock, seed=PILOT_SEED + number)
    # Where batches are long, time for a few of them; two digits, as people ask for.
    seconds = max(seconds, LEAST_BATCHES * float(report.cost.sum()))
    error = float(f"{report.error_in(seconds):.2g}")
    predicted = report.seconds_to(error)
    low, high = report.seconds_interval(error)
    what = loaded.quantity()
    batches: list[list[np.ndarray]] = [[] for _ in what.parts]
    tiled = what.tiled(spread(what, report.tile, report.deviations)) if report.tile else what
    wanted = budget.Budget(error, None, replace(report, tile=0, deviations=()))  # the tiles are in what is recorded
    bought = [
        budget.spend(recorded(tiled, batches), wanted, seed=RUN_SEED + 1000 * number + run, progress=None)
        for run in range(runs)
    ]
    times = np.array([told.seconds for _values, told in bought])
    counts = np.array([list(told.batches.values()) for _values, told in bought], float)
    blocks = list(what.blocks.values())
    found, found_error = reached(batches, counts, blocks, np.array([name in report.seen for name in what.blocks]))
    scattered = scatter([[values[what.blocks[name]] for name in report.seen] for values, _told in bought])
    return {
        "asked error": error,
        "pilot, s": report.pilot_seconds,
        "predicted, s": predicted,
        "95 %": f"{low:.3g} .. {high:.3g}",
        "measured, s": float(times.mean()),
        "measured / predicted": float(times.mean()) / predicted,
        "±": float(times.std(ddof=1)) / math.sqrt(runs) / predicted,
        "reached error": found,
        "reached / asked": found / error,
        "± ": found_error / error,
        "scatter / asked": scattered / error,
        "said / asked": statistics.median(told.error for _values, told in bought) / error,
        "heavy tails": ", ".join(report.heavy_tailed),
        "time within": abs(float(times.mean()) / predicted - 1.0) <= TIME_WITHIN,
        "error within": abs(found / error - 1.0) <= ERROR_WITHIN,
    }


def main() -> None:
    """Run and print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="cpu: processor time of all threads")
    parser.add_argument("--only", help="pairs whose name holds this text")
    parser.add_argument("--adjoint", choices=("loss", "waves"), default="loss", help="of a loss, or smooth")
    parser.add_argument("--pilots", type=int, default=2, help="of each pair")
    parser.add_argument("--resume", type=Path, help="keep finished rows in this file, and do not measure them again")
    options = parser.parse_args()
    runs = options.repeat or (6 if options.quick else 16)
    resolution, seconds, pilot = (32, 0.3, 1.5) if options.quick else (64, 1.0, 4.0)
    psdr.set_workers(options.threads)
    report = Report("accuracy, predicted and spent", options.output)
    rows = []

    def measure(pair: Pair) -> dict:
        with tempfile.TemporaryDirectory() as name:
            loaded = Loaded(pair, Path(name), resolution, options.adjoint)
            found = measured(
                loaded, seconds=seconds, pilot=pilot, pilots=options.pilots, runs=runs, clock=options.clock
            )
        return {"rows": found}

    for pair in (*PAIRS, *FRESH):
        if options.only and options.only not in str(pair):
            continue
        method = f"{options.adjoint}, {options.clock}, {options.pilots} pilots, {runs} runs"
        key = {"kind": "prediction", "case": str(pair), "method": method, "pixels": resolution}
        for row in kept(options.resume, key, functools.partial(measure, pair))["rows"]:
            rows.append({"pair": str(pair), "new": pair in FRESH} | row)
            time = f"time {row['measured / predicted']:.2f} ± {row['±']:.2f}"
            print(f"  {pair}: {time}, error {row['reached / asked']:.2f} ± {row['± ']:.2f}", flush=True)
    report.table(f"{resolution}^2 pixels, {runs} runs each, {options.clock} time", rows)
    summary = []
    for name, judged in (("all", rows), ("new", [row for row in rows if row["new"]])):
        if judged:
            shares = {key: statistics.mean(row[key] for row in judged) for key in ("time within", "error within")}
            both = {f"{key}, share": share for key, share in shares.items()}
            summary.append({"pairs": name, "cases": len(judged)} | both | {"as asked": min(shares.values()) >= SHARE})
    report.table("summary", summary)


if __name__ == "__main__":
    main()

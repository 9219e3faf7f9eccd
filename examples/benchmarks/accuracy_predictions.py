"""What accuracy costs: predicted by ``psdr.accuracy``, then spent and measured.

    python examples/benchmarks/accuracy_predictions.py [--quick] [--clock cpu] [--resume rows.jsonl] [--output ...]

For every pair of a scene and a parameter a pilot predicts the error that ``seconds`` buy. That error is then asked for
by ``render_backward(..., target_error=...)`` with the pilot's report, again and again with seeds of their own. Measured
are the median time, and the error as the scatter of the runs: each is unbiased (``tests/test_accuracy_budget.py``). The
clock "cpu" counts the processor time of all threads, for machines that do other work. "Heavy tails" names the terms of
which the pilot says that rare large samples carry their variance, and that its prediction is therefore unreliable.
"""

import functools
import statistics
import tempfile
from pathlib import Path

from accuracy_cases import PAIRS, Loaded, Pair, kept, scatter
from common import Report, arguments, psdr

#: What the project asks of predictions: time within 25 %, error within 20 %, in 80 % of the pairs.
TIME_WITHIN, ERROR_WITHIN, SHARE = 0.25, 0.20, 0.8
#: Least number of batches of each term in the time that is predicted.
LEAST_BATCHES = 8.0


def measured(loaded: Loaded, *, seconds: float, pilot: float, runs: int, clock: str) -> dict:
    """Return a row of the table."""
    report = loaded.accuracy(seconds=pilot, clock=clock, seed=1)
    # Where batches are long, time for a few of them; two digits, as people ask for.
    seconds = max(seconds, LEAST_BATCHES * float(report.cost.sum()))
    error = float(f"{report.error_in(seconds):.2g}")
    predicted = report.seconds_to(error)
    low, high = report.seconds_interval(error)
    bought = [loaded.spend(target_error=error, report=report, seed=100 + run) for run in range(runs)]
    took = statistics.median(reached.seconds for reached, _found in bought)
    reached = scatter([found for _reached, found in bought])
    return {
        "asked error": error,
        "pilot, s": report.pilot_seconds,
        "predicted, s": predicted,
        "95 %": f"{low:.3g} .. {high:.3g}",
        "measured, s": took,
        "measured / predicted": took / predicted,
        "reached error": reached,
        "reached / asked": reached / error,
        "said / asked": statistics.median(r.error for r, _found in bought) / error,
        "heavy tails": ", ".join(report.heavy_tailed),
        "time within": abs(took / predicted - 1.0) <= TIME_WITHIN,
        "error within": abs(reached / error - 1.0) <= ERROR_WITHIN,
    }


def main() -> None:
    """Run and print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="cpu: processor time of all threads")
    parser.add_argument("--only", help="pairs whose name holds this text")
    parser.add_argument("--adjoint", choices=("loss", "waves"), default="loss", help="of a loss, or smooth")
    parser.add_argument("--resume", type=Path, help="keep finished rows in this file, and do not measure them again")
    options = parser.parse_args()
    runs = options.repeat or (12 if options.quick else 32)
    resolution, seconds, pilot = (32, 0.3, 1.5) if options.quick else (64, 1.0, 4.0)
    psdr.set_workers(options.threads)
    report = Report("accuracy, predicted and spent", options.output)
    rows = []

    def measure(pair: Pair) -> dict:
        with tempfile.TemporaryDirectory() as name:
            loaded = Loaded(pair, Path(name), resolution, options.adjoint)
            return measured(loaded, seconds=seconds, pilot=pilot, runs=runs, clock=options.clock)

    for pair in PAIRS:
        if options.only and options.only not in str(pair):
            continue
        method = f"{options.adjoint}, {options.clock}"
        key = {"kind": "prediction", "case": str(pair), "method": method, "pixels": resolution}
        row = kept(options.resume, key, functools.partial(measure, pair))
        rows.append({"pair": str(pair)} | row)
        print(f"  {pair}: time {row['measured / predicted']:.2f}, error {row['reached / asked']:.2f}", flush=True)
    report.table(f"{resolution}^2 pixels, {runs} runs each, {options.clock} time", rows)
    shares = {key: statistics.mean(row[key] for row in rows) for key in ("time within", "error within")}
    both = {f"{key}, share of pairs": share for key, share in shares.items()}
    report.table("summary", [both | {"as asked": min(shares.values()) >= SHARE}])


if __name__ == "__main__":
    main()

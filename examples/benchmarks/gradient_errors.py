"""Error bars of gradients (``render_backward(errors=True)``): what they cost, and how often they hold.

    python examples/benchmarks/gradient_errors.py [--quick] [--output docs/data/gradient_errors.jsonl]

Gradients of equal samples a pixel, with and without error bars, in turns and of other random numbers each. A row gives
the ratio of processor times (median), the ratio of variances (sums over all numbers), and how often 95 % bars hold the
mean of all gradients without bars.
"""

import tempfile
from pathlib import Path

import numpy as np
from accuracy_cases import FRESH, PAIRS, Loaded
from common import Report, arguments, in_turns, psdr, ratio
from scipy import stats

RESOLUTION, SPP = 96, 256
#: Of Student's t with seven degrees of freedom.
FACTOR = float(stats.t.ppf(0.975, 7))


def row_of(pair, folder: Path, repeat: int, resolution: int) -> dict:
    """Return what bars cost for one gradient, and how often they hold."""
    loaded = Loaded(pair, folder, resolution, adjoint="waves")
    params, found = loaded.params, {False: [], True: []}
    deviations = []

    def gradient(errors: bool):
        def run(repetition: int) -> None:
            params.zero_grad()
            seed = 2 * repetition + errors
            options = {"integrator": loaded.integrator, "spp": SPP, "seed": seed, "errors": errors}
            psdr.render_backward(loaded.scene, params, loaded.adjoint, **options)
            found[errors].append(np.concatenate([params[n].grad.numpy().ravel() for n in params.requested]))
            if errors:
                deviations.append(np.concatenate([params[n].std.numpy().ravel() for n in params.requested]))

        return run

    psdr.guiding.set_automatic(loaded.scene, False)
    times = in_turns({"plain": gradient(False), "bars": gradient(True)}, repeat)
    plain, bars, std = (np.array(x, float) for x in (found[False], found[True], deviations))
    mean = plain.mean(axis=0)
    told = std.mean(axis=0) > 0.0
    # The mean of gradients without bars has an error, too.
    wide = FACTOR * np.hypot(std, plain.std(axis=0, ddof=1) / np.sqrt(len(plain)))
    held = np.abs(bars - mean)[:, told] < wide[:, told]
    spread = [float(x.var(axis=0, ddof=1).sum()) for x in (bars, plain)]
    return {
        "gradient": str(pair),
        "numbers": int(told.sum()),
        "time over that without": ratio(times, "bars", "plain", "cpu"),
        "variance over that without": spread[0] / spread[1],
        "95 % bars hold": float(held.mean()),
    }


def main() -> None:
    """Measure all gradients and report them."""
    parser = arguments(__doc__)
    options = parser.parse_args()
    repeat = options.repeat or (8 if options.quick else 12)
    report, rows = Report("gradient_errors", options.output), []
    with tempfile.TemporaryDirectory() as folder:
        for pair in [p for p in (*PAIRS, *FRESH) if p.parameters][: 3 if options.quick else None]:
            rows.append(row_of(pair, Path(folder), repeat, 16 if options.quick else RESOLUTION))
            print(rows[-1], flush=True)
    report.table("error bars of gradients", rows)


if __name__ == "__main__":
    main()

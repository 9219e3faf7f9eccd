"""Primal images against Mitsuba 3's ``path``: equal within noise, at what speed and at what error.

    python examples/benchmarks/primal_against_mitsuba.py [--quick] [--cases NAME ...] [--output results.jsonl]

Both renderers load the same files and take turns. "throughput" is Mitsuba's time over ours at equal samples; "time at
equal error" is the same ratio with each time multiplied by the renderer's variance. Samplers are each renderer's
default: independent in Mitsuba, Owen-scrambled Sobol here; the throughput is measured with them, too.
"""

import tempfile
from pathlib import Path

import numpy as np
from common import Report, arguments, blocks, import_mitsuba, in_turns, median, psdr, ratio, z_test

from scenes import CASES, write_data

#: Blocks a side of the z-test, independent images of each renderer.
BLOCKS, SEEDS = 16, 16
SPP = 16
#: Brightest share of the pixels' variances that the error leaves out: single fireflies would decide it.
TRIM = 0.001


def variance(images: np.ndarray) -> float:
    """Relative variance of a pixel, averaged."""
    mean = images.mean(axis=0)
    relative = images.var(axis=0, ddof=1) / (mean + 0.01 * mean.mean()) ** 2
    relative = np.sort(relative.mean(axis=-1).reshape(-1))
    return float(relative[: int((1.0 - TRIM) * len(relative))].mean())


def main() -> None:
    """Run the cases and print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    options = parser.parse_args()
    repeat = options.repeat or (5 if options.quick else 7)
    mi, dr = import_mitsuba(options.threads)
    psdr.set_workers(options.threads)
    report = Report("primal against Mitsuba", options.output)
    agreement, speed = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_data(folder)
        for case in options.cases:
            scene = CASES[case]
            file = scene.write(folder, case)
            integrator = psdr.PathIntegrator(max_depth=scene.max_depth, sampler="sobol")

            def ours(seed, scene, integrator=integrator):
                return psdr.render(scene, integrator=integrator, spp=SPP, seed=seed).numpy()

            def theirs(seed, scene):
                image = mi.render(scene, spp=SPP, seed=seed)
                dr.eval(image)
                dr.sync_thread()
                return image

            size = 64 if options.quick else 128
            a, b = psdr.load_file(file, resolution=size), mi.load_file(str(file), resolution=size)
            images = [
                np.stack([ours(seed, a) for seed in range(SEEDS)]).astype(np.float64),
                np.stack([np.array(theirs(seed, b)) for seed in range(SEEDS)]).astype(np.float64),
            ]
            test = z_test(blocks(images[0], BLOCKS), blocks(images[1], BLOCKS))
            means = [float(i.mean()) for i in images]
            row = {"scene": case, "mean": means[0], "Mitsuba's mean": means[1], "max abs z": test["max_z"]}
            row |= {"limit": test["limit"], "p (chi2)": test["p"]}
            passed = test["max_z"] < test["limit"] and test["p"] > 1e-3
            row["equal"] = passed if scene.exact else "other geometry"
            agreement.append(row)
            resolution = 128 if options.quick else 256
            c, d = psdr.load_file(file, resolution=resolution), mi.load_file(str(file), resolution=resolution)
            times = in_turns(
                {"ours": lambda i, c=c, ours=ours: ours(i, c), "mitsuba": lambda i, d=d: theirs(i, d)}, repeat
            )
            gain = variance(images[1]) / variance(images[0])
            speed.append(
                {
                    "scene": case,
                    "pixels": f"{resolution}^2",
                    "ours [s]": median(times, "ours"),
                    "Mitsuba [s]": median(times, "mitsuba"),
                    "throughput": ratio(times, "mitsuba", "ours"),
                    "throughput (CPU time)": ratio(times, "mitsuba", "ours", "cpu"),
                    "variance, Mitsuba / ours": gain,
                    "time at equal error": gain * ratio(times, "mitsuba", "ours"),
                }
            )
    title = f"z-test of {BLOCKS}^2 blocks, {SEEDS} seeds of {SPP} samples each"
    report.table(title, agreement)
    report.table(f"speed at {SPP} samples a pixel, medians of {repeat}, {options.threads} threads", speed)


if __name__ == "__main__":
    main()

"""Worker threads: speed of the primal and of the gradient pass, and equal bits for any number of them.

python examples/benchmarks/scaling.py [--quick] [--output results.jsonl]
"""

import tempfile
from pathlib import Path

import numpy as np
import warp as wp
from common import Report, arguments, in_turns, median, psdr, ratio

from scenes import CASES, write_data

SCENES = ("Cornell box", "82k triangles")
SPP = 16


def main() -> None:
    """Measure and print the table."""
    options = arguments(__doc__).parse_args()
    repeat = options.repeat or (5 if options.quick else 7)
    resolution = 96 if options.quick else 256
    report = Report("scaling", options.output)
    counts = sorted({1, 2, options.threads} | {2**k for k in range(1, 8) if 2**k <= options.threads})
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_data(folder)
        for case in SCENES:
            scene = psdr.load_file(CASES[case].write(folder, case), resolution=resolution)
            integrator = psdr.PathIntegrator(max_depth=6, boundary=None)
            params = psdr.traverse(scene)
            params.requires_grad(*[n for n in params if n.endswith(("reflectance.value", "vertex_positions"))])
            adjoint = wp.full((resolution, resolution), wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3, device="cpu")

            def primal(n, scene=scene, integrator=integrator):
                psdr.set_workers(n)
                return psdr.render(scene, integrator=integrator, spp=SPP, seed=1).numpy()

            def gradient(n, scene=scene, integrator=integrator, params=params, adjoint=adjoint):
                psdr.set_workers(n)
                for key in params.requested:
                    params[key].grad.zero_()
                psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=SPP, seed=1)
                return np.concatenate([params[key].grad.numpy().reshape(-1) for key in params.requested])

            for what, function in (("primal", primal), ("reflectances + vertices", gradient)):
                results = {n: function(n) for n in counts}
                same = all(np.array_equal(results[n], results[1]) for n in counts) and bool(results[1].any())
                times = in_turns({n: lambda _, n=n, f=function: f(n) for n in counts}, repeat)
                for n in counts:
                    row = {"scene": case, "pass": what, "workers": n, "seconds": median(times, n)}
                    rows.append(row | {"speed-up": ratio(times, 1, n), "equal bits": same})
    psdr.set_workers(None)
    report.table(f"{resolution}^2 pixels, {SPP} samples, depth 6, medians of {repeat}", rows)


if __name__ == "__main__":
    main()

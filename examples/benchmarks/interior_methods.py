"""What the methods of the interior term cost, and where they differ: processor time, noise, and a factor that is zero.

    python examples/benchmarks/interior_methods.py [--quick] [--output results.jsonl]

The gradient of the mean of the image by the Cornell box's reflectances, from independent seeds. In the second scene the
red wall reflects no green and no blue: a method that divides by the factor loses a part of the derivative by these.
``gradient of black`` is that component relative to its value by the first method.
"""

import time

import numpy as np
from common import ROOT, Report, arguments, psdr

NAMES = ("red.reflectance.value", "green.reflectance.value", "white.reflectance.value")
BLACK = [0.57, 0.0, 0.0]


def main() -> None:
    """Run and print the table."""
    options = arguments(__doc__).parse_args()
    resolution, spp, seeds = (32, 16, 16) if options.quick else (128, 16, 32)
    psdr.set_workers(options.threads)
    report = Report("interior methods", options.output)
    scene = psdr.load_file(ROOT / "scenes" / "cornell_box.xml", device="cpu", resolution=resolution)
    params = psdr.traverse(scene)
    params.requires_grad(*NAMES)
    adjoint = np.full((resolution, resolution, 3), 1.0 / (3 * resolution * resolution), np.float32)
    integrators = {
        m.option: psdr.PathIntegrator(max_depth=6, interior=_interior(m.option))
        for m in psdr.methods()
        if m.term == "interior"
    }
    methods = {label: method for label, method in integrators.items() if _serves(scene, params, method)}
    coloured = {label: _gradients(scene, params, adjoint, method, spp, seeds) for label, method in methods.items()}
    params[NAMES[0]] = BLACK
    params.update()
    black = {label: _gradients(scene, params, adjoint, method, spp, seeds) for label, method in methods.items()}
    reference = next(iter(methods))
    rows = []
    for label in methods:
        seconds, found = coloured[label]
        rows.append(
            {
                "method": label,
                "processor seconds": seconds,
                "relative standard deviation": _noise(found),
                "gradient of black": float(black[label][1].mean(axis=0)[1] / black[reference][1].mean(axis=0)[1]),
            }
        )
    report.table(f"Interior methods: Cornell box, {resolution} × {resolution} pixels, {spp} samples, depth 6", rows)


def _serves(scene, params, integrator) -> bool:
    """Whether a method estimates the derivatives that are asked for."""
    try:
        psdr.plan(scene, params, integrator=integrator)
    except ValueError as error:
        print(f"left out: {error}")
        return False
    return True


def _interior(option: str) -> psdr.interior.Method:
    """Return the method of an option such as "interior.Replay()"."""
    return eval(option, {"interior": psdr.interior})


def _gradients(scene, params, adjoint, integrator, spp: int, seeds: int) -> tuple[float, np.ndarray]:
    """Return the median processor time of a gradient, and the gradients, shape (seeds, values)."""
    times, found = [], []
    for seed in range(seeds + 1):
        params.zero_grad()
        start = time.process_time()
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=spp, seed=seed)
        if seed:  # the first one compiles
            times.append(time.process_time() - start)
            found.append(np.concatenate([params[name].grad.numpy().ravel() for name in NAMES]))
    return float(np.median(times)), np.stack(found).astype(float)


def _noise(gradients: np.ndarray) -> float:
    """Root mean square deviation of a gradient over its length."""
    return float(np.sqrt(gradients.var(axis=0, ddof=1).sum()) / np.linalg.norm(gradients.mean(axis=0)))


if __name__ == "__main__":
    main()

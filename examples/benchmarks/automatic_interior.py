"""What ``interior="auto"`` chooses at glossy surfaces, and how far that is from the best of all methods.

    python examples/benchmarks/automatic_interior.py [--quick] [--output results.jsonl]

The cases of ``shape_derivatives.py``, in reverse mode. Every method that can estimate a gradient has its variance, the
mean over all pilots, and its processor time against replay, measured; their product says which is the best. The pilot
of "auto", which looks at no clock, runs with several seeds: the table has what it chose, and variance times time of its
choices (the mean over the seeds) and of the best method, both over replay's.
"""

import numpy as np
import warp as wp
from common import Report, arguments, in_turns, psdr, ratio
from shape_derivatives import DEPTH, NORMALS, OTHERS, SHAPES, scene_of

from warp_psdr.estimate import choice as pilot
from warp_psdr.plan import choice

#: Pilots of a case.
SEEDS = 12
METHODS = (psdr.interior.Resampled(), psdr.interior.Decomposed(), psdr.interior.Antithetic())


def main() -> None:
    """Run and print the table."""
    parser = arguments(__doc__)
    parser.add_argument("--skip", nargs="*", default=[], help="cases whose names hold one of these words are left out")
    options = parser.parse_args()
    size = 64 if options.quick else 128
    psdr.set_workers(options.threads)
    report = Report("automatic methods", options.output)
    rows = []
    for name, material, parameter, _direction, width, power, sky in (*SHAPES, *OTHERS, *NORMALS):
        if any(word in name for word in options.skip):
            continue
        scene = scene_of(material, width, power, sky, size)
        rows.append({"case": name, **_measured(scene, parameter, size, options.repeat or 5)})
        print(rows[-1])
    report.table(f"Choices by pilots: a ball, {size} × {size} pixels, depth {DEPTH}, {SEEDS} pilots a case", rows)


def _measured(scene: psdr.Scene, parameter: str, size: int, repeat: int) -> dict:
    """Return the row of a case but for its name."""
    params = psdr.traverse(scene)
    params.requires_grad(parameter)
    named = {"replay": psdr.interior.Replay()} | {type(m).__name__.lower(): m for m in METHODS}
    integrators, variances = {}, {}
    given = wp.full((size, size), wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3, device=scene.device)
    for label, method in named.items():
        integrator = psdr.PathIntegrator(max_depth=DEPTH, interior=method, boundary=None)
        try:
            plan = psdr.plan(scene, params, integrator=integrator)
        except ValueError:
            continue
        integrators[label] = integrator
        seen = [pilot.variance(scene, plan, [parameter], "reverse", 0, 1000 + s, given)[0] for s in range(SEEDS)]
        variances[label] = float(np.mean(seen))
    adjoint = np.ones((size, size, 3), np.float32)

    def gradient(integrator):
        return lambda seed: psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=4, seed=seed)

    times = in_turns({label: gradient(i) for label, i in integrators.items()}, repeat)
    gains = {label: variances["replay"] / v / ratio(times, label, "replay", "cpu") for label, v in variances.items()}
    best = max(gains, key=lambda label: gains[label])
    plan = psdr.plan(scene, params, integrator=psdr.PathIntegrator(max_depth=DEPTH, boundary=None))
    chosen = []
    for seed in range(SEEDS):
        found = choice.Choice()
        pilot.decide(found, scene, plan, [parameter], "reverse", 0, seed, given)
        chosen.append(_label(found.method))
    return {
        "best": best,
        "gain of the best": gains[best],
        "auto": ", ".join(f"{label} {chosen.count(label)}" for label in dict.fromkeys(chosen)),
        "mean gain of auto": float(np.mean([gains[label] for label in chosen])),
    }


def _label(method) -> str:
    if method is None:
        return "replay"
    return method.shapes or method.normals


if __name__ == "__main__":
    main()

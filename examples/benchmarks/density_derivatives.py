"""Derivatives by the voxels of smoke: variance and time of differential ratio tracking against replay.

    python examples/benchmarks/density_derivatives.py [--quick] [--output results.jsonl]

Smoke in a cube, most of whose voxels are empty, under a sky or a point light. The variance is that of the derivatives
by single voxels, the empty ones and the others apart, from independent seeds at equal samples; the time that of
gradients in reverse mode. What counts are the last columns, the ratios of the variances at equal time: above 1,
``interior.DifferentialRatioTracking`` pays.
"""

import numpy as np
from common import Report, arguments, in_turns, psdr, ratio

METHODS = {"replay": psdr.interior.Replay(), "ratio tracking": psdr.interior.DifferentialRatioTracking()}
#: Depth of the paths.
DEPTH = 5
DENSITY = "cube.interior_medium.sigma_t.data"
SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 0.8, 0.6]}}
BULB = {"type": "point", "position": [2.0, -1.5, 2.5], "intensity": 4.0}
#: (name, scale of the density, lights, whether it differs between channels).
CASES = (
    ("thin smoke under a sky", 1.0, {"sky": SKY}, False),
    ("smoke under a sky", 4.0, {"sky": SKY}, False),
    ("coloured smoke under a sky", 4.0, {"sky": SKY}, True),
    ("smoke beside a point light", 4.0, {"bulb": BULB}, False),
)


def puffs(n: int, channels: int) -> np.ndarray:
    """Return the density of some smoke, (n, n, n, channels)."""
    x = (np.arange(n) + 0.5) / n * 2.0 - 1.0
    z, y, x = np.meshgrid(x, x, x, indexing="ij")
    found = np.zeros((n, n, n))
    for cx, cy, cz, r in ((-0.3, 0.1, -0.3, 0.5), (0.35, -0.2, 0.2, 0.45), (0.0, 0.3, 0.6, 0.3)):
        found += np.exp(-((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2) / (0.5 * r * r))
    found = np.clip(found - 0.1, 0.0, None)
    return (found[..., None] * np.array([1.0, 0.8, 0.5])[:channels]).astype(np.float32)


def scene_of(scale: float, lights: dict, coloured: bool, size: int, voxels: int) -> psdr.Scene:
    """Return a scene."""
    t = psdr.Transform
    box = t.translate([-1.0, -1.0, -1.0]) @ t.scale(2.0)
    smoke = {
        "type": "heterogeneous",
        "sigma_t": {"type": "gridvolume", "data": puffs(voxels, 3 if coloured else 1), "to_world": box},
        "albedo": 0.8,
        "scale": scale,
    }
    description = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 30.0,
            "to_world": t.look_at([4.0, 3.0, 2.5], [0.0, 0.0, 0.0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        },
        "cube": {"type": "cube", "bsdf": {"type": "null"}, "interior": smoke},
        **lights,
    }
    return psdr.load_dict(description, device="cpu")


def main() -> None:
    """Run and print the table."""
    options = arguments(__doc__).parse_args()
    size, spp, seeds, voxels = (16, 16, 8, 16) if options.quick else (32, 64, 16, 32)
    psdr.set_workers(options.threads)
    report = Report("voxels of smoke", options.output)
    rows = []
    for name, scale, lights, coloured in CASES:
        scene = scene_of(scale, lights, coloured, size, voxels)
        params = psdr.traverse(scene)
        params.requires_grad(DENSITY)
        empty = params[DENSITY].numpy() == 0.0
        adjoint = np.ones((size, size, 3), np.float32)

        def gradient(method, scene=scene, params=params, adjoint=adjoint):
            integrator = psdr.PathIntegrator(max_depth=DEPTH, interior=method)

            def backward(number: int) -> None:
                psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=spp, seed=number)

            return backward

        passes = {label: gradient(method) for label, method in METHODS.items()}
        variance = {}
        for label, run in passes.items():
            found = []
            for seed in range(seeds):
                params.zero_grad()
                run(seed)
                found.append(params[DENSITY].grad.numpy().astype(np.float64))
            of_voxels = np.var(found, axis=0, ddof=1)
            variance[label] = float(of_voxels[empty].mean()), float(of_voxels[~empty].mean())
        times = in_turns(passes, options.repeat or 5)
        cost = ratio(times, "ratio tracking", "replay", "cpu")
        of_empty, of_others = (a / b / cost for a, b in zip(*variance.values(), strict=True))
        found = {"time of a sample": cost, "empty voxels, equal time": of_empty, "other voxels, equal time": of_others}
        rows.append({"case": name, **found})
    report.table(
        f"Derivatives by voxels: {voxels}³ of smoke, {size} × {size} pixels, {spp} samples, depth {DEPTH}", rows
    )


if __name__ == "__main__":
    main()

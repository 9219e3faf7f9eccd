"""Derivatives by the roughness of metal under a sky: ``interior.Attached`` against ``interior.Replay``.

    python examples/benchmarks/attached_samples.py [--quick] [--output results.jsonl]

A ball from which nothing but the sky is seen. The variance is that of the derivative image, all pixels together, from
independent seeds at equal samples, the time that of such images. The ratios are of variance times time, that of replay
over that of the method: above 1 it pays.
"""

import numpy as np
from common import Report, arguments, in_turns, psdr, ratio

ATTACHED = psdr.interior.Attached
METHODS = {
    "replay": psdr.interior.Replay(),
    "attached, weights attached": ATTACHED(bsdf="attached", weights="attached"),
    "attached, weights by position": ATTACHED(bsdf="attached", weights="position"),
    "resampled": psdr.interior.Resampled(),
}
#: (name, distribution, roughness, waves of the sky around the horizon; 0: it is even).
CASES = (
    ("even sky, GGX 0.05", "ggx", 0.05, 0),
    ("smooth sky, GGX 0.4", "ggx", 0.4, 2),
    ("smooth sky, GGX 0.1", "ggx", 0.1, 2),
    ("smooth sky, GGX 0.02", "ggx", 0.02, 2),
    ("smooth sky, GGX 0.004", "ggx", 0.004, 2),
    ("smooth sky, Beckmann 0.05", "beckmann", 0.05, 2),
    ("sky of many waves, GGX 0.1", "ggx", 0.1, 16),
    ("sky of many waves, GGX 0.02", "ggx", 0.02, 16),
)


def scene_of(distribution: str, alpha: float, waves: int, size: int) -> psdr.Scene:
    """Return a scene."""
    look_at = psdr.Transform.look_at
    columns = max(16, 8 * waves)
    theta, phi = np.linspace(0, np.pi, columns // 2 + 1)[:, None], (np.arange(columns) + 0.5) / columns * 2 * np.pi
    brightness = 1.1 + np.sin(theta) ** 2 * np.sin(waves * phi)
    image = (brightness[..., None] * np.array([1.0, 0.9, 0.7])).astype(np.float32)
    return psdr.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 32.0,
                "to_world": look_at([0, -4, 1.2], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
            },
            "ball": {
                "type": "sphere",
                "face_normals": True,
                "bsdf": {"type": "roughconductor", "material": "Au", "distribution": distribution, "alpha": alpha},
            },
            "sky": {"type": "envmap", "bitmap": image} if waves else {"type": "constant"},
        },
        device="cpu",
    )


def main() -> None:
    """Run and print the table."""
    options = arguments(__doc__).parse_args()
    size, spp, seeds = (32, 4, 24) if options.quick else (64, 16, 32)
    psdr.set_workers(options.threads)
    report = Report("attached samples", options.output)
    name, rows = "ball.bsdf.alpha.value", []
    for case, distribution, alpha, waves in CASES:
        scene = scene_of(distribution, alpha, waves, size)
        params = psdr.traverse(scene)
        params.requires_grad(name)
        integrators = {label: psdr.PathIntegrator(max_depth=2, interior=method) for label, method in METHODS.items()}

        def derivative(integrator, scene=scene, params=params):
            options = {"integrator": integrator, "spp": spp}
            return lambda seed: psdr.render_forward(scene, params, {name: 1.0}, seed=seed, **options).numpy()

        draw = {label: derivative(integrator) for label, integrator in integrators.items()}
        variance = {
            label: np.var(np.array([image(s) for s in range(seeds)], np.float64), axis=0, ddof=1).sum()
            for label, image in draw.items()
        }
        times = in_turns(draw, options.repeat or 5)
        gains = {
            label: float(variance["replay"] / variance[label]) / ratio(times, label, "replay", "cpu")
            for label in METHODS
            if label != "replay"
        }
        rows.append({"case": case, **gains})
    report.table(f"Derivatives by a roughness: a ball, {size} × {size} pixels, {spp} samples; gain over replay", rows)


if __name__ == "__main__":
    main()

"""Bidirectional paths beside paths from one side: noise and processor time, image and derivative.

    python examples/benchmarks/bidirectional.py [--quick] [--output results.jsonl]

A caustic below a glass ball whose light is a small sphere; a white room under a lamp, and the same with the lamp turned
to the ceiling close above it. Noise is the root mean square over the pixels of floor and wall alone, relative to their
mean; the gain is in noise² x processor time, over path tracing. The derivative is that by the reflectance of the floor.
"""

import time

import numpy as np
from caustic import NAME, described
from common import Report, arguments, psdr

T = psdr.Transform
BATCHES, DEPTH = 16, 6


def room(turned: bool, size: int) -> dict:
    """A floor, a wall and a ceiling, and a lamp between, which shines down or up."""
    white = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.7, 0.6]}}}
    lamp = T.translate([0.0, 0.0, 1.9]) @ T.rotate([1.0, 0.0, 0.0], 0.0 if turned else 180.0) @ T.scale(0.3)
    wall = T.translate([0.0, 1.5, 1.0]) @ T.rotate([1.0, 0.0, 0.0], 90.0) @ T.scale(1.5)
    return {
        "type": "scene",
        "camera": described(False, size)["camera"],
        "floor": {"type": "rectangle", "to_world": T.scale(1.5), "bsdf": white["inner"]},
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": white},
        "ceiling": {"type": "rectangle", "to_world": T.translate([0.0, 0.0, 2.0]) @ T.scale(1.5), "bsdf": white},
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": 5.0}},
    }


def main() -> None:
    """Run and print the table."""
    options = arguments(__doc__).parse_args()
    size, spp = (48, 16) if options.quick else (96, 64)
    psdr.set_workers(1)
    report = Report("bidirectional", options.output)
    scenes = {
        "caustic": psdr.load_dict(described(False, size)),
        "lamp": psdr.load_dict(room(False, size)),
        "turned lamp": psdr.load_dict(room(True, size)),
    }
    methods = {
        "Replay()": psdr.interior.Replay(),
        "LightTracing()": psdr.interior.LightTracing(),
        "Bidirectional()": psdr.interior.Bidirectional(),
        'Bidirectional(connections="all")': psdr.interior.Bidirectional(connections="all"),
    }
    rows = []
    for name, scene in scenes.items():
        gains: dict[str, float] = {}
        for label, method in methods.items():
            row = {"scene": name, "method": label}
            for what in ("image", "derivative"):
                seconds, noise = _measure(scene, what == "derivative", method, spp)
                gains.setdefault(what, noise**2 * seconds)
                row |= {f"{what}: seconds": seconds, f"{what}: noise": noise}
                row |= {f"{what}: gain": gains[what] / (noise**2 * seconds)}
            rows.append(row)
    report.table(f"Bidirectional paths, {size} × {size} pixels, {spp} samples, depth {DEPTH}", rows)


def _measure(scene, derivative: bool, method, spp: int) -> tuple[float, float]:
    """Return the median processor time, and the relative noise over independent seeds; the first call compiles."""
    params = psdr.traverse(scene)
    chosen = {"integrator": psdr.PathIntegrator(max_depth=DEPTH, interior=method), "spp": spp}
    times, found = [], []
    shapes = np.asarray(next(iter(psdr.render_aov(scene, "shape:shape_index", spp=16).values())))
    seen = np.isin(shapes.reshape(shapes.shape[:2]), [0.0, 1.0])  # the first two shapes
    for seed in range(BATCHES + 1):
        start = time.process_time()
        if derivative:
            image = psdr.render_forward(scene, params, {NAME: np.ones(3, np.float32)}, seed=seed, **chosen)
        else:
            image = psdr.render(scene, seed=seed, **chosen)
        if seed:
            times.append(time.process_time() - start)
            found.append(image.numpy().astype(float)[seen])
    noise = float(np.sqrt(np.var(found, axis=0, ddof=1).mean()) / np.mean(found))
    return float(np.median(times)), noise


if __name__ == "__main__":
    main()

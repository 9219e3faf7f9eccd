"""A caustic below a glass ball, by path tracing and by light tracing: noise at equal time, image and derivative.

    python examples/benchmarks/caustic.py [--quick] [--output results.jsonl] [--picture caustic.png]

The light is a small sphere, which paths from the camera find by chance, and then a point, which they never find. Noise
is that of the floor's pixels inside of the caustic, relative to their mean; the gain is in noise² x processor time. The
derivative is that by the floor's reflectance.
"""

import time
from pathlib import Path

import numpy as np
from common import Report, arguments, psdr

T = psdr.Transform
POSITION, RADIUS, INTENSITY, DEPTH = (0.6, 0.3, 2.2), 0.03, 6.0, 6
NAME = "floor.bsdf.reflectance.value"
#: Radiance from which on a pixel of the floor counts for the caustic; direct light gives a third of it.
BRIGHT = 0.6
BATCHES = 8
#: Pixels along a side of the picture for each of the table's images.
FINER = 2


def described(point: bool, size: int) -> dict:
    """A glass ball on a floor before a wall."""
    radiance = INTENSITY / (np.pi * RADIUS**2)
    sphere = {"type": "sphere", "center": list(POSITION), "radius": RADIUS}
    lights = {
        True: {"type": "point", "position": list(POSITION), "intensity": INTENSITY},
        False: {**sphere, "emitter": {"type": "area", "radiance": radiance}},
    }
    blue = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.3, 0.6, 0.7]}}
    wall = T.translate([0.0, 1.5, 1.0]) @ T.rotate([1.0, 0.0, 0.0], 90.0) @ T.scale(2.0)
    return {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "fov": 38.0,
            "to_world": T.look_at([0.2, -3.6, 2.4], [0.0, 0.0, 0.2], [0.0, 0.0, 1.0]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        },
        "floor": {
            "type": "rectangle",
            "to_world": T.scale(3.0),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.5, 0.4]}},
        },
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": {"type": "twosided", "inner": blue}},
        "ball": {"type": "sphere", "center": [0.0, 0.0, 0.55], "radius": 0.5, "bsdf": {"type": "dielectric"}},
        "light": lights[point],
    }


def main() -> None:
    """Run and print the table."""
    parser = arguments(__doc__)
    parser.add_argument("--picture", type=Path, help="write the three images side by side to this file")
    options = parser.parse_args()
    size, spp = (64, 64) if options.quick else (128, 64)
    psdr.set_workers(1)
    report = Report("caustic", options.output)
    methods = {"path tracing": psdr.interior.Replay(), "light tracing": psdr.interior.LightTracing()}
    cases = [("sphere", "path tracing", 4 * spp), ("sphere", "light tracing", spp), ("point", "light tracing", spp)]
    rows, gains = [], {}
    for light, label, samples in cases:
        scene = psdr.load_dict(described(light == "point", size))
        params = psdr.traverse(scene)
        chosen = {"integrator": psdr.PathIntegrator(max_depth=DEPTH, interior=methods[label]), "spp": samples}
        row = {"light": light, "method": label, "samples": samples}
        for what in ("image", "derivative"):
            seconds, batches = _batches(scene, params, what == "derivative", chosen)
            if what == "image":
                caustic = _caustic(scene, batches.mean(axis=0) if label == "light tracing" else None)
            noise = float(np.sqrt(batches.var(axis=0, ddof=1)[caustic].mean()) / batches[:, caustic].mean())
            row |= {f"{what}: seconds": seconds, f"{what}: noise": noise}
            gains.setdefault(what, noise**2 * seconds)
            row |= {f"{what}: gain": gains[what] / (noise**2 * seconds)}
        rows.append(row)
    report.table(f"Caustic of a glass ball, {size} × {size} pixels, depth {DEPTH}", rows)
    if options.picture:
        draw(options.picture, methods, cases, size * FINER)


def draw(picture: Path, methods: dict, cases: list[tuple[str, str, int]], size: int) -> None:
    """Write the images of the cases side by side; each is the mean of all batches."""
    images = []
    for light, label, samples in cases:
        scene = psdr.load_dict(described(light == "point", size))
        chosen = {"integrator": psdr.PathIntegrator(max_depth=DEPTH, interior=methods[label]), "spp": samples}
        batches = [psdr.render(scene, seed=seed, **chosen).numpy() for seed in range(1, BATCHES + 1)]
        images.append(np.mean(batches, axis=0))
    titles = [f"{light}, {label}, {BATCHES} x {samples} samples" for light, label, samples in cases]
    psdr.plots.side_by_side(picture, images, titles, columns=len(images))


def _batches(scene, params, derivative: bool, options: dict) -> tuple[float, np.ndarray]:
    """Return the median processor time and images of independent seeds; the first call compiles."""
    times, found = [], []
    for seed in range(BATCHES + 1):
        start = time.process_time()
        if derivative:
            image = psdr.render_forward(scene, params, {NAME: 1.0}, seed=seed, **options)
        else:
            image = psdr.render(scene, seed=seed, **options)
        if seed:
            times.append(time.process_time() - start)
            found.append(image.numpy().astype(float))
    return float(np.median(times)), np.array(found)


def _caustic(scene, image: np.ndarray | None) -> np.ndarray:
    """Return which pixels show the floor alone, inside of the caustic; ``image``: one with little noise."""
    if image is None:
        chosen = {"integrator": psdr.PathIntegrator(max_depth=DEPTH, interior=psdr.interior.LightTracing())}
        image = psdr.render(scene, spp=256, **chosen).numpy()
    shapes = np.asarray(next(iter(psdr.render_aov(scene, "shape:shape_index", spp=16).values())))
    floor = shapes.reshape(image.shape[:2]) == shapes.reshape(image.shape[:2])[-1, image.shape[1] // 2]
    return floor & (image[..., 0] > BRIGHT)


if __name__ == "__main__":
    main()

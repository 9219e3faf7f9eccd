"""Derivatives by a camera in a room: ``interior.FilmAntithetic`` against points drawn one by one, and against replay.

    python examples/benchmarks/film_points.py [--quick] [--output results.jsonl]

The variance is that of the derivative image, all pixels together, from independent seeds. Mirrored film points are
compared with those that are drawn one by one at equal samples, and with ``interior.Replay`` and its boundary term at
equal time: above 1 they pay.
"""

import numpy as np
from common import Report, arguments, in_turns, psdr, ratio

METHODS = {
    "mirrored": psdr.interior.FilmAntithetic(),
    "one by one": psdr.interior.FilmAntithetic(mirrored=False),
    "replay": psdr.interior.Replay(),
}
#: (name, filter, texels of a wall along an axis; 1: walls of one colour).
CASES = (
    ("walls of one colour, tent", "tent", 1),
    ("walls of one colour, Gaussian", "gaussian", 1),
    ("texels as wide as four pixels, Gaussian", "gaussian", 8),
    ("texels as wide as a pixel, Gaussian", "gaussian", 32),
)
SIZE = 32


def wall(points: list, texels: int, seed: int, **more) -> dict:
    """Return a rectangle with these corners, of one colour or of many texels with steps."""
    colors = np.random.default_rng(seed).uniform(0.1, 0.8, (texels, texels, 3)).astype(np.float32)
    painted = {"type": "bitmap", "bitmap": colors, "raw": True, "filter_type": "nearest"}
    plain = {"type": "rgb", "value": [float(c) for c in colors[0, 0]]}
    return {
        "type": "mesh",
        "vertices": np.array(points, np.float32),
        "faces": np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        "texcoords": np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32),
        "face_normals": True,
        "bsdf": {"type": "diffuse", "reflectance": painted if texels > 1 else plain},
        **more,
    }


def scene_of(rfilter: str, texels: int) -> psdr.Scene:
    """Return a room whose ceiling shines."""
    x, y, z = 2.0, 2.5, 1.5
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": [2.0, 1.8, 1.5]}}
    pose = psdr.Transform.look_at([-0.3, -1.5, -0.2], [0.4, 2.0, 0.3], [0, 0, 1])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": rfilter}, "sample_border": True}
    return psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 60.0, "to_world": pose, "film": film},
            "left": wall([(-x, -y, -z), (-x, y, -z), (-x, y, z), (-x, -y, z)], texels, 1),
            "right": wall([(x, y, -z), (x, -y, -z), (x, -y, z), (x, y, z)], texels, 2),
            "back": wall([(-x, y, -z), (x, y, -z), (x, y, z), (-x, y, z)], texels, 3),
            "front": wall([(x, -y, -z), (-x, -y, -z), (-x, -y, z), (x, -y, z)], texels, 4),
            "floor": wall([(-x, -y, -z), (x, -y, -z), (x, y, -z), (-x, y, -z)], texels, 5),
            "ceiling": wall([(-x, y, z), (x, y, z), (x, -y, z), (-x, -y, z)], 1, 6, emitter=lamp),
        },
        device="cpu",
    )


def main() -> None:
    """Run and print the table."""
    options = arguments(__doc__).parse_args()
    spp, seeds = (16, 12) if options.quick else (64, 32)
    psdr.set_workers(options.threads)
    report = Report("film points", options.output)
    name, rows = "sensor.to_world", []
    tangent = np.zeros((4, 4), np.float32)
    tangent[:3, 3] = (1.0, 0.3, 0.5)
    for case, rfilter, texels in CASES:
        scene = scene_of(rfilter, texels)
        params = psdr.traverse(scene)
        params.requires_grad(name)
        draw = {}
        for label, method in METHODS.items():
            if label == "replay" and texels > 1:  # textures with steps that slide
                continue
            how = {"integrator": psdr.PathIntegrator(max_depth=3, interior=method), "spp": spp}

            def derivative(seed, scene=scene, params=params, how=how):
                return psdr.render_forward(scene, params, {name: tangent}, seed=seed, **how).numpy()

            draw[label] = derivative
        variance = {
            label: np.var(np.array([image(s) for s in range(seeds)], np.float64), axis=0, ddof=1).sum()
            for label, image in draw.items()
        }
        times = in_turns(draw, options.repeat or 5)
        noise = {label: float(v / variance["mirrored"]) for label, v in variance.items()}
        replay = noise["replay"] * ratio(times, "replay", "mirrored", "cpu") if "replay" in draw else None
        rows.append({"case": case, "one by one, equal samples": noise["one by one"], "replay, equal time": replay})
    report.table(f"Derivatives by the pose of a camera: {SIZE} × {SIZE} pixels, {spp} samples; gain over", rows)


if __name__ == "__main__":
    main()

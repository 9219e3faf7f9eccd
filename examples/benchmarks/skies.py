"""What MIS compensation of environment maps is worth: variances without it over those with it.

    python examples/benchmarks/skies.py [--quick] [--output docs/data/skies.jsonl]

Every scene stands under every sky; images are rendered, and derivative images by the roughness, by a dim texel and by a
bright one. Both ways have equal kernels, so their times are equal. z is that of the difference of the images' means,
seed by seed. Derivatives have none: a path finds a dim texel now and then, and few seeds do not tell their spread.
"""

from collections.abc import Callable

import numpy as np
from common import Report, arguments, psdr

PIXELS, SPPS, SEEDS = 32, (4, 16, 64), 16
ROWS, COLUMNS = 32, 64


def skies() -> dict[str, np.ndarray]:
    """Return maps of radiance, (ROWS, COLUMNS, 3)."""
    rng = np.random.default_rng(1)
    theta, phi = np.meshgrid(np.linspace(0.0, np.pi, ROWS), 2.0 * np.pi * np.arange(COLUMNS) / COLUMNS, indexing="ij")
    up = np.cos(theta)
    ones = np.ones((ROWS, COLUMNS, 3))
    blue = np.where(up > 0.0, 0.3 + 0.7 * (1.0 - up) ** 4, 0.1)[..., None] * (0.5, 0.7, 1.0)
    sunny = blue.copy()
    sunny[8:10, 20:22] = 400.0
    overcast = np.where(up > 0.0, (1.0 + 2.0 * up) / 3.0, 0.2)[..., None] * ones
    lamps = 0.01 * ones
    for row, column in rng.integers((4, 0), (16, COLUMNS), (6, 2)):
        lamps[row, column] = 50.0
    return {
        "sun and blue sky": sunny,
        "overcast": overcast,
        "contrast of 5 %": (1.0 + 0.05 * np.sin(phi))[..., None] * ones,
        "lamps in the dark": lamps,
        "random texels": rng.random((ROWS, COLUMNS, 3)),
    }


def scenes() -> dict[str, dict]:
    """Return what stands under them."""
    floor = {"type": "rectangle", "to_world": psdr.Transform.scale([4.0, 4.0, 1.0])}
    ball = {"type": "sphere", "center": [0.0, 0.0, 1.0], "radius": 1.0}
    gold = {"type": "roughconductor", "material": "Au", "alpha": 0.2}
    roof = psdr.Transform.translate([0.0, 0.0, 2.6]) @ psdr.Transform.scale([2.0, 2.0, 1.0])
    smoke = {"type": "homogeneous", "sigma_t": 0.6, "albedo": 0.8}
    box = {"type": "cube", "to_world": psdr.Transform.translate([0.0, 0.0, 1.2]) @ psdr.Transform.scale(1.2)}
    return {
        "gold": {"floor": floor, "ball": ball | {"bsdf": gold}},
        "diffuse ball": {"floor": floor, "ball": ball},
        "under a roof": {
            "floor": floor,
            "ball": ball | {"bsdf": gold},
            "roof": {"type": "rectangle", "to_world": roof},
        },
        "in smoke": {"floor": floor, "smoke": box | {"bsdf": {"type": "null"}, "interior": smoke}},
    }


def load(parts: dict, sky: np.ndarray) -> psdr.Scene:
    """Load a scene; z points up."""
    look = psdr.Transform.look_at([0.0, -6.0, 2.5], [0.0, 0.0, 0.8], [0.0, 0.0, 1.0])
    film = {"type": "hdrfilm", "width": PIXELS, "height": PIXELS, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": 35.0, "to_world": look, "film": film}
    upright = psdr.Transform.rotate([1.0, 0.0, 0.0], 90.0)
    light = {"type": "envmap", "bitmap": sky.astype(np.float32), "to_world": upright}
    return psdr.load_dict({"type": "scene", "sensor": sensor, "sky": light, **parts})


def drawn(scene: psdr.Scene, compensated: bool, run: Callable[[int], np.ndarray], seeds: int) -> np.ndarray:
    """Return the images of some seeds, with the cells of one way."""
    lights, cells = scene.lights, type(scene.lights).cells
    lights.cells = lambda _asked: cells(lights, compensated)
    try:
        return np.stack([run(seed) for seed in range(seeds)]).astype(np.float64)
    finally:
        del lights.cells


def compared(scene: psdr.Scene, run: Callable[[int, int], np.ndarray], spp: int, seeds: int) -> dict:
    """Return the ratio of the variances, and z of the means."""
    plain, ours = (drawn(scene, way, lambda seed: run(spp, seed), seeds) for way in (False, True))
    before, after = (float(images.var(axis=0, ddof=1).mean()) for images in (plain, ours))
    apart = (plain - ours).mean(axis=(1, 2, 3))
    error = float(apart.std(ddof=1)) / np.sqrt(len(apart))
    return {"variance": before / after, "z": abs(float(apart.mean())) / max(error, 1e-30)}


def image_of(scene: psdr.Scene, integrator: psdr.PathIntegrator) -> Callable[[int, int], np.ndarray]:
    """Return what renders, for samples and a seed."""
    return lambda spp, seed: psdr.render(scene, integrator=integrator, spp=spp, seed=seed).numpy()


def derivative_of(
    scene: psdr.Scene, integrator: psdr.PathIntegrator, name: str, tangent: np.ndarray
) -> Callable[[int, int], np.ndarray]:
    """Return the same for a derivative image."""
    params, tangents = psdr.traverse(scene), {name: tangent}
    forward = psdr.render_forward
    return lambda spp, seed: forward(scene, params, tangents, integrator=integrator, spp=spp, seed=seed).numpy()


def texel(sky: np.ndarray, bright: bool) -> np.ndarray:
    """Return a tangent: of a map's brightest or dimmest texel above the horizon."""
    above = sky[: ROWS // 2].sum(axis=2)
    tangent = np.zeros((ROWS, COLUMNS, 3), np.float32)
    tangent[np.unravel_index(above.argmax() if bright else above.argmin(), above.shape)] = 1.0
    return tangent


def main() -> None:
    """Run the scenes and print the tables."""
    options = arguments(__doc__).parse_args()
    spps, seeds = ((16,), 4) if options.quick else (SPPS, SEEDS)
    psdr.set_workers(options.threads)
    report = Report("skies", options.output)
    integrator = psdr.PathIntegrator(max_depth=4, boundary=None)
    maps, gold, rows, zs = skies(), scenes()["gold"], [], []

    def add(title: str, spp: int, runs: dict[str, tuple]) -> None:
        found = {name: compared(scene, run, spp, seeds) for name, (scene, run) in runs.items()}
        rows.append({"of": title, "samples": spp} | {name: round(f["variance"], 2) for name, f in found.items()})
        if "derivative" not in title:
            zs.extend(f["z"] for f in found.values())

    for title, parts in scenes().items():
        loaded = {name: load(parts, sky) for name, sky in maps.items()}
        for spp in spps:
            add(title, spp, {name: (scene, image_of(scene, integrator)) for name, scene in loaded.items()})
    for title, key, tangent in (
        ("gold, derivative by its roughness", "ball.bsdf.alpha.value", lambda _sky: np.ones(1, np.float32)),
        ("gold, derivative by a dim texel", "sky.data", lambda sky: texel(sky, False)),
        ("gold, derivative by a bright texel", "sky.data", lambda sky: texel(sky, True)),
    ):
        loaded = {name: load(gold, sky) for name, sky in maps.items()}
        add(title, 16, {n: (s, derivative_of(s, integrator, key, tangent(maps[n]))) for n, s in loaded.items()})
    report.table("Variance without compensation over that with it", rows)
    row = {"comparisons": len(zs), "largest z": max(zs), "mean squared z": float(np.mean(np.square(zs)))}
    report.table("Images: means of both ways", [row])


if __name__ == "__main__":
    main()

"""Which sampler is the better default: variance times seconds of ``independent`` and ``sobol`` on the same scene.

Prints a Markdown table. Run: ``python examples/benchmarks/samplers.py [--spp 16 64] [--seeds 8]``.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import numpy as np

import warp_psdr as psdr

SCENES = Path(__file__).resolve().parents[2] / "scenes"


def sunlit() -> dict:
    """A bumpy plane and a sphere under a sky with a small sun."""
    sky = np.full((16, 32, 3), 0.3, np.float32)
    sky[4, 8] = 40.0
    look = psdr.Transform().look_at([0, 2, 5], [0, 0, 0], [0, 1, 0])
    ground = psdr.Transform().rotate([1, 0, 0], -90) @ psdr.Transform().scale(4)
    film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}}
    copper = {"type": "roughconductor", "material": "Cu", "alpha": 0.2}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sensor": {"type": "perspective", "fov": 45, "to_world": look, "film": film},
        "sky": {"type": "envmap", "bitmap": sky},
        "ground": {"type": "rectangle", "to_world": ground, "bsdf": {"type": "diffuse"}},
        "ball": {"type": "sphere", "center": [0, 1, 0], "bsdf": copper},
    }


def measure(scene, sampler: str, spp: int, seeds: int) -> tuple[float, float]:
    """Return (mean pixel variance over seeds, median seconds)."""
    integrator = psdr.PathIntegrator(max_depth=4, sampler=sampler)
    images, seconds = [], []
    psdr.render(scene, integrator=integrator, spp=1)
    for seed in range(seeds):
        start = time.perf_counter()
        images.append(psdr.render(scene, integrator=integrator, spp=spp, seed=seed).numpy())
        seconds.append(time.perf_counter() - start)
    return float(np.mean(np.var(np.stack(images), axis=0, ddof=1))), statistics.median(seconds)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--spp", type=int, nargs="+", default=[16, 64])
    parser.add_argument("--seeds", type=int, default=8)
    arguments = parser.parse_args()
    scenes = {"Cornell box": psdr.load_file(SCENES / "cornell_box.xml"), "sunlit": psdr.load_dict(sunlit())}
    print("| scene | spp | variance ratio | time ratio | time to equal error, independent / Sobol |")
    print("|---|---|---|---|---|")
    for name, scene in scenes.items():
        for spp in arguments.spp:
            variance, seconds = zip(
                *(measure(scene, kind, spp, arguments.seeds) for kind in ("independent", "sobol")), strict=True
            )
            v, t = variance[0] / variance[1], seconds[1] / seconds[0]
            print(f"| {name} | {spp} | {v:.2f} | {t:.2f} | {v / t:.2f} |")


if __name__ == "__main__":
    main()

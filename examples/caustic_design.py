"""Finds a lens whose caustic draws a heart on a wall.

    python examples/caustic_design.py            # a minute or two
    python examples/caustic_design.py --quick    # a blurred heart

Parallel light falls on a square slab of glass. One of its sides starts flat, and its vertices move until the refracted
light on the wall is the picture: light paths are drawn from the sun through the glass and joined to the camera, and
their vertices ride on what moves. No path from the camera could find that light. The derivative is the interior term
alone, which is the whole here: all that moves falls on one wall.

Leaves in ``out/caustic_design/``: ``result.png`` (the lens, flat, found, wanted), ``lens.png`` (its height),
``loss.png``, ``lens.ply`` and ``report.json``.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import recovery
import trimesh
import warp as wp

import warp_psdr as psdr
from warp_psdr import plots
from warp_psdr.fit.report import psnr

ROOT = Path(__file__).resolve().parents[1]
LENS = "lens.vertex_positions"
INTEGRATOR = psdr.PathIntegrator(max_depth=4, interior=psdr.interior.LightTracing(), boundary=None)
#: Heights of the two sides of the slab over the wall, world units; the slab is 2 wide.
FLAT_SIDE, CURVED_SIDE = 2.2, 2.0
#: Of the wall, whose radiance without the glass is 1.
REFLECTANCE = 0.8
#: Light beside the heart, over that in it.
DIM = 0.15
#: Pixels along a side of the picture of the lens for each of its vertices, and where the lamp of that picture stands.
LENS_PIXELS, LENS_LAMP = 6, (-1.0, 1.0, 2.0)
#: Slope that nineteen of twenty points of the pictured lens stay below: its own is too small to be seen.
LENS_SLOPE = 1.2
#: Pixels along a side, and samples of each, of the pictures of light, for each that the fit compares.
FINER, SHOWN_SPP = 3, 16


def grid(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a square of ``count`` x ``count`` vertices that faces the wall."""
    at = np.linspace(-1.0, 1.0, count)
    x, y = np.meshgrid(at, at)
    vertices = np.stack([x, y, np.full_like(x, CURVED_SIDE)], axis=-1).reshape(-1, 3)
    number = np.arange(count * count).reshape(count, count)
    a, b, c, d = (number[i : count - 1 + i, j : count - 1 + j].ravel() for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    return vertices.astype(np.float32), faces.astype(np.int32)


def load(count: int, width: int) -> psdr.Parameters:
    """Return the parameters of the scene: the sun, the slab, the wall, and a camera between the two."""
    t = psdr.Transform
    vertices, faces = grid(count)
    glass = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    film = {"type": "hdrfilm", "width": width, "height": width, "rfilter": {"type": "gaussian"}, "sample_border": True}
    scene = {
        "type": "scene",
        "sun": {"type": "directional", "direction": [0.0, 0.0, -1.0], "irradiance": np.pi / REFLECTANCE},
        "wall": {
            "type": "rectangle",
            "to_world": t.scale(1.2),
            "bsdf": {"type": "diffuse", "reflectance": REFLECTANCE},
        },
        "back": {"type": "rectangle", "to_world": t.translate([0.0, 0.0, FLAT_SIDE]), "bsdf": glass},
        "lens": {"type": "mesh", "vertices": vertices, "faces": faces, "bsdf": glass},
        "camera": {
            "type": "perspective",
            "fov": float(np.degrees(2.0 * np.arctan(1.0 / 1.5))),
            "to_world": t.look_at([0.0, 0.0, 1.5], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
            "film": film,
        },
    }
    params = psdr.traverse(psdr.load_dict(scene))
    params.requires_grad(LENS)
    return params


def heart(width: int) -> np.ndarray:
    """Return the wanted picture, with soft edges and a mean of one."""
    at = (np.arange(4 * width) + 0.5) / (4 * width) * 2.8 - 1.4
    x, y = np.meshgrid(at, at[::-1] + 0.1)
    inside = (x * x + y * y - 1.0) ** 3 - x * x * y**3 < 0.0
    fine = np.where(inside, 1.0, DIM)
    image = fine.reshape(width, 4, width, 4).mean(axis=(1, 3))
    return np.repeat((image / image.mean())[..., None], 3, axis=2).astype(np.float32)


def relief(height: np.ndarray) -> np.ndarray:
    """Return a picture of the curved side of the lens, lit from the upper left, as a matt surface would show it.

    Args:
        height: (count, count), from the lower left on.
    """
    from scipy.ndimage import zoom

    fine = zoom(height, LENS_PIXELS, order=3)[::-1]
    down, across = np.gradient(fine)
    scale = LENS_SLOPE / max(np.percentile(np.hypot(down, across), 95.0), 1e-9)
    down, across = scale * down, scale * across
    normal = np.stack([-across, down, np.ones_like(fine)], axis=-1)
    lamp = np.array(LENS_LAMP) / np.linalg.norm(LENS_LAMP)
    cosine = (normal @ lamp) / np.linalg.norm(normal, axis=-1)
    return np.repeat(np.maximum(cosine, 0.0)[..., None], 3, axis=2)


def main(
    folder: Path = ROOT / "out" / "caustic_design",
    *,
    steps: int = 150,
    count: int = 49,
    width: int = 64,
    spp: int = 16,
    lr: float = 0.02,
    weight: float = 15.0,
) -> dict:
    """Find the lens, write the pictures and return the report."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    params = load(count, width)
    wanted = heart(width)
    target = wp.array(wanted, dtype=wp.vec3, device="cpu")
    optimiser = psdr.optim.LargeSteps(params, {LENS: lr}, lambda_=weight)
    photo = {"integrator": INTEGRATOR, "spp": 8 * spp, "seed": 2**31}
    flat = psdr.render(params.scene, **photo).numpy()
    losses = []
    for step in range(steps):
        tape = wp.Tape()
        with tape:
            image = psdr.render(params.scene, params, integrator=INTEGRATOR, spp=spp, seed=step, tape=tape)
            loss = psdr.losses.l2(image, target)
        tape.backward(loss)
        losses.append(float(loss.numpy()[0]))
        optimiser.step(scale=0.1 ** (step / steps))
    found = psdr.render(params.scene, **photo).numpy()
    vertices, faces = params[LENS].numpy().reshape(-1, 3), grid(count)[1]
    height = (vertices[:, 2] - CURVED_SIDE).reshape(count, count)
    titles = [f"the lens: its relief, {np.ptp(height):.2f} deep, 2 wide", "light behind a flat slab"]
    titles += ["light behind the lens", "wanted"]
    fine = load(count, FINER * width)
    shown = []
    for lens in (grid(count)[0], vertices):
        fine[LENS] = lens
        fine.update()
        options = {"integrator": INTEGRATOR, "spp": SHOWN_SPP * spp, "seed": 2**31}
        shown.append(psdr.render(fine.scene, **options).numpy())
    images = [1.3 * relief(height), *shown, heart(FINER * width)]  # 1.3: a plain is as bright as light behind the slab
    plots.side_by_side(folder / "result.png", images, titles, exposure=-1.0, columns=4)
    tones = (height - height.min()) / max(np.ptp(height), 1e-9)
    psdr.write_image(folder / "lens.png", np.kron(np.repeat(tones[::-1, :, None], 3, axis=2), np.ones((6, 6, 1))))
    plots.loss_curve(folder / "loss.png", losses)
    trimesh.Trimesh(vertices, faces, process=False).export(folder / "lens.ply")
    report = {
        "psnr of the flat slab, dB": round(psnr(flat, wanted), 2),
        "psnr of the lens, dB": round(psnr(found, wanted), 2),
        "depth of the lens": round(float(np.ptp(height)), 4),
        "seconds": round(time.perf_counter() - began, 1),
    }
    (folder / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    return report


if __name__ == "__main__":
    recovery.run(main, __doc__, {"steps": 60, "count": 25, "width": 32})

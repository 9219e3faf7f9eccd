"""Recovers what a ball is made of, and the sky around it, from eight photographs.

    python examples/recover_material.py            # some minutes on two cores
    python examples/recover_material.py --quick    # smaller and rougher

The ball is a ``principled`` material with textures of its base colour, its roughness and its metalness. Where it is
metal it mirrors the sky, where it is paint it scatters it, and behind it the cameras see the sky itself: so all four
images are sought together, one photograph a step. What photographs cannot tell apart (dark metal from dark paint that
shines) need not come out as it was; photographs that were kept from the fit do.

Leaves in ``out/material/``: ``result.png`` (photographs, start, recovered; the last two were not given),
``textures.png`` (truth and recovered), ``loss.png`` and ``report.json``.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import recovery
import warp as wp

import warp_psdr as psdr
from warp_psdr import plots

ROOT = Path(__file__).resolve().parents[1]
INTEGRATOR = psdr.PathIntegrator(max_depth=2)
BASE, ROUGHNESS, METALLIC, SKY = (
    "ball.bsdf.base_color.data",
    "ball.bsdf.roughness.data",
    "ball.bsdf.metallic.data",
    "sky.data",
)
#: Learning rates, in the units of the values, at the start; they fall to this share of it along a half cosine.
RATES, FALL = {BASE: 0.03, ROUGHNESS: 0.02, METALLIC: 0.03, SKY: 0.06}, 0.01
#: Values that the fit starts from.
START = {BASE: 0.5, ROUGHNESS: 0.4, METALLIC: 0.5, SKY: 0.6}
#: Of all cameras, degrees.
FIELD_OF_VIEW = 60.0
#: Texels of the textures (rows, columns) and of the sky.
TEXELS, SKY_TEXELS = (12, 24), (8, 16)
#: Photographs that are given, and that judge; samples of each, and their seed, which no step uses.
GIVEN, KEPT, PHOTO_SPP, PHOTO_SEED = 8, 2, 512, 2**32 - 1000
#: Pixels along a side in ``result.png`` for each that the fit compares, and samples of these.
FINER, SHOWN_SPP = 4, 128


def waves(shape: tuple[int, int], *numbers: tuple[float, float, float]) -> np.ndarray:
    """Return smooth patterns (H, W, C) from 0 to 1; a channel has waves around, a whole number, down, and a phase."""
    v, u = np.meshgrid((np.arange(shape[0]) + 0.5) / shape[0], (np.arange(shape[1]) + 0.5) / shape[1], indexing="ij")
    return np.stack([0.5 + 0.5 * np.sin(2 * np.pi * (a * u + b * v + c)) for a, b, c in numbers], axis=-1)


def truth() -> dict[str, np.ndarray]:
    """Return the values that are sought."""
    metal = 1.0 / (1.0 + np.exp(-12.0 * (waves(TEXELS, (2, 1, 0.1)) - 0.5)))
    bright = (
        waves(SKY_TEXELS, (1, 0, 0.15)) ** 6
        * np.sin(np.pi * (np.arange(SKY_TEXELS[0]) + 0.5) / SKY_TEXELS[0])[:, None, None] ** 4
    )
    values = {
        BASE: 0.15 + 0.7 * waves(TEXELS, (1, 0.5, 0.0), (3, 0.0, 0.3), (2, -1, 0.6)),
        ROUGHNESS: 0.25 + 0.45 * waves(TEXELS, (3, 1, 0.7)),
        METALLIC: metal,
        SKY: 0.2 + 0.5 * waves(SKY_TEXELS, (2, 0.5, 0.0), (1, 0.6, 0.2), (2, 0.4, 0.5)) + 2.5 * bright,
    }
    return {name: value.astype(np.float32) for name, value in values.items()}


def build(resolution: int) -> psdr.Scene:
    """Return the scene with the values of the start: a ball in a sky, and ten cameras around it."""
    grey = {
        name: np.full((*TEXELS, 3 if name == BASE else 1), START[name], np.float32)
        for name in (BASE, ROUGHNESS, METALLIC)
    }
    names = {BASE: "base_color", ROUGHNESS: "roughness", METALLIC: "metallic"}
    bitmaps = {names[name]: {"type": "bitmap", "bitmap": value, "raw": True} for name, value in grey.items()}
    scene: dict = {
        "type": "scene",
        # Upright: the poles, where texels meet, are above and below.
        "ball": {
            "type": "sphere",
            "to_world": psdr.Transform.rotate([1, 0, 0], -90),
            "bsdf": {"type": "principled", "specular": 0.5, **bitmaps},
        },
        "sky": {"type": "envmap", "bitmap": np.full((*SKY_TEXELS, 3), START[SKY], np.float32)},
    }
    origins = []
    for i in range(GIVEN + KEPT):
        angle = 2.0 * np.pi * (i / GIVEN if i < GIVEN else (i - GIVEN) * 0.5 + 0.0625)
        height = (1.1 if i % 2 else -1.1) if i < GIVEN else 0.2
        origins.append([2.6 * np.sin(angle), height, 2.6 * np.cos(angle)])
    scene |= recovery.cameras(origins, FIELD_OF_VIEW, resolution)
    return psdr.load_dict(scene)


def set_values(params: psdr.Parameters, values: dict[str, np.ndarray]) -> None:
    for name, value in values.items():
        params[name] = value
    params.update()


def main(folder: Path = ROOT / "out" / "material", *, resolution: int = 40, steps: int = 480, spp: int = 8) -> dict:
    """Recover the textures and the sky, write the pictures and return the report."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    scene = build(resolution)
    params = psdr.traverse(scene)
    start, sought = {name: params[name].numpy().copy() for name in RATES}, truth()

    fine = psdr.traverse(build(FINER * resolution))

    def pictures(values: dict[str, np.ndarray], seed: int) -> list[np.ndarray]:
        set_values(fine, values)
        return recovery.photographs(fine.scene, GIVEN + KEPT, INTEGRATOR, SHOWN_SPP, seed)

    set_values(params, sought)
    photos = recovery.photographs(scene, GIVEN + KEPT, INTEGRATOR, PHOTO_SPP, PHOTO_SEED)
    set_values(params, start)
    params.requires_grad(*RATES)
    optimizer, losses = psdr.optim.Adam(params, RATES, betas=(0.9, 0.99), mask_updates=True), []
    order = np.random.default_rng(0)
    for step in range(steps):
        if step % GIVEN == 0:
            turns = order.permutation(GIVEN)
        view = int(turns[step % GIVEN])
        tape = wp.Tape()
        with tape:
            image = psdr.render(scene, params, sensor=view, integrator=INTEGRATOR, spp=spp, seed=step, tape=tape)
            loss = psdr.losses.huber(image, photos[view], delta=0.1)
        tape.backward(loss)
        optimizer.step(scale=FALL + (1.0 - FALL) * 0.5 * (1.0 + np.cos(np.pi * step / steps)))
        losses.append(float(loss.numpy()[0]))
        if (step + 1) % 40 == 0:
            print(f"step {step + 1}: loss {np.mean(losses[-40:]):.5f}", flush=True)
    recovered = {name: params[name].numpy().copy() for name in RATES}
    views = [pictures(values, PHOTO_SEED + 100 * i) for i, values in enumerate((sought, start, recovered), 1)]
    draw(folder, sought, recovered)
    smooth = np.convolve(losses, np.ones(GIVEN) / GIVEN, mode="valid")
    plots.loss_curve(folder / "loss.png", {"mean over eight photographs": smooth}, title="loss", ylabel="Huber loss")
    report = {
        **recovery.view_report(folder, *views, GIVEN),
        "mean absolute errors": {n: round(float(np.abs(recovered[n] - sought[n]).mean()), 3) for n in RATES},
        "steps": steps,
        "seconds": round(time.perf_counter() - began),
    }
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    return report


def draw(folder: Path, sought, recovered) -> None:
    """Write the picture of the textures and the sky."""
    names = {BASE: "base colour", ROUGHNESS: "roughness", METALLIC: "metalness", SKY: "sky"}
    images = [values[name] for values in (sought, recovered) for name in names]
    titles = [f"{what}, {which}" for which in ("truth", "recovered") for what in names.values()]
    quantity = "value, or radiance [W/m²/sr] of the sky"
    plots.side_by_side(folder / "textures.png", images, titles, columns=len(names), quantity=quantity)


if __name__ == "__main__":
    recovery.run(main, __doc__, {"resolution": 24, "steps": 120, "spp": 8})

"""Recovers a cloud of smoke, its density and its colour in every voxel, from eight photographs.

    python examples/recover_smoke.py            # some minutes on two cores
    python examples/recover_smoke.py --quick    # smaller and rougher

The fit starts from nothing: density and albedo are exactly 0. A path tracer that draws collisions by the density has
no derivative there, since nothing collides; ours has (``docs/theory/media.md#derivatives``). The grid is refined twice
on the way, so that its large parts are found first. What eight photographs leave open, the inside above all, need not
come out as it was; two photographs that were kept from the fit judge.

Where Mitsuba 3 is installed its ``prbvolpath`` says beside ours what it takes for the derivative at the start.

Leaves in ``out/smoke/``: ``result.png`` (photographs, start, recovered), ``slices.png`` (density and albedo of truth
and result), ``loss.png`` and ``report.json``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import recovery
import warp as wp

import warp_psdr as psdr
from warp_psdr import plots

ROOT = Path(__file__).resolve().parents[1]
INTEGRATOR = psdr.PathIntegrator(max_depth=6)
DENSITY, ALBEDO = "cube.interior_medium.sigma_t.data", "cube.interior_medium.albedo.data"
#: Photographs that are given, and that judge; samples of each, and their seed, which no step uses.
GIVEN, KEPT, PHOTO_SPP, PHOTO_SEED = 8, 2, 256, 2**32 - 1000
#: Pixels along a side in ``result.png`` for each that the fit compares.
FINER = 2
#: Learning rates at the start, in the units of the values; they fall to this share along a half cosine of each grid.
RATES, FALL = {DENSITY: 0.25, ALBEDO: 0.05}, 0.1
#: Times the number of voxels: derivatives by one below which Adam's steps shrink, so that noise moves little.
EPSILON = 0.05
BOX = psdr.Transform.translate([-1.0, -1.0, -1.0]) @ psdr.Transform.scale(2.0)
#: What Mitsuba takes for the derivative at the start; prints the largest of all voxels.
MITSUBA = """
import json, sys
import numpy as np
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import drjit as dr
n, size, origin, photo = int(sys.argv[1]), int(sys.argv[2]), json.loads(sys.argv[3]), np.load(sys.argv[4])
box = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
grid = lambda c: {"type": "gridvolume", "grid": mi.VolumeGrid(np.zeros((n, n, n, c), np.float32)), "to_world": box}
scene = mi.load_dict({
    "type": "scene", "integrator": {"type": "prbvolpath", "max_depth": 6},
    "cube": {"type": "cube", "bsdf": {"type": "null"}, "interior": {
        "type": "heterogeneous", "sigma_t": grid(1), "albedo": grid(3)}},
    "sky": {"type": "constant", "radiance": 0.8},
    "sensor": {"type": "perspective", "fov": 40.0,
        "to_world": mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}}})
params = mi.traverse(scene)
name = "cube.interior_medium.sigma_t.data"
dr.enable_grad(params[name])
image = mi.render(scene, params, spp=64)
dr.backward(dr.mean(dr.square(image - mi.TensorXf(photo))))
print(float(np.abs(np.array(dr.grad(params[name]))).max()))
"""


def truth(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the density (n, n, n, 1) and the albedo (n, n, n, 3) that are sought; rows Z, Y, X."""
    at = (np.arange(n) + 0.5) / n * 2.0 - 1.0
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    density, tint = np.zeros((n, n, n)), np.zeros((n, n, n, 3))
    puffs = (
        (-0.3, -0.35, -0.1, 0.45, (0.9, 0.5, 0.15)),
        (0.35, -0.1, 0.2, 0.4, (0.2, 0.55, 0.85)),
        (0.0, 0.4, 0.0, 0.35, (0.8, 0.2, 0.4)),
    )
    for cx, cy, cz, r, color in puffs:
        part = np.exp(-((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2) / (0.5 * r * r))
        density += part
        tint += part[..., None] * np.array(color)
    curls = 1.0 + 0.5 * np.sin(9.0 * x + 5.0 * y) * np.cos(8.0 * z - 3.0 * y)
    albedo = tint / np.maximum(density, 1e-6)[..., None]
    return (np.clip(density * curls - 0.12, 0.0, None)[..., None] * 5.0).astype(np.float32), albedo.astype(np.float32)


def origin_of(view: int) -> list[float]:
    """Return where a camera stands."""
    angle = 2.0 * np.pi * (view / GIVEN if view < GIVEN else (view - GIVEN) * 0.5 + 0.0625)
    height = (1.2 if view % 2 else -1.0) if view < GIVEN else 0.2
    return [3.4 * np.sin(angle), height, 3.4 * np.cos(angle)]


def build(density: np.ndarray, albedo: np.ndarray, resolution: int) -> psdr.Scene:
    """Return the smoke in a box that is not there, below a lamp and a sky, and ten cameras around it."""

    def grid(data: np.ndarray) -> dict:
        return {"type": "gridvolume", "data": data, "to_world": BOX}

    smoke = {"type": "heterogeneous", "sigma_t": grid(density), "albedo": grid(albedo)}
    scene: dict = {
        "type": "scene",
        "cube": {"type": "cube", "bsdf": {"type": "null"}, "interior": smoke},
        "sky": {"type": "constant", "radiance": 0.8},
        "sun": {"type": "directional", "direction": [0.3, -1.0, -0.2], "irradiance": 2.0},
    }
    scene |= recovery.cameras([origin_of(i) for i in range(GIVEN + KEPT)], 40.0, resolution)
    return psdr.load_dict(scene)


def photographs(scene: psdr.Scene, seed: int) -> list[np.ndarray]:
    return recovery.photographs(scene, GIVEN + KEPT, INTEGRATOR, PHOTO_SPP, seed)


def drawn(scene: psdr.Scene, seed: int) -> dict[int, np.ndarray]:
    return recovery.draw_views(scene, GIVEN, INTEGRATOR, PHOTO_SPP, seed)


def finer(values: np.ndarray, n: int) -> np.ndarray:
    """Return a grid with n voxels an axis, a multiple of what it has."""
    factor = n // values.shape[0]
    for axis in range(3):
        values = np.repeat(values, factor, axis=axis)
    return values


def derivative_at_zero(scene: psdr.Scene, photo: np.ndarray) -> float:
    """Return the largest derivative of the mean squared error of a photograph by a voxel's density."""
    params = psdr.traverse(scene)
    params.requires_grad_only(DENSITY)
    tape = wp.Tape()
    with tape:
        image = psdr.render(scene, params, integrator=INTEGRATOR, spp=64, tape=tape)
        loss = psdr.losses.l2(image, photo)
    tape.backward(loss)
    return float(np.abs(params[DENSITY].grad.numpy()).max())


def mitsubas_derivative_at_zero(folder: Path, n: int, resolution: int, photo: np.ndarray) -> float | str:
    """Return the same from Mitsuba's ``prbvolpath``, or why it says nothing."""
    np.save(folder / "photo.npy", photo)
    command = [
        sys.executable,
        "-c",
        MITSUBA,
        str(n),
        str(resolution),
        json.dumps(origin_of(0)),
        str(folder / "photo.npy"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    (folder / "photo.npy").unlink()
    return float(done.stdout) if done.returncode == 0 else f"does not run: {done.stderr.strip().splitlines()[-1]}"


def main(
    folder: Path = ROOT / "out" / "smoke",
    *,
    voxels: int = 64,
    resolution: int = 64,
    steps: tuple[int, ...] = (120, 120, 120),
    spp: int = 8,
) -> dict:
    """Recover the smoke, write the pictures and return the report; ``steps`` are those of each grid."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    sought = truth(voxels)
    photos = photographs(build(*sought, resolution), PHOTO_SEED)
    sizes = [voxels >> (len(steps) - 1 - i) for i in range(len(steps))]
    density = np.zeros((sizes[0],) * 3 + (1,), np.float32)
    albedo = np.zeros((sizes[0],) * 3 + (3,), np.float32)
    scene = build(density, albedo, resolution)
    before = photographs(scene, PHOTO_SEED + 100)
    at_zero = derivative_at_zero(scene, photos[0])
    theirs = mitsubas_derivative_at_zero(folder, sizes[0], resolution, photos[0])
    losses: list[float] = []
    order = np.random.default_rng(0)
    for size, count in zip(sizes, steps, strict=True):
        scene = build(finer(density, size), finer(albedo, size), resolution)
        params = psdr.traverse(scene)
        params.requires_grad(*RATES)
        optimizer = psdr.optim.Adam(params, RATES, betas=(0.9, 0.99), epsilon=EPSILON / size**3)
        for step in range(count):
            if step % GIVEN == 0:
                turns = order.permutation(GIVEN)
            view = int(turns[step % GIVEN])
            tape = wp.Tape()
            with tape:
                options = {"sensor": view, "integrator": INTEGRATOR, "spp": spp, "seed": len(losses)}
                image = psdr.render(scene, params, tape=tape, **options)
                loss = psdr.losses.l2(image, photos[view])
            tape.backward(loss)
            optimizer.step(scale=FALL + (1.0 - FALL) * 0.5 * (1.0 + np.cos(np.pi * step / count)))
            losses.append(float(loss.numpy()[0]))
        density, albedo = params[DENSITY].numpy().copy(), params[ALBEDO].numpy().copy()
        print(f"{size} voxels an axis: loss {np.mean(losses[-4 * GIVEN :]):.5f}", flush=True)
    found = photographs(scene, PHOTO_SEED + 200)
    states = (sought, (0.0 * density, 0.0 * albedo), (density, albedo))
    fine = FINER * resolution
    shown = tuple(drawn(build(*state, fine), PHOTO_SEED + 300 + 100 * i) for i, state in enumerate(states))
    draw(folder, sought, (density, albedo))
    smooth = np.convolve(losses, np.ones(GIVEN) / GIVEN, mode="valid")
    curves = {"mean over eight photographs": smooth}
    plots.loss_curve(folder / "loss.png", curves, title="loss", ylabel="mean squared error")
    report = {
        **recovery.view_report(folder, photos, before, found, GIVEN, shown),
        "largest derivative by a voxel at density 0": at_zero,
        "the same by Mitsuba's prbvolpath": theirs,
        "voxels": voxels,
        "steps": sum(steps),
        "seconds": round(time.perf_counter() - began),
    }
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    return report


def draw(folder: Path, sought, recovered) -> None:
    """Write the picture of slices; the albedo where nothing is does not matter, and is shown black."""
    images, titles = [], []
    for name, (density, albedo) in (("truth", sought), ("recovered", recovered)):
        for cut in (3, 5):
            k = density.shape[0] * cut // 8
            images += [density[:, :, k, 0] / 5.0, albedo[:, :, k] * (density[:, :, k] > 0.25)]
            titles += [f"{name}: density / 5", f"{name}: albedo"]
    plots.side_by_side(folder / "slices.png", images, titles, columns=4, quantity="value")


if __name__ == "__main__":
    recovery.run(main, __doc__, {"voxels": 32, "resolution": 32, "steps": (60, 60)})

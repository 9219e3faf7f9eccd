"""Recovers a chain link and its colours from twelve photographs, starting from 27 small grey balls that merge.

    python examples/recover_genus.py            # some minutes on two cores
    python examples/recover_genus.py --quick    # smaller and rougher

The surface is the zero set of a grid of signed distances (``sdfgrid``, cubic), so its topology is free to change; a
mesh's is not. Its colours are voxels of a ``volume``, found together with it. What the photographs say reaches the
grid by shading (interior term) and by silhouettes and shadows (boundary term of smooth silhouettes,
``docs/theory/implicit.md``). Steps are smoothed (``psdr.optim.LargeSteps``), a Laplacian regulariser keeps the
surface from wrinkling, and values are made distances again from time to time (``psdr.sdf.redistance``), which does
not move the surface. The grid is refined once on the way. A single ball would dent and not open: nothing is seen of a
hole before there is one. Smaller balls, or fewer steps, may end at an open C.

Leaves in ``out/genus/``: ``result.png`` (photographs, start, recovered), ``steps.png`` (the surface on its way),
``loss.png``, ``link.ply`` (the recovered mesh) and ``report.json``, in which the Euler characteristic of the extracted
mesh falls from 48 (27 balls, some of which touch) to 0 (a ring).
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import recovery
import trimesh
import warp as wp
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

import warp_psdr as psdr
from warp_psdr import plots

ROOT = Path(__file__).resolve().parents[1]
GRID, COLORS = "link.grid", "link.bsdf.reflectance.volume.data"
INTEGRATOR = psdr.PathIntegrator(max_depth=2)
#: Photographs that are given, and that judge; samples of each, and their seed, which no step uses.
GIVEN, KEPT, PHOTO_SPP, PHOTO_SEED = 12, 2, 256, 2**32 - 1000
#: Pixels along a side in ``result.png`` for each that the fit compares.
FINER = 2
#: Where the grid is; its values are distances in the unit of the world.
BOX, LENGTHS = psdr.Transform.translate([-1.0, -1.0, -1.0]) @ psdr.Transform.scale(2.0), (2.0, 2.0, 2.0)
#: Learning rate at the start of a grid, in voxels; the share to which it falls along a half cosine; weight of the
#: Laplacian in its steps.
RATE, FALL, SMOOTHING = 2.0, 0.1, 1.0
#: Area of a part, over that of the largest one, up to which it is a speck that hardly a pixel shows.
SPECK = 0.01
#: Voxels of the colours along an axis; learning rate, of values between 0 and 1; share of the steps before which they
#: stay grey: what is left of the balls would else take the colour of the sky behind it.
VOXELS, COLOR_RATE, PAINTED = 9, 0.03, 0.4
#: Steps after which the first camera shows the surface.
SHOWN = (12, 24, 36, 48, 72, 336)
#: Weight of the regulariser; steps between two calls that restore distances.
BENDING, RESTORED = 1e-7, 5


def nodes(n: int) -> np.ndarray:
    """Return where the nodes of a grid are, (n, n, n, 3), x y z; axes Z, Y, X."""
    at = np.linspace(-1.0, 1.0, n)
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    return np.stack([x, y, z], axis=-1)


def balls(n: int) -> np.ndarray:
    """Return the start, (n, n, n, 1): distances from 27 small balls."""
    centre = np.clip(np.round(nodes(n) / 0.45), -1.0, 1.0) * 0.45
    return (np.linalg.norm(nodes(n) - centre, axis=-1) - 0.2)[..., None].astype(np.float32)


def link(n: int) -> np.ndarray:
    """Return what is sought, (n, n, n, 1): distances from a chain link that is turned."""
    turn = np.array(psdr.Transform.rotate([1.0, 1.0, 0.0], 40.0).matrix)[:3, :3]
    x, y, z = np.moveaxis(nodes(n) @ turn, -1, 0)
    along = np.maximum(np.abs(x) - 0.12, 0.0)
    return (np.hypot(np.hypot(along, y) - 0.48, z) - 0.16)[..., None].astype(np.float32)


def colors() -> np.ndarray:
    """Return the colours that are sought, (n, n, n, 3): three waves across the box."""
    waves = np.sin(nodes(VOXELS) @ np.array([[2.1, 0.4, -1.2], [0.7, 2.3, 0.5], [-0.9, 1.1, 1.9]]))
    return (0.5 + 0.3 * waves).astype(np.float32)


def grey() -> np.ndarray:
    """Return the colours at the start."""
    return np.full((VOXELS, VOXELS, VOXELS, 3), 0.5, np.float32)


def color_error(found: np.ndarray, mesh: trimesh.Trimesh) -> float:
    """Return the mean difference of colours from those that are sought, at points of a surface."""
    at = (mesh.sample(20000, seed=2) + 1.0) / 2.0 * VOXELS - 0.5  # the middle of a voxel has its value
    at = at[:, ::-1].T  # axes Z, Y, X
    read = (map_coordinates(a[..., k], at, order=1, mode="nearest") for a in (found, colors()) for k in range(3))
    values = np.array(list(read)).reshape(2, 3, -1)
    return float(np.abs(values[0] - values[1]).mean())


def origin_of(view: int) -> list[float]:
    """Return where a camera stands."""
    angle = 2.0 * np.pi * (view / GIVEN if view < GIVEN else (view - GIVEN) * 0.5 + 0.04)
    height = (-1.6, 0.4, 2.0)[view % 3] if view < GIVEN else 1.1
    return [3.4 * np.sin(angle), height, 3.4 * np.cos(angle)]


def build(grid: np.ndarray, voxels: np.ndarray, resolution: int) -> psdr.Scene:
    """Return the shape below a sky and an area light, and fourteen cameras around it."""
    lamp = psdr.Transform.look_at([1.5, 3.5, 1.0], [0, 0, 0], [0, 0, 1])
    scene: dict = {
        "type": "scene",
        "link": {
            "type": "sdfgrid",
            "grid": grid,
            "interpolation": "cubic",
            "to_world": BOX,
            "bsdf": {
                "type": "diffuse",
                "reflectance": {"type": "volume", "volume": {"type": "gridvolume", "data": voxels, "to_world": BOX}},
            },
        },
        "lamp": {
            "type": "rectangle",
            "to_world": lamp,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [12.0, 12.0, 12.0]}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.45, 0.65]}},
    }
    scene |= recovery.cameras([origin_of(i) for i in range(GIVEN + KEPT)], 27.0, resolution)
    return psdr.load_dict(scene)


def photographs(scene: psdr.Scene, seed: int) -> list[np.ndarray]:
    return recovery.photographs(scene, GIVEN + KEPT, INTEGRATOR, PHOTO_SPP, seed)


def drawn(scene: psdr.Scene, seed: int) -> dict[int, np.ndarray]:
    return recovery.draw_views(scene, GIVEN, INTEGRATOR, PHOTO_SPP, seed)


def finer(values: np.ndarray, n: int) -> np.ndarray:
    """Return a grid with n nodes an axis, between whose old nodes values are interpolated."""
    at = np.linspace(0.0, values.shape[0] - 1.0, n)
    low = np.minimum(at.astype(int), values.shape[0] - 2)
    for axis in range(3):
        share = (at - low).reshape([-1 if k == axis else 1 for k in range(4)])
        values = (1.0 - share) * np.take(values, low, axis=axis) + share * np.take(values, low + 1, axis=axis)
    return values.astype(np.float32)


def surface(values: np.ndarray) -> trimesh.Trimesh:
    """Return the mesh of the surface in the world, without triangles like roundings and without specks."""
    mesh = trimesh.Trimesh(*psdr.sdf.to_mesh(values, BOX, cubic=True))
    mesh.merge_vertices(digits_vertex=5)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    parts = mesh.split(only_watertight=False)
    largest = max(part.area for part in parts)
    return trimesh.util.concatenate([part for part in parts if part.area > SPECK * largest])


def distance(a: trimesh.Trimesh, b: trimesh.Trimesh) -> float:
    """Return the mean distance between two surfaces, of points of either from the nearest one of the other."""
    points = [mesh.sample(20000, seed=1) for mesh in (a, b)]
    return float(np.mean([cKDTree(points[i]).query(points[1 - i])[0].mean() for i in (0, 1)]))


def main(
    folder: Path = ROOT / "out" / "genus",
    *,
    sizes: tuple[int, ...] = (25, 49),
    resolution: int = 64,
    steps: tuple[int, ...] = (240, 96),
    spp: int = 8,
) -> dict:
    """Recover the link, write the pictures and return the report; ``steps`` are those of each grid."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    sought = psdr.sdf.coefficients(link(sizes[-1]))
    photos = photographs(build(sought, colors(), resolution), PHOTO_SEED)
    voxels = grey()
    grid = psdr.sdf.coefficients(balls(sizes[0]))
    first = surface(grid)
    before = photographs(build(grid, voxels, resolution), PHOTO_SEED + 100)
    losses: list[float] = []
    shown: dict[int, np.ndarray] = {0: before[0]}
    order = np.random.default_rng(0)
    for size, count in zip(sizes, steps, strict=True):
        if size != grid.shape[0]:
            grid = psdr.sdf.redistance(finer(grid, size), LENGTHS, cubic=True)
        scene = build(grid, voxels, resolution)
        params = psdr.traverse(scene)
        voxel = LENGTHS[0] / (size - 1)
        rates: dict[str, float] = {}
        for step in range(count):
            if step % GIVEN == 0:
                turns = order.permutation(GIVEN)
            view = int(turns[step % GIVEN])
            paints = len(losses) >= PAINTED * sum(steps)
            if not rates or paints != (COLORS in rates):
                rates = {GRID: RATE * voxel} | ({COLORS: COLOR_RATE} if paints else {})
                params.requires_grad_only(*rates)
                optimizer = psdr.optim.LargeSteps(params, rates, lambda_=SMOOTHING, betas=(0.8, 0.95))
            tape = wp.Tape()
            with tape:
                options = {"sensor": view, "integrator": INTEGRATOR, "spp": spp, "seed": len(losses)}
                image = psdr.render(scene, params, tape=tape, **options)
                loss = psdr.losses.l2(image, photos[view])
                bent = psdr.losses.laplacian(params[GRID], LENGTHS)
                total = psdr.losses.total(loss, (BENDING, bent))
            tape.backward(total)
            optimizer.step(scale=FALL + (1.0 - FALL) * 0.5 * (1.0 + np.cos(np.pi * step / count)))
            losses.append(float(loss.numpy()[0]))
            if step % RESTORED == RESTORED - 1:
                params[GRID] = psdr.sdf.redistance(params[GRID].numpy(), LENGTHS, cubic=True)
                params.update(GRID)
            if len(losses) in SHOWN:
                shown[len(losses)] = psdr.render(scene, integrator=INTEGRATOR, spp=64, seed=1).numpy()
        grid, voxels = params[GRID].numpy().copy(), params[COLORS].numpy().reshape(grey().shape).copy()
        number = surface(grid).euler_number
        print(f"{size} nodes an axis: loss {np.mean(losses[-2 * GIVEN :]):.5f}, Euler number {number}", flush=True)
    found = photographs(scene, PHOTO_SEED + 200)
    states = ((sought, colors()), (psdr.sdf.coefficients(balls(sizes[0])), grey()), (grid, voxels))
    views = tuple(drawn(build(*s, FINER * resolution), PHOTO_SEED + 300 + 100 * i) for i, s in enumerate(states))
    mesh = surface(grid)
    mesh.export(folder / "link.ply")
    titles = [f"step {step}" for step in shown] + ["photograph"]
    plots.side_by_side(folder / "steps.png", [*shown.values(), photos[0]], titles, columns=len(titles))
    curves = {"mean over the photographs": np.convolve(losses, np.ones(GIVEN) / GIVEN, mode="valid")}
    plots.loss_curve(folder / "loss.png", curves, title="loss", ylabel="mean squared error")
    wanted = surface(sought)
    report = {
        **recovery.view_report(folder, photos, before, found, GIVEN, views),
        "Euler number: start, recovered, sought": [m.euler_number for m in (first, mesh, wanted)],
        "mean distance of the surfaces in voxels": round(distance(mesh, wanted) / voxel, 3),
        "mean difference of colours at the surface: start, recovered": [
            round(color_error(found_colors, wanted), 3) for found_colors in (grey(), voxels)
        ],
        "nodes an axis": sizes[-1],
        "steps": sum(steps),
        "seconds": round(time.perf_counter() - began),
    }
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    return report


if __name__ == "__main__":
    recovery.run(main, __doc__, {"resolution": 48, "spp": 4})

"""Recovers the shape of the bunny from eight photographs, starting from a sphere.

    python examples/recover_shape.py            # some minutes on two cores
    python examples/recover_shape.py --quick    # a rough shape, in less than one

Silhouettes, the shadow on the floor and shading say where the surface is. Nothing is differentiated but the positions
of the vertices; ``psdr.optim.LargeSteps`` keeps them in order, and ``remesh.py`` gives the mesh more and even triangles
between the stages. What the colours and lights are is known; the photographs are rendered with seeds of their own.

Leaves in ``out/shape/``: ``result.png`` (photographs, start, recovered), ``loss.png``, ``distance.png`` (to the true
surface), ``gradient.png`` (the first gradient of the loss on the sphere), ``samples.png`` (boundary samples on the
edges of the true shape, coloured by how hard they pull), ``density.png`` (how densely edges are sampled),
``animation.gif``, ``recovered.ply`` and ``report.json``.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path

import bunny_data
import numpy as np
import recovery
import remesh
import shape_pictures
import trimesh
import warp as wp

import warp_psdr as psdr

ROOT = Path(__file__).resolve().parents[1]
POSITIONS = "bunny.vertex_positions"
#: Direct light: what the camera sees, and its shadows.
INTEGRATOR = psdr.PathIntegrator(max_depth=2)
#: Where all cameras look, how far away they are, and how high, each at its angle around.
TARGET, DISTANCE, HEIGHTS = np.array([-0.1, 0.75, 0.05]), 3.5, (-0.6, 1.5, 0.1, 2.3, -0.6, 1.5, 0.1, 2.3)
#: The sphere: middle and radius.
MIDDLE, RADIUS = np.array([-0.1, 0.7, 0.0]), 0.55
#: Samples a pixel of the photographs, and the first of their seeds; no step uses these seeds.
PHOTO_SPP, PHOTO_SEED = 256, 2**32 - 1000
#: AdamUniform divides by the largest gradient of about the last 20 steps; it shrinks as the shape is found.
BETAS = (0.9, 0.95)
#: A stage's learning rate is constant for this share of its steps and then falls by this factor.
CONSTANT, FALL = 0.4, 0.1
#: Steps between two frames of the animation, and between two measurements of the distance.
FRAME_EVERY, MEASURE_EVERY = 5, 10


@dataclass(frozen=True)
class Stage:
    """Steps with one mesh: learning rate (world units), weight of the Laplacian, length of an edge (world units)."""

    steps: int
    lr: float
    weight: float
    spacing: float


STAGES = (Stage(100, 0.03, 2.0, 0.11), Stage(90, 0.022, 4.0, 0.055), Stage(110, 0.012, 7.0, 0.036))
QUICK = (Stage(30, 0.04, 1.0, 0.2), Stage(20, 0.02, 2.0, 0.12))


def load(vertices: np.ndarray, faces: np.ndarray, width: int) -> psdr.Parameters:
    """Return the parameters of the scene: a mesh above a floor, a lamp and a sky, seen by eight cameras."""
    t = psdr.Transform

    def paint(*albedo: float) -> dict:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(albedo)}}

    lamp = {"type": "area", "radiance": {"type": "rgb", "value": [18.0, 17.0, 15.0]}}
    scene = {
        "type": "scene",
        "floor": {
            "type": "rectangle",
            "to_world": t.translate([0, -0.5, 0]) @ t.rotate([1, 0, 0], -90) @ t.scale(4),
            "bsdf": paint(0.6, 0.6, 0.6),
        },
        "bunny": {
            "type": "mesh",
            "vertices": np.asarray(vertices, np.float32),
            "faces": np.asarray(faces, np.int32),
            "face_normals": True,
            "bsdf": paint(0.8, 0.4, 0.15),
        },
        "lamp": {
            "type": "rectangle",
            "to_world": t.translate([0.8, 4.0, 0.6]) @ t.rotate([1, 0, 0], 90) @ t.scale(0.5),
            "emitter": lamp,
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.35, 0.45, 0.65]}},
    }
    film = {"type": "hdrfilm", "width": width, "height": width, "rfilter": {"type": "box"}}
    for i, height in enumerate(HEIGHTS):
        angle = 2.0 * np.pi * (i + 0.5) / len(HEIGHTS)
        away = np.array([3.4 * np.sin(angle), height, 3.4 * np.cos(angle)])
        origin = TARGET + DISTANCE * away / np.linalg.norm(away)
        look = t.look_at(origin.tolist(), TARGET.tolist(), [0, 1, 0])
        scene[f"view_{i}"] = {"type": "perspective", "fov": 38.0, "to_world": look, "film": film}
    params = psdr.traverse(psdr.load_dict(scene))
    params.requires_grad(POSITIONS)
    return params


def photographs(vertices: np.ndarray, faces: np.ndarray, width: int, views, spp: int, seed: int) -> list[np.ndarray]:
    scene = load(vertices, faces, width).scene
    return [psdr.render(scene, sensor=i, integrator=INTEGRATOR, spp=spp, seed=seed + i).numpy() for i in views]


def backward(params: psdr.Parameters, targets: list[wp.array], spp: int, seed: int) -> float:
    """Add the gradient of the mean loss over all views, and return the loss."""
    total = 0.0
    for view, target in enumerate(targets):
        tape = wp.Tape()
        with tape:
            image = psdr.render(
                params.scene, params, sensor=view, integrator=INTEGRATOR, spp=spp, seed=seed + view, tape=tape
            )
            loss = psdr.losses.l2(image, target)
        tape.backward(grads={loss: wp.full(1, 1.0 / len(targets), dtype=wp.float32, device=loss.device)})
        total += float(loss.numpy()[0]) / len(targets)
    return total


def main(
    folder: Path = ROOT / "out" / "shape", *, stages: tuple[Stage, ...] = STAGES, width: int = 64, spp: int = 4
) -> dict:
    """Recover the shape, write the pictures and return the report."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    truth = bunny_data.read_bunny()
    views = range(len(HEIGHTS))
    photos = photographs(*truth, width, views, PHOTO_SPP, PHOTO_SEED)
    targets = [wp.array(photo, dtype=wp.vec3, device="cpu") for photo in photos]
    sphere = trimesh.creation.icosphere(subdivisions=3 if stages is STAGES else 2, radius=RADIUS)
    mesh = start = (sphere.vertices + MIDDLE, np.asarray(sphere.faces))
    losses, distances, frames = [], {0: remesh.surface_distance(start, truth)}, [start]
    for number, stage in enumerate(stages):
        if number:
            mesh = remesh.remesh(*mesh, stage.spacing)
        params = load(*mesh, width)
        optimiser = psdr.optim.LargeSteps(params, {POSITIONS: stage.lr}, lambda_=stage.weight, betas=BETAS)
        for i in range(stage.steps):
            step = len(losses)
            if step == 0:
                shape_pictures.draw_boundary(folder, params, photos, load(*truth, width), INTEGRATOR, POSITIONS)
            loss = backward(params, targets, spp, step * len(targets))
            falling = max(i / stage.steps - CONSTANT, 0.0) / (1.0 - CONSTANT)
            optimiser.step(scale=FALL**falling)
            losses.append(loss)
            mesh = (params[POSITIONS].numpy().astype(np.float64), mesh[1])
            if len(losses) % FRAME_EVERY == 0:
                frames.append(mesh)
            if len(losses) % MEASURE_EVERY == 0:
                distances[len(losses)] = remesh.surface_distance(mesh, truth)
                seconds = time.perf_counter() - began
                print(
                    f"step {len(losses)}: loss {loss:.5f}, distance {distances[len(losses)]:.4f}, "
                    f"{len(mesh[0])} vertices, {seconds:.0f} s",
                    flush=True,
                )
    distances[len(losses)] = remesh.surface_distance(mesh, truth)
    shape_pictures.draw_result(folder, truth, start, mesh, lambda m, v, w: photographs(*m, w, v, 64, 1))
    shape_pictures.draw_curves(folder, losses, distances)
    shape_pictures.animate(folder / "animation.gif", truth, frames, lambda m, v, w: photographs(*m, w, v, 16, 1))
    trimesh.Trimesh(*mesh, process=False).export(folder / "recovered.ply")
    first, last = distances[0], distances[len(losses)]
    report = {
        "mean distance to the true surface: start, recovered": [round(first, 4), round(last, 4)],
        "ratio": round(first / last, 2),
        "vertices": len(mesh[0]),
        "steps": len(losses),
        "seconds": round(time.perf_counter() - began),
    }
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    return report


if __name__ == "__main__":
    recovery.run(main, __doc__, {"stages": QUICK, "width": 32}, "a rough shape, in less time")

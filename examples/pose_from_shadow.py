"""Finds where a bunny hangs, and how it is turned, from a photograph of its shadows alone.

    python examples/pose_from_shadow.py            # minutes on two cores
    python examples/pose_from_shadow.py --quick    # smaller and rougher

The camera sees a floor and the soft shadows of two lamps on it, not the bunny. All that the image says about the pose
lies in the boundaries of these shadows. The pose is a rotation vector and a translation; the kernel ``recovery.place``
turns it into vertex positions, on the same tape as the rendering, so that the gradient reaches the six numbers.

Leaves in ``out/shadow/``: ``result.png`` (what the camera sees, and the scene from further back: photograph, start,
found), ``error.png`` (the pose's error over the steps) and ``report.json``.
"""

from __future__ import annotations

import time
from pathlib import Path

import bunny_data
import numpy as np
import recovery
import warp as wp
from warp.optim import Adam

import warp_psdr as psdr
from warp_psdr import plots

ROOT = Path(__file__).resolve().parents[1]
POSITIONS = "bunny.vertex_positions"
#: Rotation vector (radians) and translation (world units) of the bunny's middle: sought, and to start from.
TRUTH = np.float32([0.4, -0.6, 0.3]), np.float32([0.1, 1.9, 0.0])
START = np.float32([0.1, -0.1, 0.0]), np.float32([-0.1, 2.1, 0.15])
#: Scale of the bunny, which is 1.6 units long in its file.
SIZE = 0.5
#: First seed of the photograph, which no step uses, and steps between two lines of the report.
PHOTO_SEED, REPORT_EVERY = 2**32 - 1000, 10
#: Learning rates are constant for this share of the steps, then fall by this factor.
CONSTANT, FALL = 0.5, 0.02
GIVEN, OVERVIEW = 0, 1


def load(vertices: np.ndarray, faces: np.ndarray, width: int) -> psdr.Parameters:
    """Return the parameters of a scene with a floor, two lamps, and a mesh that hangs above the camera's view."""
    t = psdr.Transform

    def camera(origin, target, fov: float, width: int) -> dict:
        film = {"type": "hdrfilm", "width": width, "height": 2 * width // 3, "rfilter": {"type": "box"}}
        return {"type": "perspective", "fov": fov, "to_world": t.look_at(origin, target, [0, 1, 0]), "film": film}

    def lamp(x: float, color: list[float]) -> dict:
        to_world = t.translate([x, 4.4, 0.3]) @ t.rotate([1, 0, 0], 90) @ t.scale(0.15)
        emitter = {"type": "area", "radiance": {"type": "rgb", "value": color}}
        return {"type": "rectangle", "to_world": to_world, "emitter": emitter}

    def paint(*albedo: float) -> dict:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(albedo) * (3 // len(albedo))}}

    scene = {
        "type": "scene",
        "given": camera([0, 2.2, 2.4], [0, 0, 0.1], 66.0, width),
        "overview": camera([0, 2.4, 5.6], [0, 1.15, 0], 36.0, 3 * width),
        "floor": {"type": "rectangle", "to_world": t.rotate([1, 0, 0], -90) @ t.scale(12), "bsdf": paint(0.7)},
        "warm": lamp(1.1, [180.0, 110.0, 55.0]),
        "cool": lamp(-1.1, [55.0, 100.0, 180.0]),
        "bunny": {
            "type": "mesh", "vertices": vertices, "faces": faces, "face_normals": True, "bsdf": paint(0.6, 0.5, 0.4),
        },
    }  # fmt: skip
    params = psdr.traverse(psdr.load_dict(scene))
    params.requires_grad(POSITIONS)
    return params


def main(folder: Path = ROOT / "out" / "shadow", *, width: int = 96, steps: int = 200, spp: int = 16) -> dict:
    """Recover the pose, write the pictures and return the report."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    vertices, faces = bunny_data.read_bunny()
    local_values = SIZE * (vertices - 0.5 * (vertices.min(axis=0) + vertices.max(axis=0)))
    params = load(local_values, faces, width)
    scene, integrator = params.scene, psdr.PathIntegrator(max_depth=2)
    local = wp.array(local_values, dtype=wp.vec3, device="cpu")
    rotation, translation = (wp.zeros(1, dtype=wp.vec3, device="cpu", requires_grad=True) for _ in range(2))

    def move() -> None:
        wp.launch(recovery.place, len(local), [local, rotation, translation], [params[POSITIONS]], device="cpu")
        params.update(POSITIONS)

    def pose(values) -> None:
        rotation.assign(values[0][None])
        translation.assign(values[1][None])
        move()

    def pictures(seed: int) -> list[np.ndarray]:
        counts = {GIVEN: 16 * spp, OVERVIEW: 4 * spp}
        return [psdr.render(scene, sensor=i, integrator=integrator, spp=counts[i], seed=seed).numpy() for i in counts]

    pose(TRUTH)
    photograph, overview = pictures(PHOTO_SEED)
    target = wp.array(photograph, dtype=wp.vec3, device="cpu")
    pose(START)
    images = [photograph, *pictures(PHOTO_SEED + 1)]
    images.insert(2, overview)
    optimisers = Adam([rotation], lr=0.04, betas=(0.9, 0.95)), Adam([translation], lr=0.015, betas=(0.9, 0.95))
    rates = [o.lr for o in optimisers]
    history = [recovery.pose_errors(START, TRUTH)]
    for step in range(steps):
        tape = wp.Tape()
        with tape:
            move()
            image = psdr.render(scene, params, integrator=integrator, spp=spp, seed=step, tape=tape)
            loss = psdr.losses.l2(image, target)
        tape.backward(loss)
        for optimiser, rate, array in zip(optimisers, rates, (rotation, translation), strict=True):
            optimiser.lr = rate * FALL ** (max(step / steps - CONSTANT, 0.0) / (1.0 - CONSTANT))
            optimiser.step([array.grad])
        tape.zero()
        history.append(recovery.pose_errors((rotation.numpy()[0], translation.numpy()[0]), TRUTH))
        if (step + 1) % REPORT_EVERY == 0:
            degrees, units = history[-1]
            print(f"step {step + 1}: loss {loss.numpy()[0]:.2e}, {degrees:.2f} degrees, {units:.4f} units", flush=True)
    move()
    found = pictures(PHOTO_SEED + 2)
    images = [images[0], images[1], found[0], images[2], images[3], found[1]]
    captions = ("photograph", "start", "found")
    titles = [*captions, *(f"{caption}, from further back (not given)" for caption in captions)]
    plots.side_by_side(folder / "result.png", images, titles, columns=3)
    return recovery.pose_report(folder, history, began)


if __name__ == "__main__":
    recovery.run(main, __doc__, {"width": 48, "steps": 100, "spp": 8}, "fewer pixels, samples and steps")

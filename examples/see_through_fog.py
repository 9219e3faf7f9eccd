"""Finds where a plate hangs in fog, how it is turned, and how dense the fog is, from the shadow that it casts.

    python examples/see_through_fog.py            # some minutes on two cores
    python examples/see_through_fog.py --quick    # smaller and rougher

One lamp lights a box of fog from above. Two cameras see the lower part of the box: not the plate, but the dark shaft
below it and its shadow on the floor. How the images change with the plate's pose is the boundary term of paths with
vertices in the fog (``docs/methods/path_space_media.md``); the density has a derivative of its own. All seven numbers
are sought at once: kernels turn a rotation vector and a translation into vertex positions, and a logarithm into the
density, on the same tape as the renderings.

Leaves in ``out/fog/``: ``result.png`` (what the cameras see, and the scene from further back: photograph, start,
found), ``derivatives.png`` (how the image changes as the plate moves, and with the density), ``error.png`` and
``report.json``.
"""

from __future__ import annotations

import json
import time
import warnings
from pathlib import Path

import numpy as np
import recovery
import warp as wp
from warp.optim import Adam

import warp_psdr as psdr
from warp_psdr import plots

ROOT = Path(__file__).resolve().parents[1]
POSITIONS, DENSITY = "plate.vertex_positions", "box.interior_medium.sigma_t.value.value"
#: Rotation vector (radians) and translation (world units) of the plate: sought, and to start from.
TRUTH = np.float32([0.2, 0.5, -0.3]), np.float32([0.1, 1.9, 0.0])
START = np.float32([0.05, 0.1, -0.1]), np.float32([-0.1, 2.1, 0.15])
#: Extinction coefficient of the fog, per world unit: sought, and to start from.
THICK, THIN = 0.3, 0.12
#: First seed of the photographs, which no step uses, and steps between two lines of the report.
PHOTO_SEED, REPORT_EVERY = 2**32 - 1000, 20
#: Learning rates of rotation, translation and the density's logarithm; constant for a share of the steps, then falling
#: to this factor.
RATES, CONSTANT, FALL = (0.04, 0.02, 0.03), 0.5, 0.02
#: Cameras whose pixels the fit compares, and those of the pictures: the same two with more pixels along a side, and one
#: from further back.
GIVEN, SHOWN, FINER = (0, 1), (2, 3, 4), 3
#: Light is scattered once: by the fog, or by the floor.
INTEGRATOR = psdr.PathIntegrator(max_depth=2)


@wp.kernel
def exponential(
    # In:
    logarithm: wp.array(dtype=wp.float32),
    # Out:
    value_out: wp.array(dtype=wp.float32),
):
    value_out[0] = wp.exp(logarithm[0])


def plate() -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (12, 3) and faces (20, 3) of a thin L, about its middle."""
    corners = np.array([(0, 0), (2, 0), (2, 0.6), (0.6, 0.6), (0.6, 1.6), (0, 1.6)]) - (0.8, 0.6)
    vertices = np.concatenate([np.insert(0.55 * corners, 1, y, axis=1) for y in (0.04, -0.04)])
    top = [(0, 2, 1), (0, 3, 2), (0, 4, 3), (0, 5, 4)]
    bottom = [(a + 6, c + 6, b + 6) for a, b, c in top]
    sides = [f for i in range(6) for j in [(i + 1) % 6] for f in ((i, j, j + 6), (i, j + 6, i + 6))]
    return vertices.astype(np.float32), np.int32(top + bottom + sides)


def load(vertices: np.ndarray, faces: np.ndarray, width: int) -> psdr.Parameters:
    """Return the parameters of a scene with a floor, a box of fog above it, a lamp, and a plate in the fog."""
    t = psdr.Transform

    def camera(origin, target, fov: float, width: int) -> dict:
        film = {"type": "hdrfilm", "width": width, "height": 2 * width // 3, "rfilter": {"type": "box"}}
        return {"type": "perspective", "fov": fov, "to_world": t.look_at(origin, target, [0, 1, 0]), "film": film}

    front, side = ([0, 1.6, 6], [0, 0.3, 0], 32.0), ([6, 1.6, 0], [0, 0.3, 0], 32.0)
    fog = {"type": "homogeneous", "sigma_t": THIN, "albedo": 0.9, "phase": {"type": "hg", "g": 0.3}}
    lamp = t.translate([0.2, 3.6, 0.15]) @ t.rotate([1, 0, 0], 90) @ t.scale(0.2)
    radiance = {"type": "rgb", "value": [270.0, 240.0, 180.0]}
    scene = {
        "type": "scene",
        "front": camera(*front, width),
        "side": camera(*side, width),
        "front_shown": camera(*front, FINER * width),
        "side_shown": camera(*side, FINER * width),
        "overview": camera([2.5, 2.6, 7], [0, 1.35, 0], 38.0, FINER * width),
        "floor": {
            "type": "rectangle",
            "to_world": t.rotate([1, 0, 0], -90) @ t.scale(8),
            "bsdf": {"type": "diffuse", "reflectance": 0.5},
        },
        "box": {
            "type": "cube",
            "to_world": t.translate([0, 1.31, 0]) @ t.scale([1.5, 1.3, 1.5]),
            "bsdf": {"type": "null"},
            "interior": fog,
        },
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": radiance}},
        "plate": {
            "type": "mesh", "vertices": vertices, "faces": faces, "face_normals": True,
            "bsdf": {"type": "diffuse", "reflectance": 0.3},
        },
    }  # fmt: skip
    params = psdr.traverse(psdr.load_dict(scene))
    params.requires_grad(POSITIONS, DENSITY)
    return params


def main(folder: Path = ROOT / "out" / "fog", *, width: int = 48, steps: int = 240, spp: int = 16) -> dict:
    """Recover the pose and the density, write the pictures and return the report."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    # One sample in a million meets an edge of the box, and is neither inside nor outside.
    warnings.filterwarnings("ignore", "samples that were not finite were dropped", RuntimeWarning)
    local_values, faces = plate()
    params = load(local_values, faces, width)
    scene = params.scene
    local = wp.array(local_values, dtype=wp.vec3, device="cpu")
    rotation, translation = (wp.zeros(1, dtype=wp.vec3, device="cpu", requires_grad=True) for _ in range(2))
    logarithm = wp.zeros(1, dtype=wp.float32, device="cpu", requires_grad=True)
    unknown = (rotation, translation, logarithm)

    def move() -> None:
        wp.launch(recovery.place, len(local), [local, rotation, translation], [params[POSITIONS]], device="cpu")
        wp.launch(exponential, 1, [logarithm], [params[DENSITY]], device="cpu")
        params.update(POSITIONS, DENSITY)

    def state(pose, density: float) -> None:
        rotation.assign(pose[0][None])
        translation.assign(pose[1][None])
        logarithm.assign(np.log([density]).astype(np.float32))
        move()

    def pictures(seed: int, cameras: tuple[int, ...] = SHOWN) -> list[np.ndarray]:
        options = {"integrator": INTEGRATOR, "spp": 32 * spp}
        return [psdr.render(scene, sensor=i, seed=seed + i, **options).numpy() for i in cameras]

    state(TRUTH, THICK)
    photographs = pictures(PHOTO_SEED)
    derivatives(folder, params, 32 * spp)
    targets = [wp.array(target, dtype=wp.vec3, device="cpu") for target in pictures(PHOTO_SEED, GIVEN)]
    state(START, THIN)
    before = pictures(PHOTO_SEED + 100)
    optimisers = [Adam([array], lr=rate, betas=(0.9, 0.95)) for array, rate in zip(unknown, RATES, strict=True)]
    history, densities = [recovery.pose_errors(START, TRUTH)], [THIN]
    one = wp.ones(1, dtype=wp.float32, device="cpu")
    for step in range(steps):
        tape = wp.Tape()
        with tape:
            move()
            options = {"integrator": INTEGRATOR, "spp": spp, "tape": tape}
            images = [psdr.render(scene, params, sensor=i, seed=len(GIVEN) * step + i, **options) for i in GIVEN]
            losses = [psdr.losses.l2(image, target) for image, target in zip(images, targets, strict=True)]
        tape.backward(grads=dict.fromkeys(losses, one))
        scale = FALL ** (max(step / steps - CONSTANT, 0.0) / (1.0 - CONSTANT))
        for optimiser, rate, array in zip(optimisers, RATES, unknown, strict=True):
            optimiser.lr = rate * scale
            optimiser.step([array.grad])
        tape.zero()
        history.append(recovery.pose_errors((rotation.numpy()[0], translation.numpy()[0]), TRUTH))
        densities.append(float(np.exp(logarithm.numpy()[0])))
        if (step + 1) % REPORT_EVERY == 0:
            degrees, units = history[-1]
            numbers = f"{degrees:.2f} degrees, {units:.4f} units, density {densities[-1]:.4f}"
            print(f"step {step + 1}: loss {sum(loss.numpy()[0] for loss in losses):.2e}, {numbers}", flush=True)
    move()
    found = pictures(PHOTO_SEED + 200)
    views = ("from the front", "from the side", "from further back, not given")
    titles = [f"{what}, {view}" for what in ("photograph", "start", "found") for view in views]
    plots.side_by_side(folder / "result.png", photographs + before + found, titles, columns=3)
    report = recovery.pose_report(folder, history, began)
    numbers = (rotation.numpy()[0], translation.numpy()[0])
    report["rotation vector, radians: sought, found"] = [
        v.astype(float).round(3).tolist() for v in (TRUTH[0], numbers[0])
    ]
    report["translation, units: sought, found"] = [v.astype(float).round(4).tolist() for v in (TRUTH[1], numbers[1])]
    report["density: sought, start, found"] = [THICK, THIN, round(densities[-1], 4)]
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    return report


def derivatives(folder: Path, params: psdr.Parameters, spp: int) -> None:
    """Draw how the first view changes as the plate moves to the right and up, and with the density."""
    ones = np.ones(params[POSITIONS].shape[0])[:, None]
    tangents = {
        "plate to the right, by a unit": {POSITIONS: (ones * [1, 0, 0]).astype(np.float32)},
        "plate upwards, by a unit": {POSITIONS: (ones * [0, 1, 0]).astype(np.float32)},
        "density, by a unit": {DENSITY: np.ones(params[DENSITY].shape, np.float32)},
    }
    drawn = {}
    for title, tangent in tangents.items():
        params.requires_grad_only(*tangent)
        image = psdr.render_forward(params.scene, params, tangent, sensor=SHOWN[0], integrator=INTEGRATOR, spp=spp)
        drawn[title] = image.numpy()
    params.requires_grad_only(POSITIONS, DENSITY)
    image = psdr.render(params.scene, sensor=SHOWN[0], integrator=INTEGRATOR, spp=spp).numpy()
    plots.side_by_side(folder / "derivatives.png", [image], ["image"], columns=4, differences=drawn,
                       difference_quantity=plots.RADIANCE_DERIVATIVE)  # fmt: skip


if __name__ == "__main__":
    recovery.run(main, __doc__, {"width": 24, "steps": 220}, "fewer pixels, and somewhat fewer steps")

"""Finds where a camera stood, and where it looked, from one photograph of the Cornell box.

    python examples/camera_pose.py            # a minute or two on two cores
    python examples/camera_pose.py --quick    # smaller and rougher

Derivatives of the image by the camera's matrix (``sensor.to_world``) hold both terms: how shading slides through the
pixels, and how edges do. A step is a small turn of the camera about the middle of what it sees and a small shift, so
that the matrix stays a rigid pose. (A turn about the camera itself looks much like a shift; Adam, which treats every
number by itself, would be slow to tell them apart.)

Leaves in ``out/camera/``: ``result.png`` (photograph, start, found, and their differences), ``error.png`` (the pose's
error over the steps) and ``report.json``.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import recovery
import warp as wp

import warp_psdr as psdr
from warp_psdr import plots

ROOT = Path(__file__).resolve().parents[1]
POSE = "sensor.to_world"
INTEGRATOR = psdr.PathIntegrator(max_depth=2)
#: What takes the sought camera to the start: degrees about the point that it sees, and a shift (world units).
TURN, SHIFT = (-4.0, -5.0, 5.0), (0.1, -0.1, 0.2)
#: Learning rates: radians, world units. They are constant for this share of the steps, then fall by this factor.
RATES, CONSTANT, FALL = np.repeat([0.006, 0.012], 3), 0.5, 0.01
#: Distance from the camera to the point that it turns about (world units).
AHEAD = 3.9
BETAS = 0.9, 0.95
#: Difference (radiance) from which the loss grows linearly: without it the lamp, fifty times as bright as the walls,
#: would count more than all else, and where its images do not overlap nothing says in which direction to go.
DELTA = 0.05
#: Seed of the photograph, which no step uses, and steps between two lines of the report.
PHOTO_SEED, REPORT_EVERY = 2**32 - 1000, 10


def rigid(motion: np.ndarray) -> np.ndarray:
    """Return the matrix (4, 4) of a rotation vector (radians) about the point ahead, and a translation, (6,)."""
    from scipy.spatial.transform import Rotation

    matrix, middle = np.eye(4), np.array([0.0, 0.0, AHEAD])
    matrix[:3, :3] = Rotation.from_rotvec(motion[:3]).as_matrix()
    matrix[:3, 3] = motion[3:] + middle - matrix[:3, :3] @ middle
    return matrix


def generators() -> np.ndarray:
    """Return the derivatives (6, 4, 4) of ``rigid`` at zero."""
    result = np.zeros((6, 4, 4))
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        result[axis, c, b], result[axis, b, c] = 1.0, -1.0
        result[axis, :3, 3] = -AHEAD * result[axis, :3, 2]
        result[3 + axis, axis, 3] = 1.0
    return result


def errors(pose: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return the angle (degrees) and the distance (world units) between two poses."""
    turn = truth[:3, :3].T @ pose[:3, :3]
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    angle = np.arctan2(0.5 * np.linalg.norm(axis), 0.5 * (np.trace(turn) - 1.0))
    return float(np.degrees(angle)), float(np.linalg.norm(pose[:3, 3] - truth[:3, 3]))


def main(folder: Path = ROOT / "out" / "camera", *, resolution: int = 64, steps: int = 120, spp: int = 8) -> dict:
    """Recover the pose, write the pictures and return the report."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    scene = psdr.load_file(ROOT / "scenes" / "cornell_box.xml", resolution=resolution)
    params = psdr.traverse(scene)
    truth = params[POSE].numpy().astype(np.float64)

    def picture(seed: int) -> np.ndarray:
        return psdr.render(scene, integrator=INTEGRATOR, spp=32 * spp, seed=seed).numpy()

    def move(matrix: np.ndarray) -> None:
        params[POSE] = matrix
        params.update()

    photograph = picture(PHOTO_SEED)
    target = wp.array(photograph, dtype=wp.vec3, device="cpu")
    pose = truth @ rigid(np.concatenate([np.radians(TURN), SHIFT]))
    move(pose)
    start = picture(PHOTO_SEED + 1)
    params.requires_grad(POSE)
    tangents, m, v = generators(), np.zeros(6), np.zeros(6)
    history = [errors(pose, truth)]
    for step in range(1, steps + 1):
        tape = wp.Tape()
        with tape:
            image = psdr.render(scene, params, integrator=INTEGRATOR, spp=spp, seed=step, tape=tape)
            loss = psdr.losses.huber(image, target, delta=DELTA)
        tape.backward(loss)
        # d loss / d motion: the pose is pose @ rigid(motion), and motion is zero.
        gradient = np.einsum("ij,kij->k", params[POSE].grad.numpy(), pose @ tangents)
        params.zero_grad()
        m = BETAS[0] * m + (1.0 - BETAS[0]) * gradient
        v = BETAS[1] * v + (1.0 - BETAS[1]) * gradient**2
        descent = (m / (1.0 - BETAS[0] ** step)) / np.sqrt(v / (1.0 - BETAS[1] ** step) + 1e-30)
        falling = max(step / steps - CONSTANT, 0.0) / (1.0 - CONSTANT)
        pose = pose @ rigid(-RATES * FALL**falling * descent)
        move(pose)
        history.append(errors(pose, truth))
        if step % REPORT_EVERY == 0:
            degrees, units = history[-1]
            print(f"step {step}: loss {loss.numpy()[0]:.5f}, {degrees:.3f} degrees, {units:.4f} units", flush=True)
    found = picture(PHOTO_SEED + 2)
    differences = {"start − photograph": start - photograph, "found − photograph": found - photograph}
    titles = ["photograph", "start", "found"]
    plots.side_by_side(
        folder / "result.png", [photograph, start, found], titles, columns=5, differences=differences, percentile=98.0
    )
    return recovery.pose_report(folder, history, began)


if __name__ == "__main__":
    recovery.run(main, __doc__, {"resolution": 32, "steps": 80}, "fewer pixels and steps")

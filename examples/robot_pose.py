"""Finds how a robot's arm is bent, and where the camera stands, from one picture.

    python examples/robot_pose.py            # a minute on two cores; needs the extra "newton"
    python examples/robot_pose.py --quick    # fewer pixels and steps, rougher

Newton's forward kinematics takes four joint angles to poses of the arm's links, and stands on the tape of the
rendering; so does a kernel that takes six numbers, a turn about the point that the camera sees and a shift, to the
camera's pose. The arm's shadow on the floor is a second view of it.

Leaves in ``out/robot/``: ``result.png`` (picture, start, found, and their differences) and ``report.json``.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import newton
import numpy as np
import recovery
import warp as wp
from warp.optim import Adam

import warp_psdr as psdr
from warp_psdr import plots

ROOT = Path(__file__).resolve().parents[1]
INTEGRATOR = psdr.PathIntegrator(max_depth=2)
#: Joint angles, degrees: sought, and how far off the start is.
TRUTH, OFF = np.array([25.0, 35.0, 70.0, 45.0]), np.array([15.0, -15.0, 15.0, -15.0])
#: How far off the camera is at the start: turned about what it sees, degrees, and shifted, m.
TURN, SHIFT = np.array([4.0, -5.0, 3.0]), np.array([0.1, -0.08, 0.15])
#: Length and radius of each link, m; axis of the joint that it hangs on; colour.
LINKS = (
    (0.5, 0.13, wp.vec3(0.0, 0.0, 1.0), (0.75, 0.75, 0.75)),
    (0.7, 0.09, wp.vec3(0.0, 1.0, 0.0), (0.9, 0.35, 0.1)),
    (0.6, 0.08, wp.vec3(0.0, 1.0, 0.0), (0.15, 0.4, 0.8)),
    (0.3, 0.06, wp.vec3(0.0, 1.0, 0.0), (0.85, 0.75, 0.15)),
)
#: Distance from the camera to the point that it turns about, m; difference from which the loss grows linearly.
AHEAD, DELTA = wp.constant(3.6), 0.05
#: Learning rates: joints, radians, and the camera, radians and m. First seed of pictures that no step uses.
RATES, PHOTO_SEED = (0.03, 0.012), 2**32 - 1000


@wp.kernel
def aim(start: wp.transform, motion: wp.array(dtype=wp.vec3), pose_out: wp.array(dtype=wp.transform)):
    """Turn the camera about the point ahead, by a rotation vector, and shift it."""
    w = motion[0]
    angle = wp.sqrt(wp.dot(w, w) + 1.0e-12)
    turned = wp.quat_from_axis_angle(w / angle, angle)
    middle = wp.vec3(0.0, 0.0, AHEAD)
    moved = wp.transform(middle - wp.quat_rotate(turned, middle) + motion[1], turned)
    pose_out[0] = wp.transform_multiply(start, moved)


def arm() -> newton.Model:
    """Return the model of an arm of four links that stands on the ground, and of a box beside it."""
    builder, joints, parent, below, still = newton.ModelBuilder(), [], -1, 0.0, wp.quat_identity()
    for i, (length, radius, axis, color) in enumerate(LINKS):
        link = builder.add_link(label=f"link{i}")
        middle = wp.transform(wp.vec3(0.0, 0.0, 0.5 * length), still)
        size = {"radius": radius, "half_height": 0.5 * length}
        builder.add_shape_capsule(link, xform=middle, **size, color=color, label=f"link{i}")
        at = wp.transform(wp.vec3(0.0, 0.0, below), still)
        joints.append(builder.add_joint_revolute(parent, link, parent_xform=at, axis=axis))
        parent, below = link, length
    for side in (-1.0, 1.0):
        finger = wp.transform(wp.vec3(0.0, side * 0.08, LINKS[-1][0] + 0.1), still)
        builder.add_shape_box(parent, xform=finger, hx=0.05, hy=0.02, hz=0.12, color=(0.3, 0.3, 0.3), label="finger")
    builder.add_articulation(joints)
    crate = {"xform": wp.transform(wp.vec3(0.4, -0.7, 0.15), still), "hx": 0.2, "hy": 0.15, "hz": 0.15}
    builder.add_shape_box(-1, **crate, color=(0.2, 0.6, 0.3), label="crate")
    builder.add_ground_plane()
    return builder.finalize(requires_grad=True, device="cpu")


class Robot:
    """An arm before a camera: joint angles, and how the camera moves from where it is believed to be."""

    def __init__(self, width: int):
        self.model, place = arm(), psdr.Transform.look_at([2.2, -2.0, 2.7], [0.2, 0.0, 0.5], [0, 0, 1])
        self.place = wp.transform(*wp.transform_decompose(wp.mat44(place.matrix))[:2])
        self.joints = wp.array(np.radians(TRUTH), dtype=float, device="cpu", requires_grad=True)
        self.motion = wp.zeros(2, dtype=wp.vec3, device="cpu", requires_grad=True)
        self.sought = [self.joints, self.motion]
        pixels = {"type": "hdrfilm", "width": width, "height": width, "rfilter": {"type": "box"}}
        lamp = psdr.Transform.look_at([1.0, 2.5, 4.0], [0, 0, 0.5], [0, 0, 1]) @ psdr.Transform.scale(0.4)
        self.scene = psdr.from_newton(
            self.model,
            sensor={"type": "perspective", "fov": 40.0, "to_world": place, "film": pixels},
            emitters=[{"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": 250.0}}],
            sky={"type": "constant", "radiance": 0.2},
        )
        self.params = psdr.traverse(self.scene)

    def errors(self) -> dict[str, float]:
        """Return how far off the arm and the camera are."""
        turn, shift = np.linalg.norm(self.motion.numpy(), axis=1)
        worst = np.abs(np.degrees(self.joints.numpy()) - TRUTH).max()
        errors = [round(float(error), 4) for error in (worst, np.degrees(turn), 100.0 * shift)]
        return dict(zip(("worst joint, degrees", "camera's turn, degrees", "its shift, cm"), errors, strict=True))

    def picture(self, seed: int, spp: int) -> wp.array:
        """Return an image of the arm as it is bent now, seen from where the camera is now."""
        state, pose = self.model.state(), wp.zeros(1, dtype=wp.transform, device="cpu", requires_grad=True)
        newton.eval_fk(self.model, self.joints, self.model.joint_qd, state)
        wp.launch(aim, 1, [self.place, self.motion], [pose], device="cpu")
        psdr.bind(self.params, state)
        psdr.bind(self.params, {"sensor.to_world": pose})
        return psdr.render(self.scene, self.params, integrator=INTEGRATOR, spp=spp, seed=seed)


def main(folder: Path = ROOT / "out" / "robot", *, width: int = 64, steps: int = 150, spp: int = 16) -> dict:
    """Recover angles and camera, write the pictures and return the report."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    robot = Robot(width)
    given = robot.picture(PHOTO_SEED, 16 * spp).numpy()
    robot.joints.assign(np.radians(TRUTH + OFF).astype(np.float32))
    robot.motion.assign(np.float32([np.radians(TURN), SHIFT]))
    first, before = robot.picture(PHOTO_SEED + 1, 16 * spp).numpy(), robot.errors()
    optimisers = [Adam([array], betas=(0.9, 0.95)) for array in robot.sought]
    for step in range(1, steps + 1):
        tape = wp.Tape()
        with tape:
            loss = psdr.losses.huber(robot.picture(step, spp), given, delta=DELTA)
        tape.backward(loss)
        for optimiser, array, rate in zip(optimisers, robot.sought, RATES, strict=True):
            optimiser.lr = rate * 0.02 ** max(2.0 * step / steps - 1.0, 0.0)
            optimiser.step([array.grad])
        tape.zero()
        if step % 10 == 0:
            print(f"step {step}: loss {loss.numpy()[0]:.5f}, {robot.errors()}", flush=True)
    found = robot.picture(PHOTO_SEED + 2, 16 * spp).numpy()
    differences = {"start − picture": first - given, "found − picture": found - given}
    options = {"columns": 5, "differences": differences, "percentile": 98.0}
    plots.side_by_side(folder / "result.png", [given, first, found], ["picture", "start", "found"], **options)
    report = {f"{name}: start, found": [before[name], error] for name, error in robot.errors().items()}
    report |= {"steps": steps, "seconds": round(time.perf_counter() - began, 1)}
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    return report


if __name__ == "__main__":
    recovery.run(main, __doc__, {"width": 48, "steps": 90}, "fewer pixels and steps")

"""Finds how a ball was thrown from a film of its shadow; the ball itself is never seen.

    python examples/throw_from_shadow.py            # a minute on two cores
    python examples/throw_from_shadow.py --quick    # fewer frames and pixels, rougher

The camera sees a floor, on which a lamp casts the shadow of a ball that flies by above the camera. The simulation, a
ball in air that drags, is three lines of a Warp kernel; frames of it are rendered on the same tape. The gradient
reaches the velocity at the start through all steps of the flight.

Leaves in ``out/throw/``: ``film.gif`` (the film, and what was found, beside it), ``result.png`` (frames of the film,
of the start and of what was found) and ``report.json``.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import recovery
import warp as wp

import warp_psdr as psdr

ROOT = Path(__file__).resolve().parents[1]
#: Velocity at the start, m/s: sought, and to start from; where the ball is then, m.
TRUTH, START = np.float32([2.2, 2.0, 0.5]), np.float32([1.7, 2.6, 0.2])
FROM = wp.vec3(-0.9, 3.0, -0.3)
#: Steps of the simulation from frame to frame; seconds of the film; drag, 1/m.
SUBSTEPS, SECONDS, DRAG = 4, 0.8, wp.constant(0.08)
#: First seed of the film, which no step uses; share of the frames that a step looks at.
FILM_SEED, LOOKED_AT = 2**32 - 1000, 3


@wp.kernel
def throw(velocity: wp.array(dtype=wp.vec3), ball: wp.array(dtype=wp.transform), flown: wp.array(dtype=wp.vec3)):
    """The ball leaves."""
    ball[0] = wp.transform(FROM, wp.quat_identity())
    flown[0] = velocity[0]


@wp.kernel
def fly(
    # In:
    ball: wp.array(dtype=wp.transform),
    velocity: wp.array(dtype=wp.vec3),
    dt: float,
    # Out:
    ball_out: wp.array(dtype=wp.transform),
    velocity_out: wp.array(dtype=wp.vec3),
):
    """A step of the flight."""
    v = velocity[0]
    after = v + dt * (wp.vec3(0.0, -9.81, 0.0) - DRAG * wp.length(v) * v)
    velocity_out[0] = after
    ball_out[0] = wp.transform(wp.transform_get_translation(ball[0]) + dt * after, wp.quat_identity())


def load(width: int) -> psdr.Parameters:
    """Return the parameters of a scene with a floor, a lamp and a ball."""
    t = psdr.Transform
    film = {"type": "hdrfilm", "width": width, "height": width, "rfilter": {"type": "box"}}
    above = t.look_at([0, 1.4, 0], [0, 0, 0], [0, 0, -1])
    lamp = t.translate([0, 9, 0]) @ t.rotate([1, 0, 0], 90) @ t.scale(0.4)
    scene = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 80.0, "to_world": above, "film": film},
        "floor": {"type": "rectangle", "to_world": t.rotate([1, 0, 0], -90) @ t.scale(8)},
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": 300.0}},
        "ball": {"type": "sphere", "radius": 0.3, "resolution": 16, "to_world": t.translate([0, 20, 0])},
    }
    return psdr.traverse(psdr.load_dict(scene))


class Flight:
    """A throw, and the film of its shadow."""

    def __init__(self, params: psdr.Parameters, frames: int):
        self.params, self.frames, self.dt = params, frames, SECONDS / (frames * SUBSTEPS)
        self.velocity = wp.array(START[None], dtype=wp.vec3, device="cpu", requires_grad=True)

    def film(self, seed: int, spp: int, shown: list[int] | None = None) -> list[wp.array]:
        """Simulate, and return images of the frames that are shown; all of them by default."""
        integrator = psdr.PathIntegrator(max_depth=2)

        def state() -> tuple[wp.array, wp.array]:
            return tuple(wp.zeros(1, dtype=d, device="cpu", requires_grad=True) for d in (wp.transform, wp.vec3))

        now, images = state(), []
        wp.launch(throw, 1, [self.velocity], [*now], device="cpu")
        for frame in range(self.frames):
            if shown is None or frame in shown:
                psdr.bind(self.params, {"ball.to_world": now[0]})
                scene = self.params.scene
                images.append(psdr.render(scene, self.params, integrator=integrator, spp=spp, seed=seed + frame))
            for _ in range(SUBSTEPS):
                after = state()
                wp.launch(fly, 1, [*now, self.dt], [*after], device="cpu")
                now = after
        return images


def main(
    folder: Path = ROOT / "out" / "throw", *, width: int = 64, frames: int = 24, steps: int = 40, spp: int = 8
) -> dict:
    """Recover the velocity, write the pictures and return the report."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    flight = Flight(load(width), frames)
    first = [image.numpy() for image in flight.film(FILM_SEED + frames, 16 * spp)]
    flight.velocity.assign(TRUTH[None])
    given = [image.numpy() for image in flight.film(FILM_SEED, 16 * spp)]
    flight.velocity.assign(START[None])
    errors = []

    def told(step: int) -> None:
        errors.append(float(np.linalg.norm(flight.velocity.numpy()[0] - TRUTH) / np.linalg.norm(TRUTH)))
        if (step + 1) % 5 == 0:
            print(
                f"step {step + 1}: velocity {flight.velocity.numpy()[0].round(3)}, error {errors[-1]:.2%}", flush=True
            )

    recovery.fit_film(flight.film, given, flight.velocity, steps=steps, spp=spp, rate=0.1, share=LOOKED_AT, told=told)
    found = [image.numpy() for image in flight.film(FILM_SEED + 2 * frames, 16 * spp)]
    recovery.draw_films(folder, {"film": given, "start": first, "found": found}, SECONDS)
    report = {
        "velocity": flight.velocity.numpy()[0].tolist(),
        "error": errors[-1],
        "speed_error": float(abs(np.linalg.norm(flight.velocity.numpy()[0]) / np.linalg.norm(TRUTH) - 1.0)),
        "seconds": round(time.perf_counter() - began, 1),
    }
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    return report


if __name__ == "__main__":
    recovery.run(main, __doc__, {"width": 32, "frames": 8, "steps": 20})

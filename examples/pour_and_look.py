"""Finds how a bob on a spring swings from a film of it that was taken through a glass of water.

    python examples/pour_and_look.py            # two minutes on two cores
    python examples/pour_and_look.py --quick    # fewer frames and pixels, rougher

The bob sways behind the glass, which swaps left and right and stretches; no pixel beside the glass shows it. The
simulation is a Warp kernel, and frames of it are rendered on the same tape. The gradient reaches the logarithms of
stiffness, damping, and the angle at the start through outlines that are seen behind four surfaces that refract.

Leaves in ``out/pour/``: ``film.gif`` (the film, and what was found, beside it), ``result.png`` (frames of the film,
of the start and of what was found) and ``report.json``.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import recovery
import trimesh
import warp as wp

import warp_psdr as psdr

ROOT = Path(__file__).resolve().parents[1]
#: One path a pixel looks for outlines behind glass, which takes most of the time; one for other edges.
OUTLINES = psdr.boundary.PathSpace(spp_mirrors=1, spp_primary=1, spp_secondary=1)
INTEGRATOR = psdr.PathIntegrator(max_depth=9, rr_depth=9, boundary=OUTLINES)
#: What is sought: stiffness, 1/s², and damping, 1/s, over the moment of inertia; angle at the start, rad.
NUMBERS = ("stiffness", "damping", "angle")
TRUTH, START = np.float32([400.0, 3.0, 0.5]), np.float32([460.0, 4.0, 0.38])
#: The rod's length, m; gravity, m/s²; where the rod is hinged, m; steps from frame to frame; seconds of the film.
LENGTH, GRAVITY, HINGE, SUBSTEPS, SECONDS = 0.06, 9.81, wp.constant(wp.vec3(0.0, 0.006, -0.2)), 8, 0.8
#: What gravity does against the spring, 1/s².
FALL = wp.constant(GRAVITY / LENGTH)
#: First seed of the film, which no step uses; share of the frames that a step looks at.
FILM_SEED, LOOKED_AT = 2**32 - 1000, 5


@wp.kernel
def let_go(logarithms: wp.array(dtype=float), state_out: wp.array(dtype=wp.vec2)):
    """Angle and velocity at the start: the bob is at rest."""
    state_out[0] = wp.vec2(wp.exp(logarithms[2]), 0.0)


@wp.kernel
def sway(
    logarithms: wp.array(dtype=float), state: wp.array(dtype=wp.vec2), dt: float, state_out: wp.array(dtype=wp.vec2)
):
    """A step of the swing: a spring holds the rod upright, gravity pulls it down."""
    angle, velocity = state[0][0], state[0][1]
    force = FALL * wp.sin(angle) - wp.exp(logarithms[0]) * angle - wp.exp(logarithms[1]) * velocity
    after = velocity + dt * force
    state_out[0] = wp.vec2(angle + dt * after, after)


@wp.kernel
def pose(state: wp.array(dtype=wp.vec2), pose_out: wp.array(dtype=wp.transform)):
    """Where the rod and the bob on it are; upright at the angle zero."""
    pose_out[wp.tid()] = wp.transform(HINGE, wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, -1.0), state[0][0]))


def turned(radius: float, low: float, high: float, inside: float, outside: float) -> dict:
    """Return a closed cylinder with round corners, of one index of refraction, in another; it is a single lens."""
    corner, angle = 0.002, np.linspace(0.0, np.pi / 2, 6)
    across, up = radius - corner * (1.0 - np.sin(angle)), corner * (1.0 - np.cos(angle))
    rings = [(0.0, low), *zip(across, low + up, strict=True), (radius, low + 2.0 * corner)]
    rings += [(radius, high - 2.0 * corner), *zip(across[::-1], high - up[::-1], strict=True), (0.0, high)]
    mesh = trimesh.creation.revolve(rings, sections=64)
    vertices, faces = np.float32(mesh.vertices[:, [1, 2, 0]]), np.int32(mesh.faces)
    glass = {"type": "dielectric", "int_ior": inside, "ext_ior": outside}
    return {"type": "mesh", "vertices": vertices, "faces": faces, "bsdf": glass}


def load(width: int, fov: float = 13.5) -> psdr.Parameters:
    """Return the parameters of a scene with a glass of water on a table, and a bob behind it; degrees."""
    t, bob = psdr.Transform, [0.0, LENGTH, 0.0]
    film = {"type": "hdrfilm", "width": width, "height": width, "rfilter": {"type": "box"}}
    view = t.look_at([0.0, 0.1, 0.53], [0.0, 0.055, 0.0], [0, 1, 0])
    lamp = t.look_at([-0.1, 0.7, 0.2], [0.0, 0.0, -0.15], [0, 1, 0]) @ t.scale(0.16)
    paint = lambda *rgb: {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}  # noqa: E731
    square = lambda at, **more: {"type": "rectangle", "to_world": at, **more}  # noqa: E731
    scene = {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": fov, "to_world": view, "film": film},
        "table": square(t.rotate([1, 0, 0], -90) @ t.scale(2), bsdf=paint(0.55, 0.4, 0.28)),
        "wall": square(t.translate([0, 0, -0.6]) @ t.scale(2), bsdf=paint(0.35, 0.5, 0.6)),
        "lamp": square(lamp, emitter={"type": "area", "radiance": 9.0}),
        "sky": {"type": "constant", "radiance": 0.3},
        "glass": turned(0.04, 0.0005, 0.115, 1.5, 1.0),
        "water": turned(0.037, 0.0025, 0.1, 1.33, 1.5),
        "air": turned(0.037, 0.1002, 0.1148, 1.0, 1.5),
        "bob": {"type": "sphere", "center": bob, "radius": 0.014, "resolution": 16, "bsdf": paint(0.85, 0.15, 0.08)},
        "rod": {"type": "cylinder", "radius": 0.003, "p0": [0, 0, 0], "p1": bob, "bsdf": paint(0.45, 0.42, 0.38)},
    }
    return psdr.traverse(psdr.load_dict(scene))


class Swing:
    """A bob on a spring, and the film of it."""

    def __init__(self, params: psdr.Parameters, frames: int):
        self.params, self.frames, self.dt = params, frames, SECONDS / (frames * SUBSTEPS)
        self.local = {name: params[name].numpy().copy() for name in ("bob.to_world", "rod.to_world")}
        self.logarithms = wp.array(np.log(START), dtype=float, device="cpu", requires_grad=True)

    def film(self, seed: int, spp: int, shown: list[int] | None = None) -> list[wp.array]:
        """Simulate, and return images of the frames that are shown; all of them by default."""

        def new(dtype: type, count: int = 1) -> wp.array:
            return wp.zeros(count, dtype=dtype, device="cpu", requires_grad=True)

        now, images, scene = new(wp.vec2), [], self.params.scene
        wp.launch(let_go, 1, [self.logarithms, now], device="cpu")
        for frame in range(self.frames):
            if shown is None or frame in shown:
                at = new(wp.transform, 2)
                wp.launch(pose, 2, [now, at], device="cpu")
                psdr.bind(self.params, {tuple(self.local): at}, local=self.local)
                samples = {"spp": spp, "spp_grad": max(spp // 16, 1), "seed": seed + frame}
                images.append(psdr.render(scene, self.params, integrator=INTEGRATOR, **samples))
            for _ in range(SUBSTEPS):
                after = new(wp.vec2)
                wp.launch(sway, 1, [self.logarithms, now, self.dt, after], device="cpu")
                now = after
        return images


def main(
    folder: Path = ROOT / "out" / "pour", *, width: int = 48, frames: int = 24, steps: int = 40, spp: int = 64
) -> dict:
    """Recover the numbers, write the pictures and return the report."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    swing = Swing(load(width), frames)
    first = [image.numpy() for image in swing.film(FILM_SEED + frames, 4 * spp)]
    swing.logarithms.assign(np.log(TRUTH))
    given = [image.numpy() for image in swing.film(FILM_SEED, 4 * spp)]
    swing.logarithms.assign(np.log(START))
    told = recovery.tell_ratios(swing.logarithms, TRUTH)
    recovery.fit_film(swing.film, given, swing.logarithms, steps=steps, spp=spp, rate=0.06, share=LOOKED_AT, told=told)
    found = [image.numpy() for image in swing.film(FILM_SEED + 2 * frames, 4 * spp)]
    recovery.draw_films(folder, {"film": given, "start": first, "found": found}, SECONDS)
    return recovery.number_report(folder, NUMBERS, np.exp(swing.logarithms.numpy()), TRUTH, began)


if __name__ == "__main__":
    recovery.run(main, __doc__, {"width": 32, "frames": 12, "steps": 40})

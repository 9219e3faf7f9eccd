"""Finds four numbers of a cloth's material from a film of it: stretching, area, damping and bending.

    python examples/cloth_stiffness.py            # a minute or two on two cores; needs the extra "newton"
    python examples/cloth_stiffness.py --quick    # fewer frames and pixels, rougher

A cloth hangs by two corners before a wall, on which a lamp casts its shadow. It begins flat, is pushed, and swings.
Newton simulates it; frames of it are rendered on the same tape. The gradient reaches the logarithms of the four
numbers through all steps of the simulation.

Leaves in ``out/cloth/``: ``film.gif`` (the film, and what was found, beside it), ``result.png`` (frames of the film,
of the start and of what was found) and ``report.json``.
"""

from __future__ import annotations

import itertools
import time
from pathlib import Path

import newton
import numpy as np
import recovery
import warp as wp

import warp_psdr as psdr

ROOT = Path(__file__).resolve().parents[1]
INTEGRATOR = psdr.PathIntegrator(max_depth=2)
#: What is sought: resistance to stretching and to a change of area, N/m; damping, N s/m; resistance to bending, N/m².
NUMBERS = ("tri_ke", "tri_ka", "tri_kd", "edge_ke")
TRUTH, START = np.float32([20.0, 20.0, 0.1, 20.0]), np.float32([32.0, 12.0, 0.05, 40.0])
#: Cells of the cloth along an edge of 1 m; its mass, kg; how fast its lower edge is pushed, m/s; steps and seconds.
CELLS, MASS, PUSH, STEPS, SECONDS = 10, 0.4, 3.0, 480, 1.0
#: First seed of the film, which no step uses; share of the frames that a step looks at.
FILM_SEED, LOOKED_AT = 2**32 - 1000, 3


@wp.kernel
def weave(logarithms: wp.array(dtype=float), triangles: wp.array2d(dtype=float), edges: wp.array2d(dtype=float)):
    """All triangles and edges get the same material."""
    i = wp.tid()
    if i < triangles.shape[0]:
        for k in range(3):
            triangles[i, k] = wp.exp(logarithms[k])
    if i < edges.shape[0]:
        edges[i, 0] = wp.exp(logarithms[3])


def hang() -> newton.Model:
    """Return the model of a cloth that hangs by its two upper corners, and whose one side is pushed more."""
    builder, side = newton.ModelBuilder(up_axis=newton.Axis.Y), CELLS + 1
    size = {"dim_x": CELLS, "dim_y": CELLS, "cell_x": 1.0 / CELLS, "cell_y": 1.0 / CELLS, "mass": MASS / side**2}
    still = {"vel": wp.vec3(0.0, 0.0, 0.0), "rot": wp.quat_identity()}
    builder.add_cloth_grid(pos=wp.vec3(-0.5, 0.0, 0.0), **still, **size, tri_drag=0.0, tri_lift=0.0, edge_kd=0.01)
    for i, (x, y, _z) in enumerate(builder.particle_q):
        builder.particle_qd[i] = wp.vec3(0.0, 0.0, PUSH * (1.0 - y) * (1.0 + 2.0 * x))
    for corner in (CELLS * side, CELLS * side + CELLS):
        builder.particle_mass[corner] = 0.0
        builder.particle_qd[corner] = wp.vec3(0.0, 0.0, 0.0)
    return builder.finalize(requires_grad=True, device="cpu")


class Cloth:
    """A cloth, and the film of it."""

    def __init__(self, width: int, frames: int):
        self.model, self.frames = hang(), frames
        self.model.particle_grid = None  # this, and enable_tri_contact: the cloth does not touch itself
        self.solver = newton.solvers.SolverSemiImplicit(self.model, enable_tri_contact=False)
        self.states, self.control = [self.model.state() for _ in range(STEPS + 1)], self.model.control()
        self.logarithms = wp.array(np.log(START), dtype=float, device="cpu", requires_grad=True)
        t = psdr.Transform
        pixels = {"type": "hdrfilm", "width": width, "height": width, "rfilter": {"type": "box"}}
        view = t.look_at([1.2, 1.1, 2.9], [0.1, 0.4, -0.2], [0, 1, 0])
        lamp = t.look_at([-1.5, 2.2, 3.5], [0, 0.4, 0], [0, 1, 0]) @ t.scale(0.3)
        paint = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.35, 0.2]}}
        self.scene = psdr.from_newton(
            self.model,
            sensor={"type": "perspective", "fov": 38.0, "to_world": view, "film": pixels},
            emitters=[{"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": 120.0}}],
            bsdfs={"soft0": {"type": "twosided", "inner": paint}},
            wall={"type": "rectangle", "to_world": t.translate([0, 0, -0.8]) @ t.scale(6)},
        )
        self.params = psdr.traverse(self.scene)

    def film(self, seed: int, spp: int, shown: list[int] | None = None) -> list[wp.array]:
        """Simulate, and return images of the frames that are shown; all of them by default."""
        materials, images = [self.model.tri_materials, self.model.edge_bending_properties], []
        wp.launch(weave, max(len(m) for m in materials), [self.logarithms], materials, device="cpu")
        for step, (before, after) in enumerate(itertools.pairwise(self.states), start=1):
            before.clear_forces()
            self.solver.step(before, after, self.control, None, SECONDS / STEPS)
            frame, rest = divmod(step * self.frames, STEPS)
            if rest == 0 and (shown is None or frame - 1 in shown):
                psdr.bind(self.params, after)
                images.append(psdr.render(self.scene, self.params, integrator=INTEGRATOR, spp=spp, seed=seed + frame))
        return images


def main(
    folder: Path = ROOT / "out" / "cloth", *, width: int = 64, frames: int = 24, steps: int = 80, spp: int = 8
) -> dict:
    """Recover the numbers, write the pictures and return the report."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    cloth = Cloth(width, frames)
    first = [image.numpy() for image in cloth.film(FILM_SEED + frames, 16 * spp)]
    cloth.logarithms.assign(np.log(TRUTH))
    given = [image.numpy() for image in cloth.film(FILM_SEED, 16 * spp)]
    cloth.logarithms.assign(np.log(START))
    told = recovery.tell_ratios(cloth.logarithms, TRUTH)
    recovery.fit_film(cloth.film, given, cloth.logarithms, steps=steps, spp=spp, rate=0.08, share=LOOKED_AT, told=told)
    found = [image.numpy() for image in cloth.film(FILM_SEED + 2 * frames, 16 * spp)]
    recovery.draw_films(folder, {"film": given, "start": first, "found": found}, SECONDS, SECONDS / frames)
    return recovery.number_report(folder, NUMBERS, np.exp(cloth.logarithms.numpy()), TRUTH, began)


if __name__ == "__main__":
    recovery.run(main, __doc__, {"width": 32, "frames": 12, "steps": 50})

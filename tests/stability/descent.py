"""Many steps of an optimisation in a process of its own, and the memory that they take.

Run as a program: ``python -m tests.stability.descent STEPS`` moves vertices: every step renders an image on a tape,
compares it with a target and follows the gradient, the boundary term with guiding included. With a configuration's file
as a second argument it is ``fit`` that makes the steps. The report is a line of JSON: resident memory, MB, every
``EVERY`` steps, and how often the guiding structure was built.
"""

from __future__ import annotations

import json
import resource
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import warp as wp

import warp_psdr as psdr
from tests.boundary import scenes
from tests.stability import killed
from warp_psdr.estimate.guiding.store import structures
from warp_psdr.fit import checkpoint
from warp_psdr.fit.run import FitConfig, fit

#: Steps between two looks at the memory.
EVERY = 10
SIZE = 12  # pixels
#: What is differentiated: the vertices that move, a colour, and what moves a light and the camera.
NAMES = ("box.vertex_positions", "floor.bsdf.reflectance.value", "light.to_world", "cam.to_world")
PAGE = resource.getpagesize() / 2**20


def resident() -> float:
    """Return this process's resident memory, MB (proc_pid_statm(5))."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


def box_over_floor(device: str = "cpu"):
    """A box over a floor that a small light shines on from above; its shadow is in view."""
    sensor = scenes.camera()
    sensor["film"] |= {"width": SIZE, "height": SIZE}
    light = {
        "type": "rectangle",
        "to_world": psdr.Transform.translate([0.3, 0.0, 3.0]) @ psdr.Transform.rotate([1, 0, 0], 180.0).scale(0.4),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [8.0, 7.0, 6.0]}},
    }
    box = scenes.box([0.0, 0.0, 0.8], [0.5, 0.4, 0.2], scenes.diffuse(0.6), turn=0.3)
    plugins = {"cam": sensor, "floor": scenes.floor(), "light": light, "box": box}
    return psdr.load_dict({"type": "scene", **plugins}, device=device)


def descend(steps: int) -> dict:
    """Make the steps."""
    scene = box_over_floor()
    params = psdr.traverse(scene)
    params.requires_grad(*NAMES)
    boundary = psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree(max_leaves=256))
    integrator = psdr.PathIntegrator(max_depth=3, boundary=boundary)
    target = wp.zeros((SIZE, SIZE), dtype=wp.vec3, device=scene.device)
    adam = psdr.optim.Adam(params, lr={NAMES[0]: 2e-3})
    start = params[NAMES[0]].numpy().copy()
    memory, builds, moved = [], 0, 0.0
    for step in range(steps):
        tape = wp.Tape()
        with tape:
            image = psdr.render(scene, params, integrator=integrator, spp=2, spp_grad=2, seed=step, tape=tape)
            loss = psdr.losses.l2(image, target)
        tape.backward(loss)
        adam.step()
        if step % EVERY == EVERY - 1:
            memory.append(resident())
            moved = max(moved, float(np.abs(params[NAMES[0]].numpy() - start).max()))
            builds = max(builds, *(found.builds for found in structures(scene)))
        if step % 50 == 49:  # the box stays in view, and the structure is refreshed and built anew at times
            params[NAMES[0]] = start
            params.update()
    return {"memory": memory, "builds": builds, "moved": moved, "loss": float(loss.numpy()[0])}


def fitted(steps: int, file: Path) -> dict:
    """Let ``fit`` make the steps; it looks at the memory where it saves a checkpoint."""
    killed.without_drawing()
    memory = []
    save = checkpoint.save

    def saved(path, arrays, values) -> None:
        save(path, arrays, values)
        memory.append(resident())

    checkpoint.save = saved
    fit(replace(FitConfig.from_file(file), checkpoint_every=EVERY), iterations=steps)
    return {"memory": memory}


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_WARNING
    count = int(sys.argv[1])
    print(json.dumps(fitted(count, Path(sys.argv[2])) if len(sys.argv) > 2 else descend(count)))

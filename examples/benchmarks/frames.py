"""What a frame costs on a tape of many, over a gradient at the same values by hand; and whether the process grows.

    python examples/benchmarks/frames.py [--quick] [--output docs/data/frames.jsonl]

A ball falls and drifts; its vertices are bound to the parameter, one array a frame. By hand, the same vertices are
written, followed, rendered and differentiated. Times are of the processor, medians.
"""

import os
import time
from pathlib import Path

import numpy as np
import trimesh
import warp as wp
from common import Report, arguments, psdr

SIZE, SPP, FRAMES, NAME = 64, 16, 24, "ball.vertex_positions"
#: Tapes of three frames after which the process is weighed again.
TAPES = 60
T = psdr.Transform


@wp.kernel
def drift(start: wp.array(dtype=wp.vec3), speed: wp.array(dtype=float), t: float, out: wp.array(dtype=wp.vec3)):
    """The simulation."""
    i = wp.tid()
    out[i] = start[i] + wp.vec3(speed[0] * t, -t * t, 0.0)


def resident() -> float:
    """Return the memory of the process, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1.0e6


class Film:
    """A ball above a floor, and its films."""

    def __init__(self, subdivisions: int):
        ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.4)
        self.vertices = (ball.vertices + np.array([0.0, 0.8, 0.0])).astype(np.float32)
        film = {"type": "hdrfilm", "width": SIZE, "height": SIZE}
        lamp = T.translate([0.5, 4, 0]) @ T.rotate([1, 0, 0], 90) @ T.scale(0.4)
        view = T.look_at([0, 2, 3], [0, 0.5, 0], [0, 1, 0])
        scene = {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 50.0, "to_world": view, "film": film},
            "floor": {"type": "rectangle", "to_world": T.rotate([1, 0, 0], -90) @ T.scale(4)},
            "ball": {"type": "mesh", "vertices": self.vertices, "faces": ball.faces.astype(np.int32)},
            "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": 30.0}},
        }
        self.params = psdr.traverse(psdr.load_dict(scene))
        self.params.requires_grad(NAME)
        self.start = wp.array(self.vertices, dtype=wp.vec3, device="cpu")
        self.adjoint = wp.full((SIZE, SIZE), wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3, device="cpu")
        self.options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": SPP}

    def on_tape(self, frames: int) -> float:
        """Return the seconds that films and their gradients take, of a frame."""
        speed = wp.array([1.0], dtype=wp.float32, device="cpu", requires_grad=True)
        tape, images, began = wp.Tape(), [], time.process_time()
        with tape:
            for k in range(frames):
                places = wp.zeros(len(self.vertices), dtype=wp.vec3, device="cpu", requires_grad=True)
                wp.launch(drift, len(places), [self.start, speed, 0.02 * k], [places], device="cpu")
                self.params.bind(NAME, places)
                images.append(psdr.render(self.params.scene, self.params, seed=k, **self.options))
        tape.backward(grads=dict.fromkeys(images, self.adjoint))
        self.params.bind(NAME, None)
        return (time.process_time() - began) / frames

    def by_hand(self, k: int) -> float:
        """Return the seconds of one frame without a tape."""
        speed = wp.array([1.0], dtype=wp.float32, device="cpu")
        wp.launch(drift, len(self.vertices), [self.start, speed, 0.02 * k], [self.params[NAME]], device="cpu")
        began, scene = time.process_time(), self.params.scene
        self.params.update(NAME)
        psdr.render(scene, seed=k, **self.options)
        self.params.zero_grad()
        psdr.render_backward(scene, self.params, self.adjoint, seed=k, **self.options)
        return time.process_time() - began


def main() -> None:
    """Run both meshes and print the table."""
    options = arguments(__doc__).parse_args()
    psdr.set_workers(options.threads)
    rows, repeat = [], options.repeat or (1 if options.quick else 3)
    for subdivisions in (3, 6):
        film = Film(subdivisions)
        for _warm in range(3):
            film.on_tape(2)
        tapes = [film.on_tape(FRAMES) for _ in range(repeat)]
        single = float(np.median([film.by_hand(k) for k in range(FRAMES)]))
        for _warm in range(TAPES // 10):
            film.on_tape(3)
        before = resident()
        for _ in range(TAPES // (10 if options.quick else 1)):
            film.on_tape(3)
        rows.append(
            {
                "vertices": len(film.vertices),
                "by hand [s]": single,
                "on the tape": float(np.median(tapes)) / single,
                "growth [MB]": resident() - before,
            }
        )
    Report("frames on a tape", options.output).table(
        f"{SIZE}² pixels, {SPP} samples, {FRAMES} frames: processor time of a frame over that by hand; "
        f"memory after {TAPES} more tapes",
        rows,
    )


if __name__ == "__main__":
    main()

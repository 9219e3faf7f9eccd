"""What a scene gives, as digests: images, gradients and derivative images over a history of edits.

Run as a program: ``python -m tests.stability.bits METHOD WORKERS``. The last line is JSON: a digest a step.
"""

from __future__ import annotations

import hashlib
import json
import sys

import numpy as np
import warp as wp

import warp_psdr as psdr
from tests.stability.descent import NAMES, SIZE, box_over_floor

LEAVES = {"max_leaves": 256, "samples": 4}
#: Ways to estimate the boundary term; all but the first two keep a structure on the scene.
METHODS = {
    "unguided": lambda: psdr.boundary.PathSpace(),
    "edge sampling": lambda: psdr.boundary.EdgeSampling(),
    "kdtree": lambda: psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree(**LEAVES)),
    "octree": lambda: psdr.boundary.PathSpace(guiding=psdr.guiding.Octree(**LEAVES)),
    "grid": lambda: psdr.boundary.PathSpace(guiding=psdr.guiding.Grid(**LEAVES)),
    "projective": lambda: psdr.boundary.Projective(paths=1024, guiding=psdr.guiding.Octree(**LEAVES)),
}
GUIDED = ("kdtree", "octree", "grid", "projective")
#: Moves of the box between gradients: none (a kept structure is used as it is), a little (it is refreshed), and far
#: (it is built anew).
MOVES = (0.0, 0.0, 0.003, 0.5)


class Bench:
    """A scene, what is asked of it, and the integrator."""

    def __init__(self, method: str, device: str = "cpu"):
        self.scene = box_over_floor(device)
        self.params = psdr.traverse(self.scene)
        self.params.requires_grad(*NAMES)
        self.integrator = psdr.PathIntegrator(max_depth=3, boundary=METHODS[method]())
        self.start = self.params[NAMES[0]].numpy().copy()

    def move(self, way: float) -> None:
        """Put the box ``way`` beside its first place."""
        self.params[NAMES[0]] = self.start + np.float32([way, 0.0, 0.0])
        self.params.update()

    def image(self, seed: int) -> np.ndarray:
        """Return an image."""
        return psdr.render(self.scene, integrator=self.integrator, spp=4, seed=seed).numpy()

    def gradients(self, seed: int) -> list[np.ndarray]:
        """Return the gradients of a random functional of the image."""
        adjoint = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
        self.params.zero_grad()
        psdr.render_backward(self.scene, self.params, adjoint, integrator=self.integrator, spp=4, seed=seed)
        return [self.params[name].grad.numpy().copy() for name in NAMES]

    def derivative(self, seed: int) -> np.ndarray:
        """Return the derivative of the image along a random direction."""
        rng = np.random.default_rng(1)
        tangents = {name: rng.normal(size=self.params[name].numpy().shape) for name in NAMES}
        return psdr.render_forward(
            self.scene, self.params, tangents, integrator=self.integrator, spp=4, seed=seed
        ).numpy()


def digest(*arrays: np.ndarray) -> str:
    """Return a short digest of arrays' bits."""
    assert all(np.isfinite(array).all() and np.abs(array).max() > 0.0 for array in arrays)
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()[:16]


def history(bench: Bench) -> list[str]:
    """Return digests of image, gradient and derivative image after each of the moves."""
    found = []
    for seed, way in enumerate(MOVES):
        bench.move(way)
        found += [digest(bench.image(seed)), digest(*bench.gradients(seed)), digest(bench.derivative(seed))]
    return found


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_WARNING
    psdr.set_workers(int(sys.argv[2]))
    print(json.dumps(history(Bench(sys.argv[1]))))

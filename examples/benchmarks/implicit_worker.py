"""One renderer in a process of its own: runs the passes that it is asked for, a line of JSON each, and times them.

    python examples/benchmarks/implicit_worker.py mitsuba|warp_psdr THREADS

Asked is {"file", "resolution", "depth", "what", "names", "seed"}, answered {"wall", "cpu"}, seconds of wall and
processor time. ``warp_psdr`` is the one on PYTHONPATH, which may be that of another checkout.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np

SPP = 16
#: By how much an update changes values: nothing is to be found unchanged.
CHANGE = 1e-6


class Ours:
    """This renderer with one scene.

    Args:
        file: scene file.
        resolution: pixels along either side.
        depth: path vertices.
    """

    def __init__(self, file: Path, resolution: int, depth: int):
        import warp as wp

        import warp_psdr as psdr

        self._psdr = psdr
        self.scene = psdr.load_file(file, resolution=resolution)
        self.params = psdr.traverse(self.scene)
        self._options = {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": SPP}
        mean = 1.0 / (3.0 * resolution * resolution)
        self._adjoint = wp.full((resolution, resolution), wp.vec3(mean, mean, mean), dtype=wp.vec3, device="cpu")
        self._asked: list[str] = []
        self._values: dict[str, np.ndarray] = {}

    def image(self, names: list[str], seed: int) -> None:
        """Render."""
        self._psdr.render(self.scene, seed=seed, **self._options).numpy()

    def gradient(self, names: list[str], seed: int) -> None:
        """Differentiate the image's mean by some parameters, with every term."""
        if self._asked != names:
            self.params.requires_grad_only(*names)
            self._asked = names
        self.params.zero_grad()
        self._psdr.render_backward(self.scene, self.params, self._adjoint, seed=seed, **self._options)
        if not any(self.params[name].grad.numpy().any() for name in self.params.requested):
            raise RuntimeError(f"the gradient by {', '.join(names)} is zero")

    def update(self, names: list[str], seed: int) -> None:
        """Follow an edit of some parameters."""
        for name in names:
            base = self._values.setdefault(name, self.params[name].numpy())
            self.params[name] = base + np.float32(CHANGE * seed)
        self.params.update(*names)


class Theirs:
    """Mitsuba with the same scene; its gradients have the interior term alone."""

    def __init__(self, file: Path, resolution: int, depth: int):
        import drjit
        import mitsuba

        self._mi, self._dr = mitsuba, drjit
        self._scene = mitsuba.load_file(str(file), resolution=resolution)
        self._params = mitsuba.traverse(self._scene)
        self._path, self._prb = (mitsuba.load_dict({"type": t, "max_depth": depth}) for t in ("path", "prb"))
        mean = 1.0 / (3.0 * resolution * resolution)
        self._adjoint = drjit.full(mitsuba.TensorXf, mean, (resolution, resolution, 3))

    def image(self, names: list[str], seed: int) -> None:
        """Render."""
        image = self._mi.render(self._scene, integrator=self._path, spp=SPP, seed=seed)
        self._dr.eval(image)
        self._dr.sync_thread()
        np.array(image)

    def gradient(self, names: list[str], seed: int) -> None:
        """Differentiate, by ``prb`` without the primal rendering before it."""
        for name in names:
            self._dr.disable_grad(self._params[name])
            self._dr.enable_grad(self._params[name])
        self._params.update()
        self._prb.render_backward(self._scene, self._params, self._adjoint, seed=seed, spp=SPP)
        self._dr.eval(*(self._dr.grad(self._params[name]) for name in names))
        self._dr.sync_thread()


def start(renderer: str, threads: int) -> type[Ours] | type[Theirs]:
    """Prepare a renderer; return its class.

    Raises:
        SystemExit: it is not installed, or does not start.
    """
    if renderer == "warp_psdr":
        import warp as wp

        wp.config.log_level = wp.LOG_WARNING
        import warp_psdr as psdr

        psdr.set_workers(threads)
        return Ours
    from common import import_mitsuba

    import_mitsuba(threads)
    return Theirs


def main() -> None:
    """Answer until the input ends."""
    answers = sys.stdout
    sys.stdout = sys.stderr  # what renderers print is no answer
    made = start(sys.argv[1], int(sys.argv[2]))
    held: dict[tuple, Ours | Theirs] = {}
    for line in sys.stdin:
        ask = json.loads(line)
        key = ask["file"], ask["resolution"], ask["depth"]
        if key not in held:
            held[key] = made(Path(ask["file"]), *key[1:])
        wall, cpu = time.perf_counter(), time.process_time()
        getattr(held[key], ask["what"])(ask["names"], ask["seed"])
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        print(json.dumps({"wall": wall, "cpu": cpu}), file=answers, flush=True)


if __name__ == "__main__":
    main()

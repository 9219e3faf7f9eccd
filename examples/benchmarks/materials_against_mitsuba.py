"""Materials against Mitsuba 3: images by ``path``, and derivatives by all numbers of all materials by ``prb``.

    python examples/benchmarks/materials_against_mitsuba.py [--quick] [--cases NAME ...] [--output results.jsonl]

Both renderers load the same files and take turns; samplers are each renderer's default. "image" and "gradient" are
Mitsuba's time over ours at equal samples, "CPU" the same of processor time, which other users of a machine disturb
less. The gradient is that of the image's sum; Mitsuba's pass is ``integrator.render_backward`` alone, without the
primal rendering before it. "forward" is a derivative image along a direction that raises all numbers. What Mitsuba
lists under another name, or not at all, is not requested of either.
"""

import tempfile
from pathlib import Path

import numpy as np
import warp as wp
from common import Report, arguments, blocks, import_mitsuba, in_turns, median, psdr, ratio, z_test
from material_scenes import MATERIALS, write_maps

from scenes import write_data

SPP = 16
#: Blocks a side of the z-test, and independent images of each renderer.
BLOCKS, SEEDS = 8, 16


class Renderers:
    """Both renderers with one scene."""

    def __init__(self, mi, dr, file: Path, resolution: int, depth: int):
        self._mi, self._dr = mi, dr
        self._ours = psdr.load_file(file, resolution=resolution)
        self._theirs = mi.load_file(str(file), resolution=resolution)
        self._params = psdr.traverse(self._ours)
        self._listed = mi.traverse(self._theirs)
        listed = set(self._listed.keys())
        self.names = [n for n in self._ours.parameters if ".bsdf." in n and n in listed and not n.endswith("to_uv")]
        self._params.requires_grad(*self.names)
        self._options = {"integrator": psdr.PathIntegrator(max_depth=depth, sampler="sobol"), "spp": SPP}
        self._prb = mi.load_dict({"type": "prb", "max_depth": depth, "rr_depth": 5})
        shape = (resolution, resolution)
        self._adjoint = wp.full(shape, wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3, device="cpu")
        self._their_adjoint = dr.full(mi.TensorXf, 1.0, (*shape, 3))
        self._tangents = dict.fromkeys(self.names, 1.0)

    def image(self, seed: int) -> np.ndarray:
        """Render."""
        return psdr.render(self._ours, seed=seed, **self._options).numpy()

    def their_image(self, seed: int) -> np.ndarray:
        """Render with Mitsuba."""
        image = self._mi.render(self._theirs, spp=SPP, seed=seed)
        self._dr.eval(image)
        self._dr.sync_thread()
        return np.array(image)

    def gradient(self, seed: int) -> None:
        """Differentiate."""
        self._params.zero_grad()
        psdr.render_backward(self._ours, self._params, self._adjoint, seed=seed, **self._options)

    def _forget_derivatives(self) -> None:
        for name in self.names:
            self._dr.disable_grad(self._listed[name])
            self._dr.enable_grad(self._listed[name])

    def their_gradient(self, seed: int) -> None:
        """Differentiate with Mitsuba."""
        dr, params = self._dr, self._listed
        self._forget_derivatives()
        params.update()
        self._prb.render_backward(self._theirs, params, self._their_adjoint, seed=seed, spp=SPP)
        dr.eval(*(dr.grad(params[name]) for name in self.names))
        dr.sync_thread()

    def forward(self, seed: int) -> None:
        """Differentiate in forward mode, along a direction that raises all numbers."""
        psdr.render_forward(self._ours, self._params, self._tangents, seed=seed, **self._options)

    def their_forward(self, seed: int) -> None:
        """The same with Mitsuba."""
        dr, params = self._dr, self._listed
        self._forget_derivatives()
        for name in self.names:
            dr.set_grad(params[name], 1.0)
        params.update()
        dr.enqueue(dr.ADMode.Forward, *(params[name] for name in self.names))
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges | dr.ADFlag.ClearInterior)
        derivative = self._prb.render_forward(self._theirs, params, seed=seed, spp=SPP)
        dr.eval(derivative)
        dr.sync_thread()


def main() -> None:
    """Run the cases and print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--cases", nargs="+", default=list(MATERIALS), choices=list(MATERIALS))
    options = parser.parse_args()
    repeat = options.repeat or (3 if options.quick else 7)
    mi, dr = import_mitsuba(options.threads)
    psdr.set_workers(options.threads)
    report = Report("materials against Mitsuba", options.output)
    agreement, speed = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_data(folder)
        write_maps(folder)
        for case in options.cases:
            scene = MATERIALS[case]
            file = scene.write(folder, case)
            both = Renderers(mi, dr, file, 48 if options.quick else 96, scene.max_depth)
            images = [
                blocks(np.stack([f(seed) for seed in range(SEEDS)]).astype(np.float64), BLOCKS)
                for f in (both.image, both.their_image)
            ]
            test = z_test(*images)
            row = {"scene": case, "mean": float(images[0].mean()), "Mitsuba's mean": float(images[1].mean())}
            agreement.append(row | {"max abs z": test["max_z"], "limit": test["limit"], "p (chi2)": test["p"]})
            both = Renderers(mi, dr, file, 96 if options.quick else 256, scene.max_depth)
            times = in_turns(
                {
                    "image": both.image,
                    "path": both.their_image,
                    "gradient": both.gradient,
                    "prb": both.their_gradient,
                    "forward": both.forward,
                    "prb forward": both.their_forward,
                },
                repeat,
            )
            speed.append(
                {
                    "scene": case,
                    "parameters": len(both.names),
                    "image [s]": median(times, "image"),
                    "image": ratio(times, "path", "image"),
                    "image, CPU": ratio(times, "path", "image", "cpu"),
                    "gradient [s]": median(times, "gradient"),
                    "gradient": ratio(times, "prb", "gradient"),
                    "gradient, CPU": ratio(times, "prb", "gradient", "cpu"),
                    "forward [s]": median(times, "forward"),
                    "forward": ratio(times, "prb forward", "forward"),
                    "forward, CPU": ratio(times, "prb forward", "forward", "cpu"),
                }
            )
            report.table(f"{case}: Mitsuba's time over ours", speed[-1:])
    report.table(f"z-test of {BLOCKS}^2 blocks, {SEEDS} seeds of {SPP} samples each", agreement)
    report.table(f"Mitsuba's time over ours, {SPP} samples, medians of {repeat}, {options.threads} threads", speed)


if __name__ == "__main__":
    main()

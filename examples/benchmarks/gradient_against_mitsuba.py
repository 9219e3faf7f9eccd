"""Interior gradient passes against the own primal pass, and against Mitsuba 3's ``prb`` backward pass.

    python examples/benchmarks/gradient_against_mitsuba.py [--quick] [--output results.jsonl]

All passes of a scene take turns: primal, reverse mode (all reflectances; all reflectances and all vertex positions),
forward mode along the same parameters, and Mitsuba's ``path`` and ``prb``. Mitsuba's passes are
``integrator.render_backward`` alone, without the primal rendering before it. Its rectangles have no vertices: their
``to_world`` is differentiated instead. Vertex gradients are timed only: the two renderers parametrise paths
differently, so that their interior terms alone differ; reflectance gradients must agree.
"""

import tempfile
from pathlib import Path

import numpy as np
import warp as wp
from common import Report, arguments, import_mitsuba, in_turns, median, psdr, ratio, z_test

from scenes import CASES, write_data

SCENES = ("Cornell box", "82k triangles")
SPP = 16
#: Independent gradients of each renderer for the z-test.
SEEDS = 16
REFLECTANCE, VERTICES, POSE = ".reflectance.value", ".vertex_positions", ".to_world"
#: The largest ratios wanted: of a differential pass to the primal pass.
WANTED = {"reflectances": 1.25, "reflectances + vertices": 1.5, "forward": 1.5, "forward + vertices": 1.5}


class Ours:
    """Passes of this renderer over one scene."""

    def __init__(self, file: Path, resolution: int, depth: int):
        self.scene = psdr.load_file(file, resolution=resolution)
        self._options = {"integrator": psdr.PathIntegrator(max_depth=depth, boundary=None), "spp": SPP}
        self._adjoint = wp.full((resolution, resolution), wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3, device="cpu")
        self._params = {}
        names = list(self.scene.parameters)
        self.reflectances = [n for n in names if n.endswith(REFLECTANCE)]
        self.everything = self.reflectances + [n for n in names if n.endswith(VERTICES)]
        for key, requested in (("reflectances", self.reflectances), ("everything", self.everything)):
            self._params[key] = psdr.traverse(self.scene)
            self._params[key].requires_grad(*requested)
        rng = np.random.default_rng(2)
        self._tangents = {
            n: rng.normal(size=self.scene.parameters[n].numpy_shape).astype(np.float32) for n in self.everything
        }

    def primal(self, seed: int) -> None:
        """Render."""
        psdr.render(self.scene, seed=seed, **self._options)

    def reverse(self, key: str, seed: int) -> np.ndarray:
        """Return the gradient of the image's sum with respect to the reflectances."""
        params = self._params[key]
        for name in params.requested:
            params[name].grad.zero_()
        psdr.render_backward(self.scene, params, self._adjoint, seed=seed, **self._options)
        return np.stack([params[n].grad.numpy() for n in self.reflectances])

    def forward(self, key: str, seed: int) -> None:
        """Render the derivative along a direction."""
        names = self.reflectances if key == "reflectances" else self.everything
        tangents = {n: self._tangents[n] for n in names}
        psdr.render_forward(self.scene, self._params[key], tangents, seed=seed, **self._options)


class Theirs:
    """Passes of Mitsuba over the same scene."""

    def __init__(self, mi, dr, file: Path, resolution: int, depth: int):
        self._mi, self._dr = mi, dr
        self._scene = mi.load_file(str(file), resolution=resolution)
        self._prb = mi.load_dict({"type": "prb", "max_depth": depth, "rr_depth": 5})
        self._path = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 5})
        self._adjoint = dr.full(mi.TensorXf, 1.0, (resolution, resolution, 3))
        self._keys = {}
        names = list(mi.traverse(self._scene).keys())
        self.reflectances = [n for n in names if n.endswith(REFLECTANCE)]
        self._keys["reflectances"] = self.reflectances
        poses = [n for n in names if n.endswith(POSE) and not n.startswith("sensor")]
        self._keys["everything"] = self.reflectances + [n for n in names if n.endswith(VERTICES)] + poses

    def primal(self, seed: int) -> None:
        """Render."""
        image = self._mi.render(self._scene, integrator=self._path, spp=SPP, seed=seed)
        self._dr.eval(image)
        self._dr.sync_thread()

    def reverse(self, key: str, seed: int) -> np.ndarray:
        """Return the gradient of the image's sum with respect to the reflectances, in the order of ``reflectances``."""
        dr = self._dr
        params = self._mi.traverse(self._scene)
        for name in self._keys["everything"]:
            dr.disable_grad(params[name])
        for name in self._keys[key]:
            dr.enable_grad(params[name])
        params.update()
        self._prb.render_backward(self._scene, params, self._adjoint, seed=seed, spp=SPP)
        grads = [dr.grad(params[name]) for name in self._keys[key]]
        dr.eval(*grads)
        dr.sync_thread()
        return np.stack([np.array(g).reshape(-1) for g in grads[: len(self.reflectances)]])


def agreement(ours: Ours, theirs: Theirs, case: str) -> list[dict]:
    """Compare reflectance gradients, one row a parameter."""
    a = np.stack([ours.reverse("reflectances", seed) for seed in range(SEEDS)]).astype(np.float64)
    b = np.stack([theirs.reverse("reflectances", seed) for seed in range(SEEDS)]).astype(np.float64)
    rows = []
    for i, name in enumerate(ours.reflectances):
        j = match(name, theirs.reflectances)
        test = z_test(a[:, i], b[:, j])
        mean_a, mean_b = a[:, i].mean(axis=0), b[:, j].mean(axis=0)
        row = {"scene": case, "parameter": name, "ours": np.array2string(mean_a, precision=5)}
        row |= {"prb": np.array2string(mean_b, precision=5), "max abs z": test["max_z"], "limit": test["limit"]}
        rows.append(row | {"equal": bool(test["max_z"] < test["limit"] and np.abs(mean_a).min() > 0.0)})
    return rows


def match(name: str, names: list[str]) -> int:
    """Index of a parameter in Mitsuba's list; nested materials have other prefixes there."""
    if name in names:
        return names.index(name)
    rest = [i for i, n in enumerate(names) if n.split(".")[0] not in ("white", "green", "red")]
    if len(rest) != 1:
        raise ValueError(f"{name}: no counterpart among {names}")
    return rest[0]


def main() -> None:
    """Run the scenes and print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(CASES))
    options = parser.parse_args()
    repeat = options.repeat or (5 if options.quick else 7)
    resolution = 96 if options.quick else 256
    mi, dr = import_mitsuba(options.threads)
    psdr.set_workers(options.threads)
    report = Report("gradients against Mitsuba", options.output)
    own, other, equal = [], [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_data(folder)
        for case in options.scenes:
            file, depth = CASES[case].write(folder, case), CASES[case].max_depth
            ours, theirs = Ours(file, resolution, depth), Theirs(mi, dr, file, resolution, depth)
            small = 48 if options.quick else 96
            equal += agreement(Ours(file, small, depth), Theirs(mi, dr, file, small, depth), case)
            times = in_turns(
                {
                    "primal": ours.primal,
                    "path": theirs.primal,
                    "reflectances": lambda i, o=ours: o.reverse("reflectances", i),
                    "prb reflectances": lambda i, t=theirs: t.reverse("reflectances", i),
                    "reflectances + vertices": lambda i, o=ours: o.reverse("everything", i),
                    "prb reflectances + vertices": lambda i, t=theirs: t.reverse("everything", i),
                    "forward": lambda i, o=ours: o.forward("reflectances", i),
                    "forward + vertices": lambda i, o=ours: o.forward("everything", i),
                },
                repeat,
            )
            own.append(row_own(case, "primal", times, 1.0))
            own += [row_own(case, key, times, wanted) for key, wanted in WANTED.items()]
            for mine, its, wanted in (
                ("primal", "path", 0.6),
                ("reflectances", "prb reflectances", 1.2),
                ("reflectances + vertices", "prb reflectances + vertices", 1.2),
            ):
                row = {"scene": case, "pass": mine, "ours [s]": median(times, mine), "Mitsuba [s]": median(times, its)}
                row |= {"throughput": ratio(times, its, mine), "by CPU time": ratio(times, its, mine, "cpu")}
                other.append(row | {"wanted": f">= {wanted}"})
    settings = f"{resolution}^2 pixels, {SPP} samples, medians of {repeat}, {options.threads} threads"
    report.table(f"differential passes against the own primal pass, {settings}", own)
    report.table(f"against Mitsuba (path, prb backward), {settings}", other)
    report.table(f"reflectance gradients against prb, {SEEDS} seeds", equal)


def row_own(case: str, key: str, times: dict, wanted: float) -> dict:
    """One pass against the primal one."""
    row = {"scene": case, "pass": key, "seconds": median(times, key), "x primal": ratio(times, key, "primal")}
    return row | {"x primal (CPU time)": ratio(times, key, "primal", "cpu"), "wanted": f"<= {wanted}"}


if __name__ == "__main__":
    main()

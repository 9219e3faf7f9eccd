"""Shapes without triangles against Mitsuba 3, against the own passes, and against meshes.

    python examples/benchmarks/implicit.py [--quick] [--parts NAME ...] [--before CHECKOUT] [--output results.jsonl]

A grid, hair or a network above a floor, under a lamp, depth 4. Both renderers load the same files, each in a process of
its own, and take turns. "measured" is Mitsuba's time over ours where at least so much is wanted, else our time over
that of what is named beside it. Gradients are of the image's mean and have every term; Mitsuba's (``prb``) have the
interior term alone, on grids and curves. ``--before`` names a checkout from the time before there were such shapes:
scenes of meshes are compared with it.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp
from common import ROOT, Report, Seconds, arguments, in_turns, median, psdr, ratio
from implicit_scenes import DEPTH, LARGE, write
from implicit_worker import SPP, Ours

from warp_psdr.kernels.primitive.network import POSE, phi_along

GRID, POINTS, FLOOR = "body.grid", "body.control_points", "floor.vertex_positions"
#: Points at which a network is evaluated.
EVALUATIONS = 1 << 16
#: Depth of the scenes of meshes.
MESH_DEPTH = 6


class Worker:
    """A renderer in a process of its own.

    Args:
        renderer: "mitsuba" or "warp_psdr".
        threads: it has.
        checkout: whose code it runs.
        cache: its compiled kernels; None: those of this process.
    """

    def __init__(self, renderer: str, threads: int, checkout: Path = ROOT, cache: str | None = None):
        environment = os.environ | {"PYTHONPATH": str(checkout)}
        environment |= {} if cache is None else {"WARP_CACHE_PATH": cache}
        command = [sys.executable, str(Path(__file__).with_name("implicit_worker.py")), renderer, str(threads)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment)

    def run(self, file: Path, resolution: int, depth: int, what: str, names: tuple[str, ...], seed: int) -> Seconds:
        """Run a pass; return its seconds.

        Raises:
            SystemExit: the process ended.
        """
        ask = {"file": str(file), "resolution": resolution, "depth": depth}
        assert self._process.stdin is not None and self._process.stdout is not None
        print(json.dumps(ask | {"what": what, "names": names, "seed": seed}), file=self._process.stdin, flush=True)
        answer = self._process.stdout.readline()
        if not answer:
            raise SystemExit(f"the process that was asked for {what} of {file.name} has ended: see its message above")
        return Seconds(**json.loads(answer))

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


class Bench:
    """Passes by name, and rows of what is measured.

    Args:
        files: name -> scene.
        options: of the command line.
    """

    def __init__(self, files: dict[str, Path], options):
        self.files, self.threads = files, options.threads
        self.before = options.before
        self.resolution = 64 if options.quick else 128
        self.repeat = options.repeat or (3 if options.quick else 5)
        self._report = Report("implicit", options.output)
        self._mitsuba: Worker | None = None

    def ours(self, scene: str, what: str = "image", *names: str) -> Callable[[int], None]:
        """Return a pass of this renderer."""
        made: list[Ours] = []

        def run(seed: int) -> None:
            if not made:
                made.append(Ours(self.files[scene], self.resolution, DEPTH))
            getattr(made[0], what)(list(names), seed)

        return run

    def theirs(self, scene: str, what: str = "image", *names: str) -> Callable[[int], Seconds]:
        """Return a pass of Mitsuba."""

        def run(seed: int) -> Seconds:
            self._mitsuba = self._mitsuba or Worker("mitsuba", self.threads)
            return self._mitsuba.run(self.files[scene], self.resolution, DEPTH, what, names, seed)

        return run

    def bears(self, passes: dict[str, Callable]) -> bool:
        """Whether Mitsuba's process gets through as many passes; if not, that is printed, and a new one is begun."""
        try:
            for seed in range(self.repeat + 1):
                for run in passes.values():
                    run(seed)
        except SystemExit as ended:
            print(f"{ended}\n", flush=True)
            self._mitsuba = None
            return False
        return True

    def compare(self, what: str, passes: dict[str, Callable], wanted: str, beside: tuple[str, str] | None = None):
        """Time passes in turns and report a row: the first over the second; for ">=" the second over the first.

        ``beside``: of which two the same ratio is shown beside.
        """
        times = in_turns(passes, self.repeat)
        first, second = list(passes)[:2]
        pair = (second, first) if wanted.startswith(">=") else (first, second)
        self.row(
            what,
            first=(first, median(times, first)),
            second=(second, median(times, second)),
            measured=[ratio(times, *pair, clock) for clock in ("wall", "cpu")],
            wanted=wanted,
            theirs=None if beside is None else ratio(times, *beside, "cpu"),
        )

    def row(self, what: str, *, first, second, measured, wanted: str, theirs: float | None = None) -> None:
        """Report a row."""
        row = {"what": what, "of": first[0], "seconds": first[1], "and of": second[0], "its seconds": second[1]}
        row |= {"wanted": wanted, "measured": measured[0], "by processor time": measured[1], "Mitsuba's own": theirs}
        size = f"shapes without triangles, {self.resolution}^2 pixels, {SPP} samples, depth {DEPTH}"
        self._report.table(f"{size}, medians of {self.repeat}, {self.threads} threads", [row])

    def close(self) -> None:
        """End Mitsuba's process."""
        if self._mitsuba is not None:
            self._mitsuba.close()


def images(bench: Bench) -> None:
    """Images against Mitsuba's, and an exact sphere against its tessellation."""
    for scene, wanted in (("grid 64", 2.5), ("grid 128", 2.5), ("hair 10000", 1.5), ("hair 50000", 1.5)):
        passes = {"image": bench.ours(scene), "Mitsuba": bench.theirs(scene)}
        bench.compare(f"{scene}, image: speed", passes, f">= {wanted}")
    passes = {"exact": bench.ours("sphere, exact"), "tessellated": bench.ours("sphere, tessellated")}
    bench.compare("exact sphere, image: speed", passes, ">= 1")


def gradients(bench: Bench) -> None:
    """Gradients by all values of a grid and by all control points against the own image; what an edit costs."""
    for scene, name, wanted in (("grid 64, analytic", GRID, 4), ("hair 10000", POINTS, 3)):
        passes: dict[str, Callable] = {"gradient": bench.ours(scene, "gradient", name), "image": bench.ours(scene)}
        theirs = {
            "their gradient": bench.theirs(scene, "gradient", name),
            "their image": bench.theirs(scene),
        }
        pair = ("their gradient", "their image") if bench.bears(theirs) else None
        title = f"{scene}, gradient by {name.partition('.')[2]}: time"
        bench.compare(title, passes if pair is None else passes | theirs, f"<= {wanted}", pair)
    values = psdr.traverse(psdr.load_file(bench.files["grid 64, analytic"]))[GRID].numpy()
    passes = {
        "redistance": lambda _seed: psdr.sdf.redistance(values, device="cpu"),
        "gradient": bench.ours("grid 64, analytic", "gradient", GRID),
    }
    bench.compare("grid 64, redistancing: time", passes, "<= 0.2")
    passes = {"update": bench.ours("grid 64, analytic", "update", GRID), "image": bench.ours("grid 64, analytic")}
    bench.compare("grid 64, update: time", passes, "<= 0.1")


@wp.kernel(module="unique", enable_backward=False)
def evaluate(
    values: wp.array(dtype=wp.float32),
    place: wp.int32,
    at: wp.array(dtype=wp.vec3),
    along: wp.vec3,
    phi: wp.array(dtype=wp.vec2),
):
    """Evaluate a network, with its derivative along a direction as rays do."""
    i = wp.tid()
    phi[i] = phi_along(values, place, at[i], along)


def networks(bench: Bench) -> None:
    """A small network's image against a cubic grid's, and evaluations of a large one."""
    passes = {"network": bench.ours("network"), "cubic grid": bench.ours("grid 33, cubic")}
    bench.compare("network 2 x 32, image: time", passes, "<= 8")
    scene = psdr.load_file(bench.files["large network"])
    place = scene.parameters["body.to_world"].offset + POSE
    at = wp.array(np.random.default_rng(0).random((EVALUATIONS, 3)), dtype=wp.vec3, device="cpu")
    phi = wp.zeros(EVALUATIONS, dtype=wp.vec2, device="cpu")
    inputs = [scene.values, place, at, wp.vec3(0.0, 0.0, 1.0)]
    # One launch is one thread.
    times = in_turns({"": lambda _seed: wp.launch(evaluate, EVALUATIONS, inputs, [phi], device="cpu")}, bench.repeat)
    if not phi.numpy().any():
        raise RuntimeError("the network was not evaluated")
    each = [1e6 * median(times, "", clock) / EVALUATIONS for clock in ("wall", "cpu")]
    name = f"network {len(LARGE)} x {LARGE[0]}, microseconds an evaluation, one thread"
    bench.row(name, first=("evaluations", median(times, "")), second=("", None), measured=each, wanted="<= 1.6")


def meshes(bench: Bench) -> None:
    """Scenes of meshes alone against a checkout from before."""
    if bench.before is None:
        print("scenes of meshes: skipped, there is no --before\n", flush=True)
        return
    file = ROOT / "scenes" / "cornell_box.xml"
    workers = {"now": ROOT, "before": bench.before}
    held = {name: Worker("warp_psdr", bench.threads, checkout) for name, checkout in workers.items()}
    for what, names in (("image", ()), ("gradient", ("*.vertex_positions",))):
        passes = {
            name: lambda seed, w=worker, what=what, names=names: w.run(
                file, bench.resolution, MESH_DEPTH, what, names, seed
            )
            for name, worker in held.items()
        }
        bench.compare(f"Cornell box, {what}: speed", passes, ">= 0.99")
    for worker in held.values():
        worker.close()


def compiling(bench: Bench) -> None:
    """Processor time of what the first image of a grid takes longer than a second one, against that of a mesh."""
    found: dict[str, list[float]] = {"grid": [], "mesh": []}
    for _ in range(2):
        for kind, scene in (("grid", "grid 64"), ("mesh", "mesh")):
            with tempfile.TemporaryDirectory() as cache:
                worker = Worker("warp_psdr", bench.threads, cache=cache)
                first, second = (worker.run(bench.files[scene], 16, DEPTH, "image", (), seed) for seed in (0, 1))
                worker.close()
            found[kind].append(first.cpu - second.cpu)
    each = {kind: statistics.median(seconds) for kind, seconds in found.items()}
    measured = [None, each["grid"] / each["mesh"]]
    first, second = ("first image", each["grid"]), ("that of a mesh", each["mesh"])
    bench.row("first image of a grid, compiling: time", first=first, second=second, measured=measured, wanted="<= 1.5")


PARTS = {f.__name__: f for f in (images, gradients, networks, meshes, compiling)}


def main() -> None:
    """Run the parts and print each row as it is done."""
    parser = arguments(__doc__)
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--before", type=Path, help="checkout with which scenes of meshes are compared")
    options = parser.parse_args()
    psdr.set_workers(options.threads)
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        bench = Bench(write(Path(name)), options)
        for part in options.parts:
            PARTS[part](bench)
        bench.close()
    print(f"{time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()

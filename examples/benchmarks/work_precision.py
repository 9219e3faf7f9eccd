"""Error against seconds: scenes x methods x sample counts, of this renderer and of Mitsuba 3.9.1 in the same run.

    python examples/benchmarks/work_precision.py [--quick] [--cases NAME ...] [--report] [--picture page.png]

Images, derivatives with respect to materials, lights and shapes, and closed forms that show what float32 costs
(``work_precision_cases.py``). Every measurement is one line of the output file; a run that was stopped goes on where
it was, and the tables and the page of plots are made of what the file holds (``--report``: of what it holds already).
Long images of each renderer, with seeds of their own, lie in a folder beside it; errors are relative to these
(``work_precision_data.py``), so that the noise of a method and the difference between two renderers are told apart.
Derivatives of both renderers are compared with finite differences of our images. Seconds are those of one rendering of
a loaded scene; the first call, which compiles or loads what an earlier process has compiled, is listed apart. Methods
take turns.

Without Mitsuba (``pip install 'warp-psdr[bench]'``) its methods are left out.
"""

import os
import re
import tempfile
from pathlib import Path

import numpy as np
from common import arguments, import_mitsuba, machine, markdown, psdr
from work_precision_cases import ALL, Case, Method
from work_precision_data import Records, Reference, squared_error
from work_precision_renderers import Ours, Theirs
from work_precision_report import CLOCKS, CLOSED, DIFFERENCES, best_rows, bias_rows, draw, floor_rows, work_rows

from scenes import write_data

#: Pixels of a side, samples a pixel, and images of a reference, each of the most samples of a run.
PIXELS, COUNTS = (32, 64), ((4, 16, 64, 256), (4, 16, 64, 256))
LONG_IMAGES = (8, 16)
#: Samples a pixel of the images that finite differences are made of.
DIFFERENCE_SAMPLES = (256, 1024)
#: Seconds of a run after which a method gets no more samples.
LIMIT = (3.0, 30.0)
#: What the project asks of the ratio of times at equal error, Mitsuba's over ours.
WANTED = {"image": 1.0, "gradient": 3.0}
NOTE = """The ratio is a product: of samples a second, and of noise in a sample. Where it is below what is wanted, the
lower factor comes first; factors are above one where ours is better, and in brackets is what the rate consists of.
Samples lie in the lanes of vectors in Mitsuba's variant llvm_ad_rgb, and here those of diffuse scenes; others run one
after another on each core.
"""
#: Seeds: those of references and differences are no run's.
LONG_SEED, DIFFERENCE_SEED = 10_000_000, 20_000_000


class Benchmark:
    """The measurements of one invocation.

    Args:
        records: what is finished.
        folder: of the references.
        quick: small sizes.
        repeat: runs of a method and sample count.
        mitsuba: (mitsuba, drjit), or None.
    """

    def __init__(self, records: Records, folder: Path, quick: bool, repeat: int, mitsuba: tuple | None):
        self._records, self._folder, self._quick, self._repeat = records, folder, quick, repeat
        self._mitsuba, self._machine = mitsuba, machine()

    def pick(self, pair):
        """Return the quick or the full one of two values."""
        return pair[0 if self._quick else 1]

    def measure(self, name: str, case: Case, scenes: Path) -> None:
        """Measure what is missing of a case."""
        pixels, counts = self.pick(case.pixels or PIXELS), self.pick(case.counts or COUNTS)
        if self._finished(name, case, pixels, counts):
            return
        file = case.write(scenes)
        renderers = {}
        for method, options in self.methods(case).items():
            renderer = self._start(name, method, options, case, file, pixels, min(counts))
            if renderer is not None:
                renderers[method] = renderer
        references = self._references(name, case, renderers, pixels, max(counts))
        for spp in counts:
            for repeat in range(self._repeat):
                for method, renderer in renderers.items():
                    row = key("run", name, method, spp, repeat, pixels)
                    reference = references[CLOSED if case.closed else first_of(method, case)]
                    if row in self._records or reference.blank or self._slow(name, method, pixels):
                        continue
                    run = renderer.run(spp, 1 + 1000 * spp + repeat)
                    error = squared_error(run.values, reference)
                    self._add(row, seconds=run.seconds, cores=run.cores, squared_error=error)

    def _finished(self, name: str, case: Case, pixels: int, counts: tuple[int, ...]) -> bool:
        """Whether nothing is missing: not even the scene is loaded then."""
        for method in self.methods(case):
            if key("refused", name, method, min(counts), 0, pixels) in self._records:
                continue
            runs = (key("run", name, method, spp, i, pixels) for spp in counts for i in range(self._repeat))
            if not self._slow(name, method, pixels) and any(row not in self._records for row in runs):
                return False
        return True

    def _slow(self, name: str, method: str, pixels: int) -> bool:
        """Whether a run took so long that no other follows."""
        wanted = key("run", name, method, None, None, pixels)
        same = (r for r in self._records.rows if all(r[k] == v for k, v in wanted.items() if v is not None))
        return any(r["seconds"] > self.pick(LIMIT) for r in same)

    def methods(self, case: Case) -> dict[str, Method]:
        """Return the methods that are run."""
        both = case.ours | (case.mitsuba if self._mitsuba else {})
        return {name: method for name, method in both.items() if not (self._quick and method.full)}

    def _start(self, name: str, method: str, options: Method, case: Case, file: Path, pixels: int, spp: int):
        """Load a scene and make the first call; None where the renderer refuses."""
        row, refused = (key(kind, name, method, spp, 0, pixels) for kind in ("cold", "refused"))
        if refused in self._records:
            return None
        try:
            if method in case.ours:
                renderer = Ours(file, pixels, case, options)
            else:
                renderer = Theirs(*self._mitsuba, file, pixels, case, options)
            seconds = renderer.first(spp)
        except Exception as error:  # Mitsuba's refusals have no common class; ours are not expected
            if method in case.ours:
                raise
            text = str(error).strip().splitlines()[-1]
            self._add(refused, message=text)
            print(f"  {method} raises: {text}", flush=True)
            return None
        if row not in self._records:
            self._add(row, seconds=seconds)
        return renderer

    def _references(self, name: str, case: Case, renderers: dict, pixels: int, most: int) -> dict[str, Reference]:
        count = self.pick(LONG_IMAGES)
        result = {}
        for method in [m for m in renderers if m in (first_of(m, case), *(renderers if case.closed else ()))]:
            run = renderers[method].run
            result[method] = self._long(name, method, lambda i, run=run: run(most, LONG_SEED + i), count, most, pixels)
        if case.closed:
            result[CLOSED] = Reference(case.closed(pixels)[None])
            self._save(name, CLOSED, pixels, result[CLOSED].images)
        if case.step:
            run, samples = renderers[next(iter(case.ours))].difference, self.pick(DIFFERENCE_SAMPLES)
            result[DIFFERENCES] = self._long(
                name, DIFFERENCES, lambda i: run(samples, DIFFERENCE_SEED + i), count, samples, pixels
            )
        return result

    def _long(self, name: str, method: str, run, count: int, spp: int, pixels: int) -> Reference:
        row = key("long", name, method, spp, count, pixels)
        file = reference_file(self._folder, name, method, pixels)
        if row not in self._records or not file.is_file():
            runs = [run(i) for i in range(count)]
            self._save(name, method, pixels, np.stack([r.values for r in runs]))
            self._add(row, seconds=sum(r.seconds for r in runs))
        reference = Reference(np.load(file))
        if reference.blank:
            print(f"  {method}: nothing but noise in {count} images of {spp} samples", flush=True)
        return reference

    def _save(self, name: str, method: str, pixels: int, images: np.ndarray) -> None:
        file = reference_file(self._folder, name, method, pixels)
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part")
        with open(part, "wb") as stream:
            np.save(stream, images)
        os.replace(part, file)

    def _add(self, row: dict, **values) -> None:
        self._records.append(row | values | {"machine": self._machine})


def key(kind: str, case: str, method: str, spp: int | None, repeat: int | None, pixels: int) -> dict:
    """Return what tells a measurement from others."""
    return {"kind": kind, "case": case, "method": method, "spp": spp, "repeat": repeat, "pixels": pixels}


def first_of(method: str, case: Case) -> str:
    """Return the method that gives the reference of a method's renderer."""
    return next(iter(case.ours if method in case.ours else case.mitsuba))


def reference_file(folder: Path, case: str, method: str, pixels: int) -> Path:
    """Return where the long images of a method lie."""
    return folder / (re.sub(r"[^a-z0-9]+", "_", f"{case} {method} {pixels}".lower()) + ".npy")


def caption(name: str, case: Case, pixels: int) -> str:
    """Return a panel's title: the scene, what is computed of it, and its size."""
    what = {
        "image": "image",
        "forward": f"derivative image by {case.parameter}",
        "reverse": f"gradient by {case.parameter}",
    }
    return f"{name.partition(':')[0]}, {pixels} × {pixels}\n{what[case.kind]}"


def report(
    records: Records, folder: Path, names: list[str], pixels: dict[str, int], picture: Path | None, clock: str
) -> None:
    """Print the tables of what is there, and draw the page."""
    rows = [r for r in records.rows if r["case"] in names and r["pixels"] == pixels[r["case"]]]
    if not rows:
        raise SystemExit(f"{records.file}: holds no measurement of these cases and sizes; run without --report first")
    shown = [n for n in names if any(r["case"] == n for r in rows)]
    longs = {n: [r["method"] for r in rows if r["kind"] == "long" and r["case"] == n] for n in shown}
    longs = {n: [m for m in dict.fromkeys(v) if m != DIFFERENCES] for n, v in longs.items()}

    def find(case: str, method: str) -> Reference | None:
        file = reference_file(folder, case, method, pixels[case])
        return Reference(np.load(file)) if file.is_file() else None

    machines = {(m["cpu"], m["cores"]) for m in (r["machine"] for r in rows)}
    versions = {
        k: ", ".join(sorted({str(r["machine"][k]) for r in rows if k in r["machine"]}))
        for k in ("python", "warp", "warp_psdr", "mitsuba", "commit")
    }
    where = "; ".join(f"{cores} cores of {cpu}" for cpu, cores in sorted(machines))
    load = max(r["machine"]["load"] for r in rows)
    line = f"{where}; " + ", ".join(f"{k} {v}" for k, v in versions.items() if v)
    print(f"## Work and precision\n\n{line}; load of the machine at the start {load:.1f}\n")
    judged = bias_rows(shown, longs, find)
    wanted = {n: WANTED["image" if ALL[n].kind == "image" else "gradient"] for n in shown}
    markdown("ratio of times at equal error: above one, ours is faster", best_rows(rows, judged, wanted))
    print(NOTE)
    markdown("each method at its largest sample count; medians", work_rows(rows, shown))
    markdown("what is computed: references against each other and against finite differences", judged)
    floors = floor_rows(shown, longs, find)
    markdown(
        "what float32 costs: error against closed forms in float64 that remains with any number of samples", floors
    )
    if picture is not None:
        what = {n: caption(n, ALL[n], pixels[n]) for n in shown}
        draw(picture, rows, what, floors, judged, f"Samples a pixel rise along each curve. {line}", clock)
        print(f"{picture}")


def main() -> None:
    """Run and report."""
    parser = arguments(__doc__)
    parser.add_argument("--cases", nargs="+", choices=list(ALL), help="default: all; quick: those of the quick run")
    parser.add_argument("--without-mitsuba", action="store_true", help="our own methods alone")
    parser.add_argument("--report", action="store_true", help="measure nothing; tables and plots of the output file")
    parser.add_argument("--picture", type=Path, help="write the page of plots to this file")
    parser.add_argument("--clock", choices=list(CLOCKS), default="wall", help="what the page of plots shows")
    options = parser.parse_args()
    output = options.output or Path("out") / f"work_precision_{'quick' if options.quick else 'full'}.jsonl"
    names = options.cases or [n for n, case in ALL.items() if case.quick or not options.quick]
    records, folder = Records(output), output.with_suffix("")
    psdr.set_workers(options.threads)
    pair = [(ALL[n].pixels or PIXELS)[0 if options.quick else 1] for n in names]
    if not options.report:
        mitsuba = None
        if not options.without_mitsuba:
            try:
                mitsuba = import_mitsuba(options.threads)
            except SystemExit as error:
                print(f"Mitsuba's methods are left out: {error}")
        benchmark = Benchmark(records, folder, options.quick, options.repeat or (3 if options.quick else 5), mitsuba)
        with tempfile.TemporaryDirectory() as scenes:
            write_data(Path(scenes))
            for name in names:
                print(f"{name} ...", flush=True)
                benchmark.measure(name, ALL[name], Path(scenes))
    report(records, folder, names, dict(zip(names, pair, strict=True)), options.picture, options.clock)


if __name__ == "__main__":
    main()

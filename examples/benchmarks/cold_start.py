"""Time from the start of Python to a first result, with an empty and with a warm kernel cache, and peak memory.

    python examples/benchmarks/cold_start.py [--quick] [--output results.jsonl]
    python examples/benchmarks/cold_start.py --check | --record

Every measurement is a process of its own; the time includes the interpreter's start and all imports, "cpu" is the
processor time of all threads, "modules" is how many compiled modules the process leaves in an empty cache. Wanted on
two idle cores for the Cornell box, cold: an image 5 s, a first gradient of moving vertices with all terms 13 s, the
same guided 18 s; warm at most 2 s and 600 MB, and memory that does not grow with depth or samples.

``--check`` is the guard of CI: it fails where a session compiles another number of modules than recorded, or takes
25 % more processor time (``cold_start.json``), in units of what compiling fixed kernels takes on the machine.
``--record`` writes what it measures in place of that.
"""

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import warp as wp
from common import ROOT, Report, arguments

RECORD = Path(__file__).with_suffix(".json")
#: By how much more processor time than recorded a session may take.
ALLOWED = 1.25
#: What is run: which parameters are differentiated, and options of the boundary term.
SESSIONS = {
    "image": {},
    "gradient of moving vertices": {"names": ["vertex_positions"], "boundary": "auto"},
    "the same guided": {"names": ["vertex_positions"], "boundary": "guided"},
}
#: The interior's gradient alone, of reflectances and vertices, for peak memory.
INTERIOR = {"names": ["reflectance.value", "vertex_positions"], "boundary": "none"}
CHILD = """
import json, resource, sys, time
start = time.perf_counter()
import warp as wp
wp.config.log_level = wp.LOG_WARNING
import warp_psdr as psdr
o = json.loads(sys.argv[1])
psdr.set_workers(o["threads"])
imported = time.perf_counter()
scene = psdr.load_file(o["file"], resolution=o["resolution"])
boundary = {"none": None, "auto": "auto", "guided": psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree())}
integrator = psdr.PathIntegrator(max_depth=o["depth"], boundary=boundary[o["boundary"]])
loaded = time.perf_counter()
image = psdr.render(scene, integrator=integrator, spp=o["spp"])
rendered = time.perf_counter()
if o["names"]:
    params = psdr.traverse(scene)
    params.requires_grad(*[n for n in params if n.endswith(tuple(o["names"]))])
    psdr.render_backward(scene, params, wp.ones_like(image), integrator=integrator, spp=o["spp"])
usage = resource.getrusage(resource.RUSAGE_SELF)
peak = usage.ru_maxrss / 1024  # MiB on Linux
print(json.dumps({"import": imported - start, "load": loaded - imported, "render": rendered - loaded, "peak": peak,
                  "mean": float(image.numpy().mean())}))
"""


def run(cache: str, threads: int, *, resolution=256, spp=16, depth=6, names=(), boundary="none") -> dict:
    """Run one process and return its measurements; ``total`` is its wall time."""
    options = {"file": str(ROOT / "scenes" / "cornell_box.xml"), "resolution": resolution, "spp": spp, "depth": depth}
    options |= {"names": names, "boundary": boundary, "threads": threads}
    printed, measured = process(["-c", CHILD, json.dumps(options)], cache)
    result = json.loads(printed.strip().splitlines()[-1])
    if not result["mean"] > 0.0:
        raise SystemExit(f"the measured process rendered a black image (mean {result['mean']})")
    return result | measured


def process(command: list[str], cache: str) -> tuple[str, dict]:
    """Run Python with a kernel cache; return what it prints, its seconds, and the modules that the cache has then."""
    path = os.pathsep.join(p for p in (str(ROOT), os.environ.get("PYTHONPATH")) if p)
    environment = os.environ | {"WARP_CACHE_PATH": cache, "PYTHONPATH": path}
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run([sys.executable, *command], env=environment, capture_output=True, text=True, check=False)
    total, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise SystemExit(f"the measured process failed:\n{done.stderr}")
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return done.stdout, {"total": total, "cpu": cpu, "modules": len(list(Path(cache).rglob("*.o")))}


def make_calibration(number: float) -> wp.Kernel:
    """Return a kernel that takes about as long to compile as one of a path loop."""

    @wp.func
    def turned(m: wp.mat33, x: float) -> wp.mat33:
        q = wp.quat_from_axis_angle(wp.normalize(m[0]), x)
        inverse = wp.inverse(m + wp.identity(n=3, dtype=float) * (x + wp.static(number)))
        return wp.quat_to_matrix(q) * inverse * wp.cw_mul(m, inverse)

    @wp.kernel(module="unique", enable_backward=False)
    def calibration(matrices: wp.array(dtype=wp.mat33)):
        i = wp.tid()
        m = matrices[i]
        for j in range(8):
            m = turned(m, float(j)) + turned(wp.transpose(m), wp.determinant(m))
        matrices[i] = m

    return calibration


def calibrate() -> None:
    """Compile fixed kernels on two threads, as a session does."""
    wp.init()
    kernels = [make_calibration(float(number)) for number in range(4)]
    with ThreadPoolExecutor(2) as threads:
        list(threads.map(lambda kernel: wp.load_module(kernel.module, device="cpu"), kernels))


def cold(command: list[str] | None = None, **settings) -> dict:
    """Run a session, or another command, with an empty cache."""
    with tempfile.TemporaryDirectory() as cache:
        return process(command, cache)[1] if command else run(cache, **settings)


def check(record: bool) -> int:
    """Compare compiling with what is recorded, or record it; return the exit status."""
    small = {"resolution": 16, "spp": 1, "threads": 2}
    unit = cold([__file__, "--calibrate"])["cpu"]
    found = {}
    for name, settings in SESSIONS.items():
        measured = cold(**small, **settings)
        modules, cpu = measured["modules"], round(measured["cpu"] / unit, 3)
        found[name] = {"modules": modules, "cpu": cpu}
        print(f"{name}: {modules} modules, {measured['cpu']:.1f} s = {cpu} units", flush=True)
    print(f"unit: {unit:.1f} s of processor time")
    if record:
        RECORD.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
        return 0
    wrong = []
    for name, known in json.loads(RECORD.read_text(encoding="utf-8")).items():
        modules, cpu = found[name]["modules"], found[name]["cpu"]
        if cpu > ALLOWED * known["cpu"]:  # measured again, with its unit: a shared machine may have been busy
            unit = cold([__file__, "--calibrate"])["cpu"]
            cpu = min(cpu, round(cold(**small, **SESSIONS[name])["cpu"] / unit, 3))
        if modules != known["modules"]:
            wrong.append(f"{name}: compiles {modules} modules, recorded are {known['modules']}")
        if cpu > ALLOWED * known["cpu"]:
            wrong.append(f"{name}: takes {cpu} units of processor time, recorded are {known['cpu']}")
    for line in wrong:
        print(f"cold start: {line}; --record takes it as it is now", file=sys.stderr)
    return 1 if wrong else 0


def main() -> None:
    """Measure and print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--check", action="store_true", help="compare compiling with what is recorded")
    parser.add_argument("--record", action="store_true", help="record it")
    parser.add_argument("--calibrate", action="store_true", help="compile what --check compares with, and end")
    options = parser.parse_args()
    if options.calibrate:
        calibrate()
        return
    if options.check or options.record:
        sys.exit(check(options.record))
    repeat = options.repeat or (3 if options.quick else 5)
    report = Report("cold start", options.output)
    starts, memory = [], []
    with tempfile.TemporaryDirectory() as warm:
        for name, settings in SESSIONS.items():
            run(warm, options.threads, **settings)
            for state in ("cold", "warm"):
                results = [
                    cold(threads=options.threads, **settings)
                    if state == "cold"
                    else run(warm, options.threads, **settings)
                    for _ in range(repeat)
                ]
                row = {"run": name, "kernel cache": state}
                for key in ("total", "cpu", "import", "load", "render"):
                    row[f"{key} [s]"] = statistics.median(r[key] for r in results)
                row["modules"] = results[0]["modules"] if state == "cold" else 0
                starts.append(row | {"peak [MB]": max(r["peak"] for r in results)})
        grid = (
            [(6, 16), (6, 128), (32, 16), (-1, 16)]
            if options.quick
            else [(2, 16), (6, 16), (6, 256), (64, 16), (-1, 16)]
        )
        for depth, spp in grid:
            row = {"depth": "unbounded" if depth < 0 else depth, "samples": spp}
            for name, settings in (("image", {}), ("image and gradient", INTERIOR)):
                # The second run: no compiler in the process.
                settings = {"resolution": 128, "spp": spp, "depth": depth} | settings
                run(warm, options.threads, **settings)
                row[f"{name}, peak [MB]"] = run(warm, options.threads, **settings)["peak"]
            memory.append(row)
    pixels = f"Cornell box, 256^2 pixels, 16 samples, depth 6, medians of {repeat}, {options.threads} threads"
    report.table(f"start to first result, {pixels}", starts)
    report.table("peak memory, Cornell box, 128^2 pixels, warm cache", memory)


if __name__ == "__main__":
    main()

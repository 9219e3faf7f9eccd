"""Time from the start of Python to the first image, with an empty and with a warm kernel cache, and peak memory.

    python examples/benchmarks/cold_start.py [--quick] [--output results.jsonl]

Every measurement is a process of its own; the time includes the interpreter's start and all imports, "cpu" is the
processor time of all threads. Wanted for the Cornell box: cold at most 10 s, warm at most 2 s, at most 600 MB, and
memory that does not grow with depth or samples.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time

from common import ROOT, Report, arguments

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
integrator = psdr.PathIntegrator(max_depth=o["depth"], boundary=None)
loaded = time.perf_counter()
image = psdr.render(scene, integrator=integrator, spp=o["spp"])
rendered = time.perf_counter()
if o["gradient"]:
    params = psdr.traverse(scene)
    params.requires_grad(*[n for n in params if n.endswith(("reflectance.value", "vertex_positions"))])
    psdr.render_backward(scene, params, wp.ones_like(image), integrator=integrator, spp=o["spp"])
usage = resource.getrusage(resource.RUSAGE_SELF)
peak = usage.ru_maxrss / 1024  # MiB on Linux
print(json.dumps({"import": imported - start, "load": loaded - imported, "render": rendered - loaded, "peak": peak,
                  "cpu": usage.ru_utime + usage.ru_stime,
                  "mean": float(image.numpy().mean())}))
"""


def run(cache: str, threads: int, *, resolution=256, spp=16, depth=6, gradient=False) -> dict:
    """Run one process and return its measurements; ``total`` is its wall time."""
    options = {"file": str(ROOT / "scenes" / "cornell_box.xml"), "resolution": resolution, "spp": spp, "depth": depth}
    options |= {"gradient": gradient, "threads": threads}
    path = os.pathsep.join(p for p in (str(ROOT), os.environ.get("PYTHONPATH")) if p)
    environment = os.environ | {"WARP_CACHE_PATH": cache, "PYTHONPATH": path}
    start = time.perf_counter()
    command = [sys.executable, "-c", CHILD, json.dumps(options)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    total = time.perf_counter() - start
    if done.returncode:
        raise SystemExit(f"the measured process failed:\n{done.stderr}")
    result = json.loads(done.stdout.strip().splitlines()[-1])
    if not result["mean"] > 0.0:
        raise SystemExit(f"the measured process rendered a black image (mean {result['mean']})")
    return result | {"total": total}


def main() -> None:
    """Measure and print the tables."""
    options = arguments(__doc__).parse_args()
    repeat = options.repeat or (3 if options.quick else 5)
    report = Report("cold start", options.output)
    starts, memory = [], []
    with tempfile.TemporaryDirectory() as warm:
        run(warm, options.threads)
        run(warm, options.threads, gradient=True)
        for name, gradient, wanted in (("image", False, "cold <= 10 s, warm <= 2 s"), ("image and gradient", True, "")):
            for state in ("cold", "warm"):
                results = []
                for _ in range(repeat):
                    with tempfile.TemporaryDirectory() as cold:
                        results.append(run(cold if state == "cold" else warm, options.threads, gradient=gradient))
                row = {"run": name, "kernel cache": state}
                for key in ("total", "cpu", "import", "load", "render"):
                    row[f"{key} [s]"] = statistics.median(r[key] for r in results)
                starts.append(row | {"peak [MB]": max(r["peak"] for r in results), "wanted": wanted})
        grid = (
            [(6, 16), (6, 128), (32, 16), (-1, 16)]
            if options.quick
            else [(2, 16), (6, 16), (6, 256), (64, 16), (-1, 16)]
        )
        for depth, spp in grid:
            row = {"depth": "unbounded" if depth < 0 else depth, "samples": spp}
            for name, gradient in (("image", False), ("image and gradient", True)):
                # The second run: no compiler in the process.
                settings = {"resolution": 128, "spp": spp, "depth": depth, "gradient": gradient}
                run(warm, options.threads, **settings)
                row[f"{name}, peak [MB]"] = run(warm, options.threads, **settings)["peak"]
            memory.append(row)
    pixels = f"Cornell box, 256^2 pixels, 16 samples, depth 6, medians of {repeat}, {options.threads} threads"
    report.table(f"start to first result, {pixels}", starts)
    report.table("peak memory, Cornell box, 128^2 pixels, warm cache", memory)


if __name__ == "__main__":
    main()

"""Where the processor time of images and of gradients goes, by phase, by function and by kind of instruction.

    python examples/benchmarks/where.py [CASE ...] [--what image gradient forward] [--functions 25] [--output FILE]

``perf`` takes samples of one thread, and llvm-symbolizer tells the functions that were inlined there; both must be
installed (Debian: linux-perf, llvm, binutils). Kernels are compiled once more, with line tables, in a cache of their
own. A phase is the innermost function that runs for all lanes, or queries rays. "vector" are instructions on the widest
registers in use, "scalar" those on single floats, "stack" those that touch the stack; a sample may count as both.
"""

import bisect
import collections
import gc
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import warp as wp
from common import ROOT, Report, arguments, psdr
from material_scenes import MATERIALS, write_maps

from scenes import CASES, write_data

ALL = {**MATERIALS, **CASES}
WHATS = ("image", "gradient", "forward")
#: Samples of the processor a second; samples a pixel; processor seconds that are looked at.
RATE, SPP, SECONDS = 1999, 16, 10.0
#: Runs before: the second gradient by the same numbers compares methods (``interior="auto"``).
WARM = 3
#: Files whose factories' functions are phases.
PHASES = ("lanes", "bvh", "interior")
#: What is a phase beside: generated functions, and structs of the ray queries, which are C++ texts; and what is none.
OTHERS = {"draw_models", "evaluate_models", "Query", "Each", "Roots", "Bundle"}
NONE = {"make_rows", "make_record", "make_number"}
SCALAR = re.compile(r"^v?[a-z0-9]+s[sd]\b")
STACK = re.compile(r"\((%r[sb]p)\b")


class Sample(NamedTuple):
    """An address in a kernel: its number of samples, its functions from the innermost on, and its instruction."""

    count: int
    functions: tuple[str, ...]
    instruction: str


def output(*command: str, given: str | None = None) -> str:
    """Return what a program prints."""
    return subprocess.run(command, capture_output=True, text=True, check=True, input=given).stdout


def factories() -> set[str]:
    """Return the names of the factories whose functions are phases."""
    files = (file for folder in PHASES for file in (ROOT / "kernels" / folder).glob("*.py"))
    found = {name for file in files for name in re.findall(r"^def (make_\w+)", file.read_text(), re.MULTILINE)}
    return (found | OTHERS) - NONE


def kernels(cache: Path) -> list[tuple[int, int, Path]]:
    """Return (address, offset in its object file, object file) of every kernel that is loaded, by address."""
    found, lookup = [], wp._src.context.runtime.llvm.wp_lookup
    for module in [thing for thing in gc.get_objects() if type(thing).__name__ == "ModuleExec"]:
        for file in cache.glob("*/*/*.o"):
            if not (isinstance(module.handle, str) and file.parent.name.startswith(module.handle.rpartition("_")[0])):
                continue
            for line in output("nm", "--defined-only", str(file)).splitlines():
                offset, _kind, name = line.split()
                if name.endswith("_cpu_forward"):
                    address = lookup(module.handle.encode(), name.encode())
                    if address:
                        found.append((address, int(offset, 16), file))
    return sorted(found)


def plain(name: str) -> str:
    """Return a C++ function's name without its hashes: ``make_place_lanes.stand``, ``Query::run``."""
    name = re.sub(r"[(<].*$|_[0-9a-f]{8}\b.*$", "", name)
    return re.sub(r"_\d+$", "", name).replace("__locals__", ".")


def samples_of(record: Path, cache: Path) -> tuple[list[Sample], int]:
    """Return the samples in kernels, and the number of all."""
    addresses, total = collections.Counter(), 0
    for line in output("perf", "script", "-i", str(record), "-F", "ip,dso").splitlines():
        address, _, where = line.strip().partition(" ")
        total += 1
        if "JIT" in where or "/perf-" in where or "unknown" in where:
            addresses[int(address, 16)] += 1
    loaded = kernels(cache)
    starts = [address for address, _offset, _file in loaded]
    by_file: dict[Path, collections.Counter] = collections.defaultdict(collections.Counter)
    for address, count in addresses.items():
        i = bisect.bisect_right(starts, address) - 1
        if i >= 0:
            start, offset, file = loaded[i]
            by_file[file][address - start + offset] += count
    found = []
    for file, counts in by_file.items():
        lines = output("objdump", "-d", "--no-show-raw-insn", str(file)).splitlines()
        code = {int(m[1], 16): m[2] for m in (re.match(r"^\s*([0-9a-f]+):\t(.*)", line) for line in lines) if m}
        asked = "\n".join(hex(address) for address in counts)
        told = output("llvm-symbolizer", f"--obj={file}", "-i", "--output-style=LLVM", given=asked)
        for (address, count), block in zip(counts.items(), told.strip().split("\n\n"), strict=True):
            functions = tuple(plain(name) for name in block.split("\n")[::2])
            found.append(Sample(count, functions, code.get(address, "")))
    return found, total


def phase(functions: tuple[str, ...], makers: set[str]) -> str:
    """Return the innermost function that is a phase; if none is, the outermost one below the kernel."""
    for name in functions:
        if re.split(r"\.|::", name)[0] in makers:
            return name
    return functions[max(len(functions) - 6, 0)] if functions else "unknown"


def shares(samples: list[Sample], total: int) -> dict:
    """Return the share of some samples in all, and what their instructions are, %."""
    count = sum(s.count for s in samples)
    kinds = {
        "vector": [s for s in samples if "%zmm" in s.instruction or "%ymm" in s.instruction],
        "scalar": [s for s in samples if SCALAR.match(s.instruction)],
        "stack": [s for s in samples if STACK.search(s.instruction)],
    }
    row = {"%": round(100.0 * count / total, 1)}
    return row | {kind: round(100.0 * sum(s.count for s in those) / max(count, 1)) for kind, those in kinds.items()}


def runner(case: str, what: str, folder: Path):
    """Return what renders an image, or differentiates by all numbers of all materials in either mode, for a seed."""
    scene = psdr.load_file(ALL[case].write(folder, case), resolution=256)
    options = {"integrator": psdr.PathIntegrator(max_depth=ALL[case].max_depth, sampler="sobol"), "spp": SPP}
    if what == "image":
        return lambda seed: psdr.render(scene, seed=seed, **options)
    params = psdr.traverse(scene)
    names = [name for name in scene.parameters if ".bsdf." in name and not name.endswith("to_uv")]
    if what == "forward":
        tangents = dict.fromkeys(names, 1.0)
        return lambda seed: psdr.render_forward(scene, params, tangents, seed=seed, **options)
    params.requires_grad(*names)
    adjoint = np.ones((256, 256, 3), np.float32)

    def gradient(seed: int) -> None:
        params.zero_grad()
        psdr.render_backward(scene, params, adjoint, seed=seed, **options)

    return gradient


def main() -> None:
    """Run the cases and print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("cases", nargs="*", default=["mixed"], choices=[*ALL], metavar="CASE")
    parser.add_argument("--what", nargs="+", default=["image"], choices=WHATS)
    parser.add_argument("--functions", type=int, default=25, help="so many functions and phases at most")
    options = parser.parse_args()
    missing = [name for name in ("perf", "llvm-symbolizer", "nm", "objdump") if shutil.which(name) is None]
    if missing:
        raise SystemExit(f"{', '.join(missing)}: not found; Debian's packages are linux-perf, llvm and binutils")
    report, makers = Report("where", options.output), factories()
    psdr.set_workers(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        wp.config.kernel_cache_dir = str(folder / "cache")
        wp.config.cpu_compiler_flags += " -debug-info-kind=line-tables-only"
        write_data(folder)
        write_maps(folder)
        for case in options.cases:
            for what in options.what:
                run = runner(case, what, folder)
                for seed in range(WARM):
                    run(seed)
                command = ["perf", "record", "-q", "-F", str(RATE), "-e", "cpu-clock", "-p", str(os.getpid())]
                perf = subprocess.Popen([*command, "-o", str(folder / "record")])
                time.sleep(1.0)
                start, runs = time.process_time(), 0
                while time.process_time() - start < (2.0 if options.quick else SECONDS):
                    runs += 1
                    run(WARM + runs)
                used = (time.process_time() - start) / runs
                perf.send_signal(signal.SIGINT)
                perf.wait()
                samples, total = samples_of(folder / "record", folder / "cache")
                report.table(f"{case}, {what}: {used:.3f} s of a processor", [{"of": "all", **shares(samples, total)}])
                groups, inclusive = collections.defaultdict(list), collections.defaultdict(list)
                for sample in samples:
                    groups[phase(sample.functions, makers)].append(sample)
                    for function in set(sample.functions):
                        inclusive[function].append(sample)
                for title, found in (("phases", groups), ("functions with those that they call", inclusive)):
                    rows = [{"of": key, **shares(those, total)} for key, those in found.items()]
                    rows.sort(key=lambda row: -row["%"])
                    report.table(f"{case}, {what}: {title}", rows[: options.functions])


if __name__ == "__main__":
    main()

"""What the benchmarks share: machine and versions, timing in turns, statistics, tables and JSON lines."""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import warp as wp
from scipy import stats

ROOT = Path(__file__).resolve().parents[2]
if (ROOT / "pyproject.toml").is_file():
    sys.path.insert(0, str(ROOT))  # a checkout that is not installed

import warp_psdr as psdr  # noqa: E402

wp.config.log_level = wp.LOG_WARNING  # tables, not a line per module

#: Seconds between two measurements: Dr.Jit's threads spin for a while after their work.
SETTLE = 0.05


def arguments(description: str) -> argparse.ArgumentParser:
    """Return a parser with the options of every benchmark."""
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small images and few repetitions, under two minutes")
    parser.add_argument("--repeat", type=int, help="timed repetitions; default: 7, quick: 5")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)), help="threads for both renderers")
    parser.add_argument("--output", type=Path, help="append the results to this file, one JSON object a line")
    return parser


def import_mitsuba(threads: int):
    """Return (mitsuba, drjit) in the variant that is compared against.

    Raises:
        SystemExit: Mitsuba is not installed.
    """
    try:
        import drjit
        import mitsuba
    except ImportError as error:
        raise SystemExit(
            f"{error}: this benchmark compares with Mitsuba 3.9.1; pip install 'warp-psdr[bench]'"
        ) from None
    try:
        mitsuba.set_variant("llvm_ad_rgb")
    except Exception as error:
        raise SystemExit(f"Mitsuba's variant llvm_ad_rgb does not start: {error}; install libllvm19") from None
    drjit.set_thread_count(threads)
    return mitsuba, drjit


def machine() -> dict:
    """Return the machine, the versions and the commit."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        cpu = names[0].partition(":")[2].strip() if names else cpu
    commit = "unknown"
    if (ROOT / ".git").exists():
        command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=12"]
        commit = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() or commit
    result = {
        "cpu": cpu,
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "warp_psdr": psdr.__version__,
        "warp": wp.__version__,
        "commit": commit,
        "load": os.getloadavg()[0],
    }
    if "mitsuba" in sys.modules:
        result["mitsuba"] = sys.modules["mitsuba"].__version__
    return result


class Seconds(NamedTuple):
    """Wall time and processor time of all threads, as another process measured them."""

    wall: float
    cpu: float


def in_turns(functions: dict, repeat: int) -> dict[str, dict[str, list[float]]]:
    """Time functions in turns after one warm-up each; one that returns ``Seconds`` is not timed.

    Returns:
        name -> {"wall": seconds, "cpu": processor seconds of all threads}, one entry a repetition.
    """
    result = {name: {"wall": [], "cpu": []} for name in functions}
    for repetition in range(repeat + 1):
        for name, function in functions.items():
            time.sleep(SETTLE)
            wall, cpu = time.perf_counter(), time.process_time()
            found = function(repetition)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            if isinstance(found, Seconds):
                wall, cpu = found
            if repetition:
                result[name]["wall"].append(wall)
                result[name]["cpu"].append(cpu)
    return result


def ratio(times: dict, numerator: str, denominator: str, clock: str = "wall") -> float:
    """Median over the repetitions of the ratio of two times."""
    pairs = zip(times[numerator][clock], times[denominator][clock], strict=True)
    return statistics.median(a / b for a, b in pairs)


def median(times: dict, name: str, clock: str = "wall") -> float:
    """Median time in seconds."""
    return statistics.median(times[name][clock])


def z_test(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """Compare two sets of independent samples, shape (n, values) or (n, values, channels).

    Student's t of every value is mapped to the normal deviate of equal probability.

    Returns:
        ``max_z`` over all values; ``limit``, which it exceeds once in 1,000 comparisons of equal means; ``p``, of the
        sum of squares of the channel means (channels are correlated, blocks are not).
    """

    def deviates(a, b):
        va, vb = a.var(axis=0, ddof=1) / len(a), b.var(axis=0, ddof=1) / len(b)
        v = np.maximum(va + vb, 1e-30)
        degrees = v**2 / np.maximum(va**2 / (len(a) - 1) + vb**2 / (len(b) - 1), 1e-60)
        t = (a.mean(axis=0) - b.mean(axis=0)) / np.sqrt(v)
        used = v > 1e-20
        z = stats.norm.isf(stats.t.sf(np.abs(t), np.maximum(degrees, 1.0)))
        return np.where(used, z, 0.0), used

    z, used = deviates(a, b)
    mean_z, mean_used = deviates(a.mean(axis=-1), b.mean(axis=-1)) if a.ndim == 3 else (z, used)
    count = max(int(used.sum()), 1)
    return {
        "max_z": float(np.max(z)),
        "limit": float(stats.norm.isf(0.5e-3 / count)),
        "p": float(stats.chi2.sf((mean_z**2).sum(), max(int(mean_used.sum()), 1))),
    }


def blocks(images: np.ndarray, count: int) -> np.ndarray:
    """Average to ``count`` x ``count`` blocks: (n, H, W, 3) to (n, count^2, 3)."""
    n, h, w, c = images.shape
    return images.reshape(n, count, h // count, count, w // count, c).mean(axis=(2, 4)).reshape(n, -1, c)


def markdown(title: str, rows: list[dict]) -> None:
    """Print rows of equal keys as a Markdown table; floats in three digits."""
    if not rows:
        return
    names = list(rows[0])
    print(f"### {title}\n")
    print("| " + " | ".join(names) + " |\n|" + "---|" * len(names))
    for row in rows:
        print("| " + " | ".join(_text(row[k]) for k in names) + " |")
    print(flush=True)


class Report:
    """Prints Markdown tables and appends JSON lines."""

    def __init__(self, benchmark: str, output: Path | None):
        self._benchmark, self._output = benchmark, output
        self._machine = machine()
        m = self._machine
        versions = ", ".join(f"{k} {m[k]}" for k in ("python", "warp", "warp_psdr", "mitsuba") if k in m)
        print(f"## {benchmark}\n\n{m['cores']} cores of {m['cpu']}; {versions}; commit {m['commit']}\n", flush=True)

    def table(self, title: str, rows: list[dict]) -> None:
        """Print rows of equal keys; floats in four digits."""
        if not rows:
            return
        markdown(title, rows)
        if self._output is not None:
            with open(self._output, "a", encoding="utf-8") as file:
                for row in rows:
                    record = {"benchmark": self._benchmark, "table": title, **row, "machine": self._machine}
                    file.write(json.dumps(record) + "\n")


def _text(value) -> str:
    if isinstance(value, bool):
        return "yes" if value else "**no**"
    return "" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)

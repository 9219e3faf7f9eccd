"""Measurements of the work-precision benchmark: kept one a line, and what is derived from them.

*Error of a run.* I is an image (or a derivative image, or a gradient) of one run, R the mean of m independent long
images of the same renderer, R_i. Both have the same expectation when the method is unbiased, so

    E mean((I - R)^2) = V[I] + V[R],    V[R] estimated without bias by  mean(sum_i (R_i - R)^2) / (m (m - 1)),

and mean((I - R)^2) - V[R] is an unbiased estimate of the squared error of the run, whatever the noise of the reference.
It is divided by the reference's power, mean(R^2) - V[R], the square of its root mean square without the noise's part.
Single runs can come out below zero where the reference is noisier than the run; medians over the repetitions are shown.

*Difference of two references*, A of m images and B of n, of independent seeds: mean((A - B)^2) - V[A] - V[B], unbiased
for the squared distance of their expectations. A closed form is a reference of one image without noise; the difference
to it is the *floor*: what remains of the error however many samples are taken.

*Slope* of A on finite differences F: mean(A F) / (mean(F^2) - V[F]), one where A is the derivative. Standard errors are
the jackknife's, leaving out one long image after the other, summed over the independent sets of images.
"""

import json
import os
import statistics
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

#: A derivative is called wrong when its slope is farther from one than this, or when its distance to finite
#: differences (relative, squared) is larger, both by SIGMAS standard errors. The distance has to hold the error of the
#: finite differences, which is of second order in the step, too.
SLOPE_TOLERANCE, DISTANCE_TOLERANCE, SIGMAS = 0.03, 0.15**2, 3.0
#: What tells one measurement from another.
KEY = ("kind", "case", "method", "spp", "repeat", "pixels")


class Records:
    """JSON lines of finished measurements; what is there is not measured again.

    Args:
        file: of the lines.
        key: names that tell one measurement from another.
    """

    def __init__(self, file: Path, key: tuple[str, ...] = KEY):
        self.file, self._key = file, key
        self.rows: list[dict] = []
        if file.is_file():
            text = file.read_bytes()
            whole = text[: text.rfind(b"\n") + 1]
            if len(whole) < len(text):  # the line that an interrupted run left unfinished
                with open(file, "r+b") as stream:
                    stream.truncate(len(whole))
            self.rows = [json.loads(line) for line in whole.splitlines() if line.strip()]
        self._keys = {self._of(row) for row in self.rows}

    def __contains__(self, row: dict) -> bool:
        """Whether a measurement of this key is finished."""
        return self._of(row) in self._keys

    def append(self, row: dict) -> None:
        """Add a measurement: one write of one line, so that readers and an interruption see all of it or nothing."""
        line = (json.dumps(row) + "\n").encode()
        self.file.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(self.file, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            os.write(handle, line)
            os.fsync(handle)
        finally:
            os.close(handle)
        self.rows.append(row)
        self._keys.add(self._of(row))

    def _of(self, row: dict) -> tuple:
        return tuple(row.get(name) for name in self._key)


@dataclass(frozen=True)
class Reference:
    """Long images of one renderer.

    Attributes:
        images: (m, ...); m = 1: exact.
    """

    images: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Their mean."""
        return self.images.mean(axis=0, dtype=np.float64)

    @property
    def noise(self) -> float:
        """Variance of the mean, averaged over its values; unbiased."""
        m = len(self.images)
        return float(self.images.var(axis=0, ddof=1, dtype=np.float64).mean() / m) if m > 1 else 0.0

    @property
    def power(self) -> float:
        """Mean square without the noise's part.

        Raises:
            ValueError: the images are all noise.
        """
        if self.blank:
            raise ValueError(f"the reference is all noise: variance {self.noise:.3g}; take more samples")
        return float((self.mean**2).mean()) - self.noise

    @property
    def blank(self) -> bool:
        """Whether there is nothing but noise, or nothing at all, in it."""
        return float((self.mean**2).mean()) <= self.noise

    def without(self, i: int) -> "Reference":
        """All but one image."""
        return Reference(np.delete(self.images, i, axis=0))


def squared_error(image: np.ndarray, reference: Reference) -> float:
    """Squared error of one run, relative to the reference's mean square."""
    return (float(((image - reference.mean) ** 2).mean()) - reference.noise) / reference.power


def squared_difference(a: Reference, b: Reference) -> float:
    """Squared distance of two references, relative to the mean square of ``b``."""
    return (float(((a.mean - b.mean) ** 2).mean()) - a.noise - b.noise) / b.power


def slope(a: Reference, differences: Reference) -> float:
    """Slope of a regression on finite differences, without the bias that their noise brings."""
    return float((a.mean * differences.mean).mean()) / differences.power


def jackknife(function: Callable[..., float], *sets: Reference) -> tuple[float, float]:
    """Return function(*sets) and its standard error; sets of one image are exact."""
    variance = 0.0
    for i, s in enumerate(sets):
        m = len(s.images)
        if m > 1:
            parts = [function(*sets[:i], s.without(j), *sets[i + 1 :]) for j in range(m)]
            variance += (m - 1) * float(np.var(parts))
    return function(*sets), variance**0.5


def root_text(squared: float, error: float) -> str:
    """Text of a root of an estimate with a standard error: a number, or what it is below of with two errors."""
    if squared > 2.0 * error:
        return f"{squared**0.5:.2g}"
    return f"< {(max(squared, 0.0) + 2.0 * error) ** 0.5:.1g}"


def bias(a: Reference, b: Reference) -> float:
    """Relative difference of the means over all values."""
    return float(a.mean.mean() / b.mean.mean()) - 1.0


def verdict(a: Reference, differences: Reference) -> str:
    """What finite differences say about a derivative: its slope on them, and "wrong" where it is not that derivative.

    The slope alone does not tell: where a renderer misses edges of either sign, it can be one.
    """
    value, error = jackknife(slope, a, differences)
    distance, distance_error = jackknife(squared_difference, a, differences)
    text = f"slope {value:.2f} ± {error:.2f}" if error >= 0.005 else f"slope {value:.3f}"
    if distance > DISTANCE_TOLERANCE + SIGMAS * distance_error:
        return f"**wrong** ({text}, {100.0 * distance**0.5:.0f} % away)"
    if abs(value - 1.0) > SLOPE_TOLERANCE + SIGMAS * error:
        return f"**wrong** ({text})"
    return text if SIGMAS * error <= SLOPE_TOLERANCE else f"{text}: too noisy to tell"


def summary(rows: list[dict]) -> list[dict]:
    """Return one row a (case, method, sample count), in the order of measurement.

    Returns:
        ``seconds``, ``error`` (signed root of the median squared error), ``work`` (seconds x error^2) and, where all
        runs have it, ``cores`` (busy ones): medians.
    """
    groups = defaultdict(list)
    for row in rows:
        if row["kind"] == "run":
            groups[row["case"], row["method"], row["spp"], row["pixels"]].append(row)
    result = []
    for (case, method, spp, pixels), runs in groups.items():
        squared = statistics.median(r["squared_error"] for r in runs)
        result.append(
            {
                "case": case,
                "method": method,
                "spp": spp,
                "pixels": pixels,
                "runs": len(runs),
                "seconds": statistics.median(r["seconds"] for r in runs),
                "error": float(np.sign(squared) * abs(squared) ** 0.5),
                "work": statistics.median(r["seconds"] * r["squared_error"] for r in runs),
            }
        )
        if all(r.get("cores") is not None for r in runs):
            result[-1]["cores"] = statistics.median(r["cores"] for r in runs)
    return result


def gains(rows: list[dict], case: str, baseline: Callable[[str], bool]) -> list[dict]:
    """Return one row a method of a case: its largest sample count, and the ratio of times at equal error.

    Args:
        rows: of `summary`.
        case: which.
        baseline: method -> whether it is one to be compared with; the ratio is the least work of these over the own.
    """
    largest: dict[str, dict] = {}
    for row in rows:
        if row["case"] == case and row["spp"] >= largest.get(row["method"], row)["spp"]:
            largest[row["method"]] = row
    base = [r["work"] for m, r in largest.items() if baseline(m) and r["work"] > 0.0]
    return [row | {"gain": min(base) / row["work"] if base and row["work"] > 0.0 else None} for row in largest.values()]

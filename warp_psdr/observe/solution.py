"""What ``psdr.solve`` returns: values with error bars."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from warp_psdr import html

__all__ = ["Solution", "Step"]

#: Directions that a table shows at most.
SHOWN = 3
#: Gain ratio below which a step is not taken.
TAKEN = 0.02
#: Share of the largest part of a direction from which on a part is named.
NAMED = 0.3


@dataclass(frozen=True)
class Step:
    """One step of ``solve``.

    Attributes:
        number: from 0.
        spp: samples a pixel of its derivative images.
        before, after: weighted sums of squared residuals, the sampling noise of images left out.
        gain: how much of the promised decrease came true; below .02 the step was not taken.
        damping: over the diagonal of the normal equations.
        values: all unknown numbers after it.
    """

    number: int
    spp: int
    before: float
    after: float
    gain: float
    damping: float
    values: np.ndarray

    def __str__(self) -> str:
        kind = "taken" if self.gain >= TAKEN else "not taken"
        return f"step {self.number}: residual {self.before:.6g} -> {self.after:.6g}, {kind}, damping {self.damping:.1e}"


@dataclass(frozen=True)
class Solution:
    """Values that ``solve`` found, and how sure they are.

    Attributes:
        labels: (n,) names of the numbers.
        values: (n,); rigid motions since the start.
        sampling: (n, n) covariance of the random numbers of rendering.
        residuals: (n, n) covariance of what the photographs have and the scene lacks, from blocks of pixels
            (a sandwich estimate).
        doubts: (n, n) of a response of another exponent, and of light that is brighter on one side: the squared shift
            of the values if these were unknown, too.
        freedom: degrees of freedom of ``residuals``: blocks of equal say, less one.
        block: edge of the blocks, pixels, those that give the widest bars.
        rms: of the residuals, in code values of the photographs.
        steps: how the solver went.
        reason: why it stopped.
        undetermined: directions that no picture tells, as texts.
    """

    labels: tuple[str, ...]
    values: np.ndarray
    sampling: np.ndarray
    residuals: np.ndarray
    doubts: np.ndarray
    freedom: int
    block: int
    rms: float
    steps: tuple[Step, ...] = field(repr=False)
    reason: str = ""
    undetermined: tuple[str, ...] = ()

    @property
    def covariance(self) -> np.ndarray:
        """(n, n), of all causes."""
        return self.sampling + self.residuals + self.doubts

    @property
    def std(self) -> np.ndarray:
        """(n,) standard deviations; infinite where the pictures do not tell a number."""
        return np.sqrt(np.diag(self.covariance))

    def interval(self, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper ends of bars that hold the true values with a probability, each by itself."""
        factor = stats.t.ppf(0.5 + 0.5 * level, max(self.freedom, 1))
        return self.values - factor * self.std, self.values + factor * self.std

    @property
    def directions(self) -> list[tuple[float, np.ndarray]]:
        """Standard deviation and unit vector (numbers over their own deviations) of each direction, softest first."""
        std = self.std
        if not np.all(np.isfinite(std)):
            return []
        scale = np.where(std > 0.0, std, 1.0)
        sizes, axes = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        return [(float(np.sqrt(max(sizes[i], 0.0))), axes[:, i]) for i in range(len(sizes))[::-1]]

    def rows(self) -> list[tuple[str, str, str]]:
        """Return the table's rows: name, value, 95 % bar."""
        low, high = self.interval()
        bars = 0.5 * (high - low)
        return [
            (label, f"{value:.6g}", f"± {bar:.2g}")
            for label, value, bar in zip(self.labels, self.values, bars, strict=True)
        ]

    def __str__(self) -> str:
        rows = self.rows()
        widths = [max(len(row[i]) for row in rows) for i in range(2)]
        lines = [f"{a:<{widths[0]}}  {b:>{widths[1]}}  {c}" for a, b, c in rows]
        end = f"{len(self.steps)} steps: {self.reason}; residual {self.rms:.3g} rms; "
        end += f"95 % bars, blocks of {self.block} pixels"
        return "\n".join([*lines, end, *(f"not determined: {text}" for text in self.undetermined)])

    def _repr_html_(self) -> str:
        return html.table(("", "value", "95 %"), self.rows())


def that_matter(direction: np.ndarray) -> np.ndarray:
    """Return a mask of the parts of a direction that matter."""
    return np.abs(direction) >= NAMED * np.abs(direction).max()


def described(direction: np.ndarray, labels: list[str]) -> str:
    """Name the largest parts of a direction."""
    matter = that_matter(direction)
    parts = [i for i in np.argsort(-np.abs(direction)) if matter[i]][:SHOWN]
    sign = np.sign(direction[parts[0]])
    return " together with ".join(f"{'+' if sign * direction[i] > 0 else '-'}{labels[i]}" for i in parts)

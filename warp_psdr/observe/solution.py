"""What ``psdr.solve`` returns: values with error bars."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from warp_psdr import html
from warp_psdr.observe.unknowns import Unknowns, pushed

if TYPE_CHECKING:
    from warp_psdr.scene.parameters import Parameters

__all__ = ["Errors", "Solution", "Step"]

#: Directions that a table shows at most.
SHOWN = 3
#: Numbers that it lists at most.
ROWS = 24
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
class Errors:
    """How sure the values of a solution are.

    Attributes:
        sampling: (n, n) covariance of the random numbers of rendering.
        residuals: (n, n) covariance of what the photographs have and the scene lacks, from blocks of pixels
            (a sandwich estimate), and from whole photographs if there are at least four.
        doubts: (n, n) of a response of another exponent, and of light that is brighter on one side: the squared shift
            of the values if these were unknown, too.
        freedom: (n,) degrees of freedom of ``residuals``: blocks of equal say, less one.
        block: edge of the blocks, pixels, those that give the widest bars.
        undetermined: (text, unit vector) of the directions that no picture tells.
    """

    sampling: np.ndarray
    residuals: np.ndarray
    doubts: np.ndarray
    freedom: np.ndarray
    block: int
    undetermined: tuple[tuple[str, np.ndarray], ...]

    @property
    def noisiest(self) -> float:
        """The largest sampling variance of a number over its variance by residuals; infinite if some are not told."""
        if self.undetermined:
            return float("inf")
        return float((np.diag(self.sampling) / np.maximum(np.diag(self.residuals), 1e-300)).max())


@dataclass(frozen=True)
class Solution:
    """Values that ``solve`` found, and how sure they are.

    Attributes:
        labels: (n,) names of the numbers.
        values: (n,); rigid motions since the start.
        errors: how sure they are, by causes; None of conjugate gradients, which have no error bars.
        rms: of the residuals, in code values of the photographs.
        steps: how the solver went.
        reason: why it stopped.
        unknowns: kinds of the numbers, in order; a photograph's own follow them.
    """

    labels: tuple[str, ...]
    values: np.ndarray
    errors: Errors | None = field(repr=False)
    rms: float
    steps: tuple[Step, ...] = field(repr=False)
    reason: str
    unknowns: tuple[Unknowns, ...] = field(repr=False)

    def _known(self) -> Errors:
        if self.errors is None:
            raise ValueError(
                "solution: conjugate gradients give no error bars; solve for up to 512 numbers, for example by "
                "psdr.unknowns.Function, or for some of them beside fixed ones"
            )
        return self.errors

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Directions that no picture tells, as texts; none are sought by conjugate gradients."""
        return tuple(text for text, _direction in self.errors.undetermined) if self.errors else ()

    @property
    def covariance(self) -> np.ndarray:
        """(n, n), of all causes.

        Raises:
            ValueError: there are no error bars.
        """
        known = self._known()
        return known.sampling + known.residuals + known.doubts

    @property
    def std(self) -> np.ndarray:
        """(n,) standard deviations; infinite where the pictures do not tell a number.

        Raises:
            ValueError: there are no error bars.
        """
        return np.sqrt(np.diag(self.covariance))

    def interval(self, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper ends of bars that hold the true values with a probability, each by itself.

        Raises:
            ValueError: there are no error bars.
        """
        factor = stats.t.ppf(0.5 + 0.5 * level, np.maximum(self._known().freedom, 1))
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

    def motion(self, params: Parameters, direction: int = 0) -> dict[str, np.ndarray]:
        """Return how parameters move by one standard deviation along a direction: what the pictures tell least.

        ``psdr.view(scene, params, fields=found.motion(params))`` draws it, if positions or shapes' poses are unknown.

        Args:
            params: of the scene.
            direction: its place in ``directions``, softest first.

        Returns:
            Name -> change, in the parameter's shape.

        Raises:
            ValueError: there are no error bars, or they are infinite.
            IndexError: there are fewer directions.
        """
        if not (found := self.directions):
            raise ValueError(f"solution: the pictures do not tell {' and '.join(self.undetermined)}; fix one of them")
        size, axis = found[direction]
        return pushed(self.unknowns, params, size * axis * self.std)

    def rows(self) -> list[tuple[str, str, str]]:
        """Return the table's rows: name, value, 95 % bar; the first 24."""
        bars = ["" for _label in self.labels]
        if self.errors is not None:
            low, high = self.interval()
            bars = [f"± {bar:.2g}" for bar in 0.5 * (high - low)]
        found = [(a, f"{b:.6g}", c) for a, b, c in zip(self.labels, self.values, bars, strict=True)][:ROWS]
        more = len(self.labels) - len(found)
        return [*found, (f"{more} more", "", "")] if more else found

    def __str__(self) -> str:
        rows = self.rows()
        widths = [max(len(row[i]) for row in rows) for i in range(2)]
        lines = [f"{a:<{widths[0]}}  {b:>{widths[1]}}  {c}" for a, b, c in rows]
        end = f"{len(self.steps)} steps: {self.reason}; residual {self.rms:.3g} rms; "
        end += f"95 % bars, blocks of {self.errors.block} pixels" if self.errors else "no error bars"
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

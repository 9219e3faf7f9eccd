"""What follows edits of media: majorants of grids, integrals of tables of phase functions, checks of microflakes.

A majorant is the largest value in a cell of 8^3 voxels (``kernels/medium/majorant.py``).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import warp as wp

from warp_psdr.kernels.medium.majorant import CELL

if TYPE_CHECKING:
    from .layout import Parameter

#: Neighbours of the first and of the last voxel along an axis, by wrap mode, as NumPy pads.
_PADDING = {"clamp": "edge", "repeat": "wrap", "mirror": "symmetric"}
#: Least eigenvalue of a matrix of microflakes, relative to the largest: below, float32 finds it singular.
_FLATTEST = 1e-5
#: What rounding can add to an interpolated value, relative.
_ROUNDING = 1e-6


def super_grid(values: np.ndarray, wrap: str) -> np.ndarray:
    """Return the majorants, flat float32, x fastest, of a grid (Z, Y, X, C).

    Interpolation in a cell reads its own voxels, and one more on each side.
    """
    most = np.pad(values.max(axis=3), 1, mode=_PADDING[wrap])  # type: ignore[call-overload]
    for axis in range(3):
        size = most.shape[axis] - 2
        starts = np.arange(0, size, CELL)
        ends = np.minimum(starts + CELL, size) + 2
        cells = [np.take(most, range(a, b), axis=axis).max(axis=axis) for a, b in zip(starts, ends, strict=True)]
        most = np.stack(cells, axis=axis)
    return (most * (1.0 + _ROUNDING)).astype(np.float32).reshape(-1)


@dataclass(frozen=True)
class SuperGrid:
    """Where a grid and its majorants are."""

    parameter: str
    offset: int  #: flat, of the grid
    shape: tuple[int, int, int, int]  #: (Z, Y, X, C)
    wrap: str
    majorants: int  #: flat offset

    @property
    def voxels(self) -> tuple[int, ...]:
        """Number of voxels along x, y, z."""
        return self.shape[2::-1]

    @property
    def cells(self) -> tuple[int, ...]:
        """Number of cells along x, y, z."""
        return tuple(-(-n // CELL) for n in self.voxels)

    def rebuild(self, values: wp.array, held: np.ndarray) -> None:
        """Write the majorants of the values that are held, flat, on the host."""
        grid = held[self.offset : self.offset + int(np.prod(self.shape))].reshape(self.shape)
        majorants = super_grid(grid, self.wrap)
        values[self.majorants : self.majorants + majorants.size].assign(majorants)


def integrals(values: np.ndarray) -> np.ndarray:
    """Return the integrals from -1 to each of the cosines of a table (N,), float32, by straight lines."""
    between = (values[:-1].astype(np.float64) + values[1:]) / (values.size - 1)
    return np.concatenate([[0.0], np.cumsum(between)]).astype(np.float32)


@dataclass(frozen=True)
class PhaseTable:
    """Where the values of a phase function and their integrals are."""

    parameter: str
    offset: int  #: flat, of the values
    size: int
    integrals: int  #: flat offset

    def rebuild(self, values: wp.array, held: np.ndarray) -> None:
        """Write the integrals of the values that are held, flat, on the host.

        Raises:
            ValueError: all values are 0.
        """
        table = held[self.offset : self.offset + self.size]
        if not table.any():
            raise ValueError(f"{self.parameter} holds zeros alone after an edit; write a value above 0")
        values[self.integrals : self.integrals + self.size].assign(integrals(table))


def not_definite(values: np.ndarray) -> str:
    """Return what is wrong with the matrix of microflakes of six numbers (S_xx, S_yy, S_zz, S_xy, S_xz, S_yz)."""
    if not np.isfinite(values).all():
        return "the matrix holds NaN or infinite numbers"
    xx, yy, zz, xy, xz, yz = values.astype(np.float64).reshape(6)
    least, _middle, most = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return "" if least > _FLATTEST * most else f"the matrix has eigenvalues from {least:.3g} to {most:.3g}"


@dataclass(frozen=True)
class FlakeCheck:
    """Where the matrix of microflakes is."""

    parameter: str
    offset: int  #: flat

    def rebuild(self, values: wp.array, held: np.ndarray) -> None:
        """Check the values that are held, flat, on the host.

        Raises:
            ValueError: they are not positive definite.
        """
        problem = not_definite(held[self.offset : self.offset + 6])
        if problem:
            raise ValueError(f"{self.parameter}: after an edit {problem}; write a positive definite one")


class Follower(Protocol):
    """What follows a parameter."""

    @property
    def parameter(self) -> str:
        """The parameter's name."""

    def rebuild(self, values: wp.array, held: np.ndarray) -> None:
        """Follow the values that are held, flat, on the host."""


def rebuild(followers: Iterable[Follower], changed: Iterable[Parameter], values: wp.array, held: np.ndarray) -> None:
    """Let what follows values follow the parameters that have changed."""
    names = {p.name for p in changed}
    for follower in followers:
        if follower.parameter in names:
            follower.rebuild(values, held)

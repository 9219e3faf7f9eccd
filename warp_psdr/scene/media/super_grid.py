"""Values that follow edits of media: majorants of grids, integrals of tables of phase functions, checks of microflakes.

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
    from warp_psdr.scene.layout import Parameter

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
    return (pooled(values, wrap).max(axis=3) * (1.0 + _ROUNDING)).astype(np.float32).reshape(-1)


def pooled(values: np.ndarray, wrap: str, largest: np.ufunc = np.maximum) -> np.ndarray:
    """Return the largest value in each cell of a grid (Z, Y, X, C), and in the voxels around it, of each channel.

    ``largest``: or the least, by ``np.minimum``.
    """
    for axis in range(3):
        size = values.shape[axis]
        voxels = np.pad(np.arange(size), 1, mode=_PADDING[wrap])  # type: ignore[call-overload]
        starts = np.arange(0, size, CELL)
        ends = np.minimum(starts + CELL, size) + 2
        cells = [
            largest.reduce(np.take(values, voxels[a:b], axis=axis), axis=axis)
            for a, b in zip(starts, ends, strict=True)
        ]
        values = np.stack(cells, axis=axis)
    return values


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


def flake_areas(values: np.ndarray) -> tuple[float, str]:
    """Return the largest projected area of microflakes, over all directions, and what is wrong with their matrices.

    Args:
        values: (6,) or (Z, Y, X, 6): S_xx, S_yy, S_zz, S_xy, S_xz, S_yz.
    """
    matrices = values.astype(np.float64).reshape(-1, 6)[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3)
    finite: np.ndarray = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    eigenvalues = np.linalg.eigvalsh(np.where(finite[:, None, None], matrices, np.eye(3)))
    least, most = eigenvalues[:, 0], eigenvalues[:, 2]
    wrong = np.flatnonzero(~finite | (least <= _FLATTEST * most))
    if not wrong.size:
        return float(np.sqrt(most.max()) * (1.0 + 10.0 * _ROUNDING)), ""
    i = wrong[0]
    which = "the matrix"
    if len(matrices) > 1:
        which = f"the matrix of voxel {tuple(int(n) for n in np.unravel_index(i, values.shape[:3]))} (z, y, x)"
    if not finite[i]:
        return 0.0, f"{which} holds NaN or infinite numbers"
    return 0.0, f"{which} has eigenvalues from {least[i]:.3g} to {most[i]:.3g}"


@dataclass(frozen=True)
class FlakeCheck:
    """Where the matrices of microflakes are."""

    parameter: str
    offset: int  #: flat
    shape: tuple[int, ...]  #: (6,) or (Z, Y, X, 6)
    most: int = -1  #: flat offset of the largest projected area of a grid

    def rebuild(self, values: wp.array, held: np.ndarray) -> None:
        """Check the values that are held, flat, on the host, and write how large their areas are.

        Raises:
            ValueError: some matrix is not positive definite.
        """
        size = int(np.prod(self.shape))
        most, problem = flake_areas(held[self.offset : self.offset + size].reshape(self.shape))
        if problem:
            raise ValueError(f"{self.parameter}: after an edit {problem}; write a positive definite one")
        if self.most >= 0:
            values[self.most : self.most + 1].assign(np.array([most], np.float32))


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

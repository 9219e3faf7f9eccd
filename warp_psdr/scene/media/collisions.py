"""How many tentative collisions a flight through a tracked medium may take, which is what it costs.

Tracking draws them at the rate of a cell's largest value (``kernels/medium/majorant.py``), so that one dense voxel in
thin smoke costs as many null collisions as its value times the cell's length. Where the medium is as dense everywhere,
the first of them is a real one, and ends the flight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psdr.kernels.medium.majorant import CELL
from warp_psdr.scene.media.super_grid import SuperGrid, pooled

#: Seconds of a tentative collision on a CPU, about.
_SECONDS = 1e-8


def null_collisions(
    values: np.ndarray, wrap: str, factor: float, to_world: np.ndarray, extent: float, enough: float
) -> float:
    """Return how many null collisions a flight has at most, about; a bound of it where that is ``enough`` or less.

    Args:
        values: (Z, Y, X, C) of the grid.
        wrap: What lies beyond its ends.
        factor: What multiplies it.
        to_world: (4, 4) from the unit cube that it fills.
        extent: Of the scene: no flight is longer.
        enough: So many are no matter.
    """
    # Along the axes z, y and x of the grid.
    lengths = np.linalg.norm(to_world[:3, :3].astype(np.float64), axis=0)[::-1]
    bound = factor * float(values.max()) * min(float(lengths.sum()), extent)
    if bound <= enough:  # nothing more has to be looked at
        return bound
    spread = pooled(values, wrap).max(axis=3).astype(np.float64) - pooled(values, wrap, np.minimum).min(axis=3)
    along = 0.0
    for axis, length in enumerate(lengths):
        count = values.shape[axis]
        voxels = np.minimum(count - np.arange(0, count, CELL), CELL)
        along = max(along, float((np.moveaxis(spread, axis, -1) @ (voxels * length / count)).max()))
    return factor * min(along, float(spread.max()) * extent)


def area_of(flakes: np.ndarray) -> float:
    """Return a bound of the projected areas of microflakes, up to sqrt(3) too large; ``flakes``: (..., 6)."""
    return float(np.sqrt(flakes[..., :3].astype(np.float64).sum(axis=-1).max()))


@dataclass(frozen=True)
class Tracking:
    """What decides how long flights through a tracked medium take; follows one of the parameters ``follows``."""

    parameter: str
    medium: str  #: its name
    super_grid: SuperGrid
    scale: int  #: flat offset
    pose: int  #: flat offset; -1: it is no parameter
    to_world: np.ndarray  #: (4, 4) where it is none
    flakes: tuple[int, int]  #: flat offset and size of the matrices of microflakes; size 0: there are none
    extent: float  #: of the scene
    most: float  #: tentative collisions that a flight may take

    def check(self, held: np.ndarray, after: str = "") -> None:
        """Raise if flights take too long with the values that are held, flat, on the host.

        Raises:
            ValueError: With what it would cost.
        """
        offset, shape = self.super_grid.offset, self.super_grid.shape
        values = held[offset : offset + int(np.prod(shape))].reshape(shape)
        factor = float(held[self.scale])
        first, size = self.flakes
        if size:
            factor *= area_of(held[first : first + size].reshape(-1, 6))
        to_world = self.to_world if self.pose < 0 else held[self.pose : self.pose + 16].reshape(4, 4)
        count = null_collisions(values, self.super_grid.wrap, factor, to_world, self.extent, self.most)
        if count > self.most:
            largest = float(values.max()) * factor
            raise ValueError(too_many(self.medium, self.super_grid.parameter, largest, count, after))

    def rebuild(self, values: wp.array, held: np.ndarray) -> None:
        """Check the values that are held; see ``check``."""
        self.check(held, " after an edit")


def too_many(medium: str, parameter: str, largest: float, count: float, after: str = "") -> str:
    """Return the message for a medium whose flights have too many collisions."""
    return (
        f"'{medium}': a ray through it takes up to {count:.2g} tentative collisions{after}, some "
        f"{count * _SECONDS:.2g} s for each path, which nothing interrupts: '{parameter}' reaches an extinction of "
        f"{largest:.3g} beside far thinner places; lower its largest values, or load the scene with max_collisions="
        f"{2.0 * count:.0e} (--max-collisions) to wait for it"
    )

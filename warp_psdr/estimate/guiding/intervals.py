"""Intervals of items (of grids, networks and curves) along the first coordinate of a cube, kept as the shape changes.

Cells are boxes of coordinates, so an item keeps its masses if it keeps its interval. When the surface reaches another
voxel, this voxel shares the interval of the item before it in the order. When the surface leaves a voxel, the item
before it takes the interval over. Every item thus has an interval, and the density of a point is always known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Intervals:
    """Items in ascending order of their names.

    Attributes:
        names: (n,) int64.
        cdf: (n + 1,) where their intervals begin, from 0 to 1.
    """

    names: np.ndarray
    cdf: np.ndarray


@dataclass(frozen=True, eq=False)
class Listing:
    """Items of a technique.

    Attributes:
        names: (n,) int64, which stay the same from step to step and are near to each other where items are.
        weight: (n,) how long their intervals are in the beginning, relative to each other.
    """

    names: np.ndarray
    weight: np.ndarray

    def order(self) -> np.ndarray:
        """Return the numbers of the items in the order of their intervals."""
        return np.argsort(self.names, kind="stable")


def begin(listing: Listing) -> Intervals:
    """Return intervals as long as the items' weights say."""
    order = listing.order()
    sums = np.append(0.0, np.cumsum(listing.weight[order]))
    return Intervals(listing.names[order], sums / max(sums[-1], 1e-300))


def follow(old: Intervals, listing: Listing) -> Intervals | None:
    """Return the intervals of what is there now; None: nothing is left of what was there."""
    names = np.sort(listing.names)
    place = np.minimum(np.searchsorted(old.names, names), max(len(old.names) - 1, 0))
    if not len(names) or not len(old.names):
        return None
    kept = old.names[place] == names
    if not kept.any():
        return None
    # Every item belongs to the last kept one that is not behind it; those in front of all of them to the first.
    group = np.maximum(np.cumsum(kept) - 1, 0)
    starts = old.cdf[place[kept]]
    starts[0] = 0.0
    ends = np.append(starts[1:], 1.0)
    size = np.bincount(group)
    first = np.append(0, np.cumsum(size))[group]
    rank = np.arange(len(names)) - first
    low = starts[group] + (ends - starts)[group] * (rank / size[group])
    return Intervals(names, np.append(low, 1.0))

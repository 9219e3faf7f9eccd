"""Guiding by an octree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_psdr.estimate.guiding.build import QUANTUM, Growth, Leaves, Target, edge_slabs
from warp_psdr.estimate.guiding.methods import Method

#: Share of the leaves with which the cube is cut along the edges, and up to which seeds may ask for more; the rest is
#: for what is measured. An octree of the whole cube would cut directions as finely as edges, of which there are many.
SLABS, SEEDED = 0.25, 0.5
#: A leaf is split by its seeds while it holds at least this many.
SEEDS_A_LEAF = 4
#: Points at which the integrand is evaluated where no seeds are given, a leaf; those with a value are the seeds.
SEARCH = 4


@dataclass(frozen=True, kw_only=True)
class Octree(Method):
    """Octrees over the cube, one for each technique [ZRJ23, section 5] (more options: see ``guiding.Method``).

    Slabs of neighbouring edges are cut into eight: first where seeds lie, then where their mass is largest. Seeds are
    points where the integrand is large, of projected path vertices or, without them, of random points.

    Attributes:
        max_depth: most cuts in eight; a cell is never smaller than 2^-max_depth.
    """

    max_depth: int = 16

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: an option out of range.
        """
        super().__post_init__()
        value = self.max_depth
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 24:
            raise ValueError(f"max_depth: got {value!r}, expected an integer in [1, 24]")

    def build(self, target: Target) -> Leaves:
        """Return leaves that follow the target."""
        growth = Growth(target)
        growth.slabs(edge_slabs(target, max(int(SLABS * self.max_leaves), 1)))
        seeds = target.seeds
        if seeds is None:
            points = target.random.random((SEARCH * self.max_leaves, 3))
            seeds = points[target.integrand.at(points) > 0.0]
        self._follow(growth, seeds, int(SEEDED * self.max_leaves))
        fresh = growth.leaves()
        growth.measure(fresh, 2 * self.samples)
        growth.suppose(fresh)
        while True:
            leaves = growth.leaves()
            size = growth.high[leaves] - growth.low[leaves]
            mass = size.prod(axis=1) * np.sqrt(growth.square[leaves])
            total = mass.sum()
            room = (self.max_leaves - len(leaves)) // 7
            mass[size[:, 1] <= 2.0**-self.max_depth] = 0.0
            order = np.argsort(-mass, kind="stable")[: min(room, len(leaves) // 8 + 1)]
            order = order[mass[order] > total / self.max_leaves]
            if not len(order):
                return growth.finish()
            growth.measure(_octants(growth, leaves[order]), self.samples)

    def _follow(self, growth: Growth, seeds: np.ndarray, room: int) -> None:
        """Split where seeds lie, level by level, until a leaf holds few of them or there are ``room`` leaves."""
        for _level in range(self.max_depth):
            found, held = np.unique(growth.locate(seeds), return_counts=True)
            order = np.argsort(-held, kind="stable")
            order = order[held[order] >= SEEDS_A_LEAF][: max((room - len(growth.leaves())) // 7, 0)]
            if not len(order):
                return
            _octants(growth, found[order])


def _octants(growth: Growth, which: np.ndarray) -> np.ndarray:
    """Cut cells in two along each axis that has room."""
    for axis in range(3):
        wide = growth.high[which, axis] - growth.low[which, axis] >= 2.0 * QUANTUM
        along = np.full(int(wide.sum()), axis)
        children = growth.split(which[wide], along, growth.middle(which[wide], along))
        which = np.concatenate([which[~wide], children])
    return which

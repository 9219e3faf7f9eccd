"""Guiding by an octree [ZRJ23, section 5]."""

from __future__ import annotations

import numpy as np

from warp_psdr.estimate.guiding.build import QUANTUM, Growth, Leaves, Target, edge_slabs
from warp_psdr.options.guiding import Octree

#: Share of the leaves with which the cube is cut along the edges, and up to which seeds may ask for more; the rest is
#: for what is measured. An octree of the whole cube would cut directions as finely as edges, of which there are many.
SLABS, SEEDED = 0.25, 0.5
#: A leaf is split by its seeds while it holds at least this many.
SEEDS_A_LEAF = 4
#: Points at which the integrand is evaluated where no seeds are given, a leaf; those with a value are the seeds.
SEARCH = 4


def build(method: Octree, target: Target) -> Leaves:
    """Return leaves that follow the target."""
    growth = Growth(target)
    growth.slabs(edge_slabs(target, max(int(SLABS * method.max_leaves), 1)))
    seeds = target.seeds
    if seeds is None:
        points = target.random.random((SEARCH * method.max_leaves, 3))
        seeds = points[target.integrand.at(points) > 0.0]
    _follow(method, growth, seeds, int(SEEDED * method.max_leaves))
    fresh = growth.leaves()
    growth.measure(fresh, 2 * method.samples)
    growth.suppose(fresh)
    while True:
        leaves = growth.leaves()
        size = growth.high[leaves] - growth.low[leaves]
        mass = size.prod(axis=1) * np.sqrt(growth.square[leaves])
        total = mass.sum()
        room = (method.max_leaves - len(leaves)) // 7
        mass[size[:, 1] <= 2.0**-method.max_depth] = 0.0
        order = np.argsort(-mass, kind="stable")[: min(room, len(leaves) // 8 + 1)]
        order = order[mass[order] > total / method.max_leaves]
        if not len(order):
            return growth.finish()
        growth.measure(_octants(growth, leaves[order]), method.samples)


def _follow(method: Octree, growth: Growth, seeds: np.ndarray, room: int) -> None:
    """Split where seeds lie, level by level, until a leaf holds few of them or there are ``room`` leaves."""
    for _level in range(method.max_depth):
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

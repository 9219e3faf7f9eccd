"""Guiding by a k-d tree [YLB*22, sections 4 and 5]."""

from __future__ import annotations

import numpy as np

from warp_psdr.estimate.guiding.build import Growth, Leaves, Target, edge_slabs
from warp_psdr.estimate.guiding.seeds import follow
from warp_psdr.options.guiding import KdTree

#: Share of the leaves that the cube is cut into along the edges before anything is known of the integrand.
INITIAL = 0.25
#: Share of the leaves that seeds may ask for.
SEEDED = 0.5
#: Leaves are split in rounds, so that each is one launch: the best of them, until a round has grown the tree this much.
GROWTH = 1.5
#: Weight of a leaf's mass beside the gain of its best split: few samples of a leaf do not tell all of the gain.
MASS = 0.5
#: Leaves of less than this fraction of the mean mass of as many leaves as there may be are not worth evaluations.
WORTH = 0.1


def build(method: KdTree, target: Target) -> Leaves:
    """Return leaves that follow the target."""
    growth = Growth(target)
    fresh = growth.slabs(edge_slabs(target, max(int(INITIAL * method.max_leaves), 1)))
    if target.seeds is not None:
        follow(growth, target.seeds, int(SEEDED * method.max_leaves))
        fresh = growth.leaves()
    growth.measure(fresh, 2 * method.samples)
    growth.suppose(fresh)
    while True:
        leaves = growth.leaves()
        size = np.prod(growth.high[leaves] - growth.low[leaves], axis=1)
        mass = size * np.sqrt(growth.square[leaves])
        total = mass.sum()
        room = min(method.max_leaves - len(leaves), int((GROWTH - 1.0) * len(leaves)) + 1)
        if room <= 0 or total <= 0.0:
            return growth.finish()
        gains = growth.gains(leaves)
        axis = gains.argmax(axis=1)
        best = gains[np.arange(len(leaves)), axis]
        best = np.where(best >= 0.0, best + MASS * mass, best)
        order = np.argsort(-best, kind="stable")[:room]
        order = order[best[order] > WORTH * total / method.max_leaves]
        if not len(order):
            return growth.finish()
        which, axis = leaves[order], axis[order]
        fresh = growth.split(which, axis, growth.middle(which, axis))
        growth.measure(fresh, method.samples)

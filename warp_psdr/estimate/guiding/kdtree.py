"""Guiding by a k-d tree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_psdr.estimate.guiding.build import Growth, Leaves, Target, edge_slabs
from warp_psdr.estimate.guiding.methods import Method
from warp_psdr.estimate.guiding.seeds import follow

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


@dataclass(frozen=True, kw_only=True)
class KdTree(Method):
    """Adaptive k-d trees, one for each technique [YLB*22, sections 4 and 5] (options: see ``guiding.Method``).

    Leaves start as slabs of neighbouring edges (``chains.py``) and are split where that lowers the variance most, in
    the middle of the axis that lowers it most. That is the criterion here, in place of the paper's difference between
    corner and random values: at the silhouettes of fine meshes both are spikes. Densities are linear within leaves.
    """

    def build(self, target: Target) -> Leaves:
        """Return leaves that follow the target."""
        growth = Growth(target)
        fresh = growth.slabs(edge_slabs(target, max(int(INITIAL * self.max_leaves), 1)))
        if target.seeds is not None:
            follow(growth, target.seeds, int(SEEDED * self.max_leaves))
            fresh = growth.leaves()
        growth.measure(fresh, 2 * self.samples)
        growth.suppose(fresh)
        while True:
            leaves = growth.leaves()
            size = np.prod(growth.high[leaves] - growth.low[leaves], axis=1)
            mass = size * np.sqrt(growth.square[leaves])
            total = mass.sum()
            room = min(self.max_leaves - len(leaves), int((GROWTH - 1.0) * len(leaves)) + 1)
            if room <= 0 or total <= 0.0:
                return growth.finish()
            gains = growth.gains(leaves)
            axis = gains.argmax(axis=1)
            best = gains[np.arange(len(leaves)), axis]
            best = np.where(best >= 0.0, best + MASS * mass, best)
            order = np.argsort(-best, kind="stable")[:room]
            order = order[best[order] > WORTH * total / self.max_leaves]
            if not len(order):
                return growth.finish()
            which, axis = leaves[order], axis[order]
            fresh = growth.split(which, axis, growth.middle(which, axis))
            growth.measure(fresh, self.samples)

"""Refinement of a k-d tree at seeds, before anything is measured [ZRJ23, section 5, for a k-d tree]."""

from __future__ import annotations

import numpy as np

from warp_psdr.estimate.guiding.build import Growth

#: A leaf is split while it holds at least this many seeds,
MANY = 32
#: or this many, unevenly: by more than so many standard errors of an even half.
FEW, UNEVEN = 8, 2.0


def follow(growth: Growth, seeds: np.ndarray, room: int) -> None:
    """Split leaves where seeds lie, level by level, along the axis whose halves hold the most different numbers.

    Args:
        growth: the tree.
        seeds: (N, 3) points of the cube.
        room: most leaves afterwards.
    """
    while len(seeds):
        node = growth.locate(seeds)
        # Numbers of seeds in the lower half of every leaf, along each axis.
        held = np.bincount(node, minlength=growth.count)
        middle = 0.5 * (growth.low[node] + growth.high[node])
        lower = np.stack([np.bincount(node, seeds[:, a] < middle[:, a], growth.count) for a in range(3)], axis=1)
        leaves = growth.leaves()
        n = held[leaves]
        contrast = np.abs(2.0 * lower[leaves] - n[:, None])
        contrast[growth.high[leaves] - growth.low[leaves] < 2.0**-20] = -1.0
        axis = contrast.argmax(axis=1)
        best = contrast[np.arange(len(leaves)), axis]
        split = (best >= 0.0) & ((n >= MANY) | ((n >= FEW) & (best > UNEVEN * np.sqrt(n))))
        order = np.flatnonzero(split)[np.argsort(-n[split], kind="stable")][: max(room - len(leaves), 0)]
        if not len(order):
            return
        which, axis = leaves[order], axis[order]
        growth.split(which, axis, growth.middle(which, axis))

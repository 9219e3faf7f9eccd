"""Trees of cells in the unit cube: how they grow, what they measure, and their upload.

Let f be the integrand, and let n samples have a density that is constant within leaves of volume V_i. The estimator's
variance is least for leaf probabilities proportional to V_i sqrt(E_i[f^2]), E_i the mean over the leaf, and is then

    ( (sum_i V_i sqrt(E_i[f^2]))^2 - (integral f)^2 ) / n.

A split has to lower that sum, and the square root of the second moment is a leaf's mass. Unlike the mean, it does not
neglect leaves in which few samples met thin features. Moments are shrunk towards those of the leaf that was split, by
``PRIOR`` samples, so that a leaf whose samples met nothing keeps some mass.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
import warp as wp

from warp_psdr.kernels.boundary.guiding.cells import Cells, Node
from warp_psdr.scene.lights.light_sampling import cumulative

if TYPE_CHECKING:
    from warp_psdr.estimate.boundary.terms import Request
    from warp_psdr.estimate.guiding.grid import Ends

#: Weight, in samples, of what is known from the leaf that was split.
PRIOR = 2.0
#: Weight, in samples, of what neighbours let expect, how many on either side are asked, and the weight of the whole
#: cube beside them.
EXPECTED, NEIGHBOURS, FAR_SHARE = 0.5, 8, 0.02
#: Largest slope of a ramp: its density varies by (1 + s) / (1 - s) across a leaf and nowhere vanishes.
MAX_SLOPE = 0.8
#: Samples with a value from which a slope is believed by half.
SLOPE_SAMPLES = 8.0
#: Share of the mass that seeds ask for, where there are any.
SEED_SHARE = 0.1
#: Coordinates are multiples of it, as the cumulative probabilities are: exact in float32.
QUANTUM = 2.0**-24
NODE = np.dtype([("axis", "<i4"), ("split", "<f4"), ("child", "<i4")])


class Integrand(Protocol):
    """The function that a structure follows, for one technique."""

    def at(self, points: np.ndarray) -> np.ndarray:
        """Evaluate at points (N, 3): (N,)."""

    def within(self, low: np.ndarray, high: np.ndarray, count: int) -> np.ndarray:
        """Evaluate at random points of boxes (n, 3), in turn in each of their octants: (n, count).

        Bits 4, 2 and 1 of an octant's number say the upper half of the axes 0, 1 and 2.
        """


@dataclass(eq=False)
class Target:
    """What a technique's structure has to follow.

    Attributes:
        technique: "wedge" or "light".
        integrand: evaluates, in parallel and in float64.
        edge_cdf: (E + 1,) where the edges begin along the first coordinate.
        facing: (E,) root mean square of the share of the lights for which an edge is a silhouette; None for the wedge.
        seeds: (N, 3) points near which the integrand is large; None: not known.
        random: generator for points of one's own.
        request: the boundary term.
        ends: technique, points (N, 3) of the cube -> what the ends of their segments are.
        shared: what a method keeps from one technique of a build to the next.
    """

    technique: str
    integrand: Integrand
    edge_cdf: np.ndarray
    facing: np.ndarray | None
    seeds: np.ndarray | None
    random: np.random.Generator
    request: Request
    ends: Callable[[str, np.ndarray], Ends]
    shared: dict = field(default_factory=dict)


@dataclass(eq=False)
class Leaves:
    """A built structure.

    Attributes:
        nodes: tree that finds the leaf of a point, root first (``NODE``; see ``kernels/boundary/guiding/cells.py``).
        low: (n, 3) float32 lower corners, multiples of 2^-24.
        high: (n, 3) upper corners.
        square: (n,) mean of the squared integrand over the leaf.
        slope: (n, 3) of the ramps, in (-1, 1).
    """

    nodes: np.ndarray
    low: np.ndarray
    high: np.ndarray
    square: np.ndarray
    slope: np.ndarray

    @property
    def mass(self) -> np.ndarray:
        """(n,) unnormalised probabilities."""
        return volume(self.low, self.high) * np.sqrt(self.square)

    @property
    def memory(self) -> int:
        """Bytes on the device."""
        return self.nodes.nbytes + self.low.nbytes + self.high.nbytes + self.slope.nbytes + 4 * (len(self.low) + 1)

    def find(self, points: np.ndarray) -> np.ndarray:
        """Return the numbers of the leaves that hold points (N, 3) of the cube."""
        node = np.zeros(len(points), np.int64)
        while True:
            tree = self.nodes[node]
            inner = np.flatnonzero(tree["axis"] >= 0)
            if not len(inner):
                return tree["child"].astype(np.int64)
            at = tree[inner]
            node[inner] = at["child"] + (points[inner, at["axis"]] >= at["split"])

    def add_seeds(self, seeds: np.ndarray) -> None:
        """Let no leaf have less than its part, by the seeds (N, 3) that it holds, of ``SEED_SHARE`` of all mass.

        Where the integrand is thin, as on fine meshes, a few evaluations of a leaf meet nothing although there is
        something; that would be left to the uniform floor.
        """
        if len(seeds):
            held = np.bincount(self.find(seeds), minlength=len(self.low))
            mass = np.maximum(self.mass, SEED_SHARE * self.mass.sum() * held / len(seeds))
            self.square = (mass / volume(self.low, self.high)) ** 2

    def upload(self, floor: float, device: wp.Device) -> Cells:
        """Return the device's record; without any mass all of it is uniform."""
        mass = self.mass if self.mass.sum() > 0.0 else volume(self.low, self.high)
        slope = self.slope if self.mass.sum() > 0.0 else np.zeros_like(self.slope)
        cells = Cells()
        cells.nodes = wp.array(self.nodes, dtype=Node, device=device)
        cells.low = wp.array(self.low, dtype=wp.vec3, device=device)
        cells.high = wp.array(self.high, dtype=wp.vec3, device=device)
        cells.slope = wp.array(slope.astype(np.float32), dtype=wp.vec3, device=device)
        cells.cdf = wp.array(cumulative(mass), dtype=wp.float32, device=device)
        cells.floor = floor
        return cells


def volume(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the volumes of boxes."""
    return (high.astype(np.float64) - low).prod(axis=1)


class Growth:
    """A tree that grows: boxes of all nodes, and what was measured in them.

    Attributes:
        count: number of nodes.
        low, high: (capacity, 3) boxes, float64.
        nodes: (capacity,) of ``NODE``.
        number: (capacity,) samples known, the prior's included.
        own: (capacity,) samples in this leaf since it came to be.
        square: (capacity,) mean square.
        halves: (capacity, 3, 2) sums of squares below and above the middle along each axis.
        sides: (capacity, 3, 2) sums of the values there.
        hits: (capacity,) samples with a value.
    """

    def __init__(self, target: Target):
        """Start with the whole cube as one leaf."""
        self.target = target
        self.count = 1
        self.nodes = np.array([(-1, 0.0, 0)], NODE)
        self.low, self.high = np.zeros((1, 3)), np.ones((1, 3))
        self.number, self.own, self.square, self.hits = (np.zeros(1) for _ in range(4))
        self.halves, self.sides = np.zeros((1, 3, 2)), np.zeros((1, 3, 2))

    def _reserve(self, capacity: int) -> None:
        more = max(capacity, 2 * len(self.nodes)) - len(self.nodes)
        for name in ("nodes", "low", "high", "number", "own", "square", "hits", "halves", "sides"):
            array = getattr(self, name)
            setattr(self, name, np.concatenate([array, np.zeros((more, *array.shape[1:]), array.dtype)]))

    def leaves(self) -> np.ndarray:
        """Return the numbers of the nodes that are leaves."""
        return np.flatnonzero(self.nodes["axis"][: self.count] < 0)

    def locate(self, points: np.ndarray) -> np.ndarray:
        """Return the nodes of the leaves that hold points (N, 3)."""
        node = np.zeros(len(points), np.int64)
        inner = np.arange(len(points))
        while True:
            inner = inner[self.nodes["axis"][node[inner]] >= 0]
            if not len(inner):
                return node
            tree = self.nodes[node[inner]]
            node[inner] = tree["child"] + (points[inner, tree["axis"]] >= tree["split"])

    def split(self, which: np.ndarray, axis: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Split leaves at coordinates inside of them; return their children, lower and upper in turn."""
        n = len(which)
        if self.count + 2 * n > len(self.nodes):
            self._reserve(self.count + 2 * n)
        lower = self.count + 2 * np.arange(n)
        self.count += 2 * n
        for side, child in enumerate((lower, lower + 1)):
            self.low[child], self.high[child] = self.low[which], self.high[which]
            (self.high if side == 0 else self.low)[child, axis] = at
            self.nodes["axis"][child] = -1
            half = 0.5 * self.number[which]
            prior = PRIOR * self.square[which]
            self.number[child] = PRIOR + half
            self.square[child] = (prior + self.halves[which, axis, side]) / (PRIOR + half)
        self.nodes["axis"][which], self.nodes["split"][which], self.nodes["child"][which] = axis, at, lower
        return np.stack([lower, lower + 1], axis=1).reshape(-1)

    def measure(self, which: np.ndarray, count: int) -> None:
        """Evaluate the integrand at ``count`` points of each of the leaves, and add that to what is known of them."""
        values = self.target.integrand.within(self.low[which], self.high[which], count)
        squares = values**2
        upper = (np.arange(count)[:, None] % 8 >> np.array([2, 1, 0])) & 1
        for weights, sums in ((squares, self.halves), (values, self.sides)):
            sums[which, :, 1] += weights @ upper
            sums[which, :, 0] += weights @ (1 - upper)
        n = self.number[which]
        self.square[which] = (n * self.square[which] + squares.sum(axis=1)) / (n + count)
        self.number[which] = n + count
        self.own[which] += count
        self.hits[which] += (values > 0.0).sum(axis=1)

    def gains(self, which: np.ndarray) -> np.ndarray:
        """Return (n, 3): by how much a split along each axis lowers the sum of masses, as far as one can tell."""
        prior = 0.5 * PRIOR
        known = (prior * self.square[which])[:, None, None] + self.halves[which]
        parts = np.sqrt(known / (0.5 * self.own[which] + prior)[:, None, None])
        whole = np.sqrt((parts**2).mean(axis=2))
        size = self.high[which] - self.low[which]
        gain = (whole - parts.mean(axis=2)) * size.prod(axis=1)[:, None]
        return np.where(size >= 2.0 * QUANTUM, gain, -1.0)

    def middle(self, which: np.ndarray, axis: np.ndarray) -> np.ndarray:
        """Return where to split: in the middle, and between edges as long as there is more than one."""
        low, high = self.low[which, axis], self.high[which, axis]
        at = np.clip(np.round(0.5 * (low + high) / QUANTUM), low / QUANTUM + 1, high / QUANTUM - 1) * QUANTUM
        cdf = self.target.edge_cdf
        nearest = np.clip(np.searchsorted(cdf, at), 1, len(cdf) - 1)
        nearest -= at - cdf[nearest - 1] < cdf[nearest] - at
        between = cdf[nearest]
        return np.where((axis == 0) & (between > low) & (between < high), between, at)

    def slabs(self, bounds: np.ndarray) -> np.ndarray:
        """Split the cube along the first axis at ascending coordinates in (0, 1); return the leaves."""
        first, last, node = np.array([0]), np.array([len(bounds)]), np.array([0])
        while True:
            more = last > first
            if not more.any():
                return self.leaves()
            first, last, node = first[more], last[more], node[more]
            mid = (first + last) // 2
            node = self.split(node, np.zeros(len(node), np.int64), bounds[mid])
            first, last = np.stack([first, mid + 1], axis=1).reshape(-1), np.stack([mid, last], axis=1).reshape(-1)

    def suppose(self, which: np.ndarray) -> None:
        """Give first leaves what their neighbours along the edges let expect, as a prior.

        Towards lights the integrand is taken for proportional to ``facing``, otherwise for constant, by the factor at
        which the second moments of the neighbourhood agree. So a leaf whose few samples met nothing is looked at again.
        """
        target = self.target
        which = which[np.argsort(self.low[which, 0], kind="stable")]
        p = np.diff(target.edge_cdf)
        sums = np.append(0.0, np.cumsum(p if target.facing is None else p * target.facing**2))
        first, last = (np.interp(x[which, 0], target.edge_cdf, sums) for x in (self.low, self.high))
        size = volume(self.low[which], self.high[which])
        expected = size * (last - first) / (self.high[which, 0] - self.low[which, 0])
        found = size * self.square[which]
        total = found.sum() / max(expected.sum(), 1e-300)
        near = _window(found + FAR_SHARE * total * expected)
        near /= np.maximum(_window((1.0 + FAR_SHARE) * expected), 1e-300)
        n = self.number[which]
        self.square[which] = (n * self.square[which] + EXPECTED * near * expected / size) / (n + EXPECTED)
        self.number[which] += EXPECTED

    def finish(self) -> Leaves:
        """Return the leaves, in the order of their lower corners."""
        leaves = self.leaves()
        low = self.low[leaves]
        leaves = leaves[np.lexsort((low[:, 2], low[:, 1], low[:, 0]))]
        nodes = self.nodes[: self.count].copy()
        nodes["child"][leaves] = np.arange(len(leaves))
        below, above = self.sides[leaves, :, 0], self.sides[leaves, :, 1]
        # The upper half of a ramp holds 1/2 + s/4 of it.
        ratio = 2.0 * (above - below) / np.maximum(above + below, 1e-300)
        trust = self.hits[leaves] / (self.hits[leaves] + SLOPE_SAMPLES)
        slope = np.clip(ratio * trust[:, None], -MAX_SLOPE, MAX_SLOPE)
        square = self.square[leaves]
        low32, high32 = self.low[leaves].astype(np.float32), self.high[leaves].astype(np.float32)
        return Leaves(nodes, low32, high32, square, slope.astype(np.float32))


def _window(x: np.ndarray) -> np.ndarray:
    """Return sums over ``NEIGHBOURS`` on either side."""
    sums = np.append(0.0, np.cumsum(x))
    i = np.arange(len(x))
    return sums[np.minimum(i + NEIGHBOURS + 1, len(x))] - sums[np.maximum(i - NEIGHBOURS, 0)]


def edge_slabs(target: Target, count: int) -> np.ndarray:
    """Return about ``count`` inner boundaries between edges: equal parts of what is known about the edges.

    That is the edges' probability and, towards lights, half by half the share of light points for which each of them
    can be a silhouette.
    """
    p = np.diff(target.edge_cdf)
    weight = p
    if target.facing is not None and (p * target.facing).sum() > 0.0:
        known = p * target.facing
        weight = 0.1 * p + 0.9 * known / known.sum()
    sums = np.cumsum(weight)
    part = np.floor(sums * (count / sums[-1]) - 1e-9).astype(np.int64)
    cut = np.flatnonzero(part[1:] != part[:-1]) + 1
    bounds = np.unique(target.edge_cdf[cut].astype(np.float64))
    return bounds[(bounds > 0.0) & (bounds < 1.0)]

"""The structure of a boundary term's guiding: its domain, how it is built, refreshed and read by kernels."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch_shards
from warp_psdr.estimate.guiding.build import NODE, Leaves, Target
from warp_psdr.estimate.guiding.intervals import Intervals
from warp_psdr.estimate.guiding.methods import build
from warp_psdr.estimate.jobs import sample_job
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.guiding import Method
from warp_psdr.scene.layout import CAMERA, LIGHT_POSE, SHAPE_GRID, SHAPE_POSE

if TYPE_CHECKING:
    from warp_psdr.estimate.boundary.terms import Request
    from warp_psdr.estimate.guiding.grid import Ends

#: Least share of the samples of either technique, and that of one whose evaluations met nothing: there may be light
#: all the same, in a small part of the cube.
LEAST_SHARE, UNSEEN_SHARE = 0.05, 0.3
#: Stream of the random numbers with which structures are built, and what an evaluation adds to it.
BUILD = 3
TECHNIQUES = ("wedge", "light")
#: Largest share of a term's samples that evaluations may be: of those that refresh masses, and of those of a rebuild
#: among the samples since the build before. An evaluation costs about what a sample does.
REFRESH_SHARE, REBUILD_SHARE = 0.1, 0.2
#: How many times the drift a structure serves at most, whatever a build costs.
MOST_DRIFTS = 10.0
#: Least size of a camera's number that its changes are compared with: principal points are offsets about 0.
LEAST_SIZE = 1.0


@dataclass(frozen=True, eq=False)
class Space:
    """The cube of a boundary term.

    Attributes:
        kernel: evaluates the integrand (role "target").
        head: its arguments in front of the guide.
        cdf: technique -> (E + 1,) where the items, edges for example, begin along the first coordinate.
        facing: (E,) root mean square of the share of the lights for which an item is a silhouette; None: not known.
        ends: technique, points (N, 3) of the cube -> what the ends of their segments are.
        seeds: technique -> (N, 3) points near which the integrand is large; None: not known.
        unlit: there is no light to aim at, and all samples are of the technique "wedge".
    """

    kernel: wp.Kernel
    head: list
    cdf: dict[str, np.ndarray]
    facing: np.ndarray | None
    ends: Callable[[str, np.ndarray], Ends]
    seeds: Callable[[str], np.ndarray] | None = None
    unlit: bool = False


@dataclass(eq=False, kw_only=True)
class Structure:
    """A built structure.

    Attributes:
        leaves: technique -> its leaves.
        built: values of the scene when it was built.
        seen: values for which its masses were measured last.
        guide: the device's record.
        builds: how often it was built.
        evaluations: of the integrand, so far.
        build_evaluations: those of the last build.
        guided: samples since.
        turn: number of the refresh.
        intervals: technique -> those of items that come and go; of others there are none.
    """

    leaves: dict[str, Leaves]
    built: np.ndarray
    seen: np.ndarray
    guide: Guide
    builds: int = 0
    evaluations: int = 0
    build_evaluations: int = 0
    guided: int = 0
    turn: int = 0
    intervals: dict[str, Intervals] = field(default_factory=dict)

    @property
    def memory(self) -> int:
        """Bytes of the cells on the device."""
        return sum(leaves.memory for leaves in self.leaves.values())

    @property
    def leaf_count(self) -> int:
        """Leaves of both techniques."""
        return sum(len(leaves.low) for leaves in self.leaves.values())


def samples_of(r: Request) -> int:
    """Return the number of samples that a structure guides."""
    return r.pixels * (r.method.spp_secondary or r.spp)


def stays(r: Request, method: Method, found: Structure) -> bool:
    """Return whether the cells of a structure are kept: they are near, or dear."""
    if not found.leaves:
        return False
    near = drift(r, found.built, r.scene.values.numpy()) <= method.drift
    return near or found.build_evaluations > REBUILD_SHARE * found.guided


def renew(r: Request, method: Method, found: Structure, space: Space, serves: bool = True) -> None:
    """Measure a structure again for the values of the scene, or build it: anew where they are too far away.

    ``serves``: the structure need not be built anew at once.
    """
    if serves and stays(r, method, found):
        _refresh(r, method, found, space)
    else:
        _build(r, method, found, space)


def drift(r: Request, a: np.ndarray, b: np.ndarray) -> float:
    """Largest way of a vertex, light or camera, in scene radii; turns in radians, the rest as shares."""
    scene = r.scene
    rows = slice(scene.positions, scene.positions + 3 * scene.vertex_count)
    found = float(np.abs(b[rows] - a[rows]).max(initial=0.0)) / scene.radius
    exact = set(scene.builder.primitives)
    for p in scene.parameters.values():
        if not p.uses & {LIGHT_POSE, CAMERA, SHAPE_GRID} and not (SHAPE_POSE in p.uses and exact & set(p.owners)):
            continue
        old, new = (x[p.offset : p.offset + p.size].astype(np.float64) for x in (a, b))
        if p.shape == (4, 4):
            way, turn = (new - old).reshape(4, 4)[:3, 3], (new - old).reshape(4, 4)[:3, :3]
            size = np.linalg.norm(new.reshape(4, 4)[:3, 0]) or 1.0
            found = max(found, np.abs(way).max() / scene.radius, np.abs(turn).max() / size)
        elif p.placed:
            found = max(found, np.abs(new - old).max() / scene.radius)
        else:
            least = LEAST_SIZE if CAMERA in p.uses else 1.0e-30
            found = max(found, np.abs(new - old).max() / max(np.abs(old).max(), least))
    return float(found)


def _build(r: Request, method: Method, found: Structure, space: Space) -> None:
    before = found.evaluations
    shared: dict = {}
    for number, technique in enumerate(TECHNIQUES):
        target = Target(
            technique=technique,
            integrand=Evaluator(r, found, space, technique),
            edge_cdf=space.cdf[technique],
            facing=space.facing if technique == "light" else None,
            seeds=None,
            random=np.random.default_rng((r.seed, number)),
            request=r,
            ends=space.ends,
            shared=shared,
        )
        if technique == ("light" if space.unlit else "wedge") and (space.unlit or _aimed(r)):
            found.leaves[technique] = whole()
        else:
            found.leaves[technique] = build(method, _seeded(target, space))
            if target.seeds is not None and found.leaves[technique].square.any():
                found.leaves[technique].add_seeds(target.seeds)
    found.built = r.scene.values.numpy().copy()
    found.builds += 1
    # A grid evaluates by maps: the points that it asks for count instead.
    found.build_evaluations = max(found.evaluations - before, found.leaf_count * method.samples)
    found.guided = 0
    _finish(r, method, found, space)


def _aimed(r: Request) -> bool:
    """Whether all light is found by aiming at it, being direct and not at infinity: little is left to the wedge."""
    shines = r.config.media is not None and r.config.media.emissive
    return r.plan.max_depth == 2 and r.scene.builder.environment < 0 and not shines


def _seeded(target: Target, space: Space) -> Target:
    """Ask for seeds, and keep those at which the integrand is not zero."""
    if space.seeds is not None:
        target.seeds = space.seeds(target.technique)
        if len(target.seeds):
            target.seeds = target.seeds[target.integrand.at(target.seeds) > 0.0]
    return target


def whole() -> Leaves:
    """Return the cube as one leaf of unknown mass."""
    nodes = np.array([(-1, 0.0, 0)], NODE)
    low, high = np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32)
    return Leaves(nodes, low, high, np.zeros(1), np.zeros((1, 3), np.float32))


def _refresh(r: Request, method: Method, found: Structure, space: Space) -> None:
    """Measure leaves again with few samples, which count as much as so many of the first ones.

    Every n-th leaf, in turns, with n such that the evaluations are few beside the samples that they guide.
    """
    count = method.refresh
    measured = {technique: leaves for technique, leaves in found.leaves.items() if leaves.square.any()}
    total = count * sum(len(leaves.low) for leaves in measured.values())
    stride = max(math.ceil(total / (REFRESH_SHARE * samples_of(r))), 1)
    weight = count / (count + method.samples)
    for technique, leaves in measured.items():
        which = np.arange(found.turn % stride, len(leaves.low), stride)
        if len(which):
            values = Evaluator(r, found, space, technique).within(leaves.low[which], leaves.high[which], count)
            leaves.square[which] = (1.0 - weight) * leaves.square[which] + weight * (values**2).mean(axis=1)
    found.turn += 1
    _finish(r, method, found, space)


def _finish(r: Request, method: Method, found: Structure, space: Space) -> None:
    mass = {technique: float(leaves.mass.sum()) for technique, leaves in found.leaves.items()}
    total = sum(mass.values())
    share = mass["wedge"] / total if total > 0.0 else 0.5
    least = {technique: LEAST_SHARE if mass[technique] > 0.0 else UNSEEN_SHARE for technique in TECHNIQUES}
    if _aimed(r):
        least["wedge"] = LEAST_SHARE
    found.guide = Guide()
    found.guide.wedge = found.leaves["wedge"].upload(method.floor, r.scene.device)
    found.guide.light = found.leaves["light"].upload(method.floor, r.scene.device)
    found.guide.share = 1.0 if space.unlit else min(max(share, least["wedge"]), 1.0 - least["light"])


class Evaluator:
    """The integrand of one technique (see ``build.Target``)."""

    def __init__(self, r: Request, found: Structure, space: Space, technique: str):
        self._r, self._found, self._space, self._technique = r, found, space, technique

    def at(self, points: np.ndarray) -> np.ndarray:
        """Evaluate at points (N, 3): (N,)."""
        record = Guide()
        points = np.ascontiguousarray(points, np.float64)
        record.points = wp.array(points, dtype=wp.vec3d, device=self._r.scene.device)
        return self._run(record, len(points), 1)

    def within(self, low: np.ndarray, high: np.ndarray, count: int) -> np.ndarray:
        """Evaluate at random points of boxes (n, 3), in turn in each octant: (n, count)."""
        record = Guide()
        record.low, record.high = (
            wp.array(np.ascontiguousarray(x, np.float32), dtype=wp.vec3, device=self._r.scene.device)
            for x in (low, high)
        )
        return self._run(record, len(low) * count, count).reshape(len(low), count)

    def _run(self, record: Guide, total: int, count: int) -> np.ndarray:
        r, device = self._r, self._r.scene.device
        record.share = 0.5
        record.technique = 1 if self._technique == "wedge" else 0
        out = wp.zeros(total, dtype=wp.float32, device=device)
        none = wp.zeros((1, 1), dtype=wp.vec3, device=device)
        seed = mix_seed(mix_seed(r.seed, BUILD), self._found.evaluations)
        self._found.evaluations += total

        def inputs(first: int) -> list:
            return [*self._space.head, record, sample_job(first, count, seed, r.plan.max_depth, r.rr_depth, none)]

        run(r, self._space.kernel, total, inputs, [out, none])
        values = out.numpy().astype(np.float64)
        return r.scene.invalid.drop("guiding", values)


def run(r: Request, kernel: wp.Kernel, count: int, inputs: Callable[[int], list], outputs: list) -> None:
    """Launch one thread an item; every one has an output of its own, so chunks may run side by side."""
    launch_shards(
        kernel, count, lambda first, _n, _shard: (inputs(first), outputs), shards=workers.SHARDS, device=r.scene.device
    )

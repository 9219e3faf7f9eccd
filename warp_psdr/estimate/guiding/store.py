"""Built structures, kept on the scene from one gradient to the next.

A structure belongs to a method, to what moves, to a camera and a depth. At the same values of the scene it is used as
it is. While vertices, lights and cameras have moved by less than ``drift`` since it was built, its cells stay and their
masses are refreshed, those of some of them at each change. Beyond that it is built anew, as soon as the samples that it
has guided since are so many that the evaluations of a build are few beside them; at once where an edge can be a
silhouette that is not in it. So a step of an optimisation spends little on guiding, however fine the structure is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch_shards
from warp_psdr.estimate.guiding.build import NODE, Leaves, Target
from warp_psdr.estimate.guiding.methods import build
from warp_psdr.estimate.guiding.ordering import follow, ordered_edges
from warp_psdr.estimate.jobs import sample_job
from warp_psdr.kernels.boundary.guiding.facing import make_facing_kernel
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.boundary.path_space.secondary import make_secondary_kernel
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.guiding import Method
from warp_psdr.plan.guiding import kept
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.scene.layout import CAMERA, LIGHT_POSE
from warp_psdr.topology.edges import COPLANAR, scene_adjacency
from warp_psdr.topology.secondary_edges import secondary_candidates

if TYPE_CHECKING:
    from warp_psdr.estimate.boundary.terms import Request
    from warp_psdr.scene.scene import Scene

#: Least share of the samples of either technique, and that of one whose evaluations met nothing: there may be light
#: all the same, in a small part of the cube.
LEAST_SHARE, UNSEEN_SHARE = 0.05, 0.3
#: Points of the lights for which edges are tested to be a silhouette.
FACING = 32
#: Stream of the random numbers with which structures are built, and what an evaluation adds to it.
BUILD = 3
TECHNIQUES = ("wedge", "light")
#: Largest share of a term's samples that evaluations may be: of those that refresh masses, and of those of a rebuild
#: among the samples since the build before. An evaluation costs about what a sample does.
REFRESH_SHARE, REBUILD_SHARE = 0.1, 0.2
#: Angle of an edge, over ``edges.COPLANAR``, up to which it is still as good as flat if it was so at the build:
#: rounding moves edges across that bound whenever they move.
STILL_FLAT = 4.0
#: How many times the drift an order of the edges serves, and a structure at most, whatever a build costs.
MOST_DRIFTS = 10.0
#: Least size of a camera's number that its changes are compared with: principal points are offsets about 0.
LEAST_SIZE = 1.0
Seeds = Callable[[str, Edges], np.ndarray]


@dataclass(eq=False)
class Guiding:
    """A built structure.

    Attributes:
        edges: the edges in the order of the first coordinate.
        keep: their numbers in the scene's adjacency, sorted.
        order: these numbers in that order.
        turned: which of them are turned around.
        numbering: the adjacency's own array of triangles; another one may number the edges otherwise.
        leaves: technique -> its leaves.
        facing: for which share of the lights each edge is a silhouette.
        ordered: values of the scene when the edges were put in order.
        built: values of the scene when it was built.
        seen: values for which its masses were measured last.
        guide: the device's record.
        builds: how often it was built.
        evaluations: of the integrand, so far.
        build_evaluations: those of the last build.
        guided: samples since.
        turn: number of the refresh.
    """

    edges: Edges
    keep: np.ndarray
    order: np.ndarray
    turned: np.ndarray
    numbering: np.ndarray
    leaves: dict[str, Leaves]
    facing: np.ndarray
    ordered: np.ndarray
    built: np.ndarray
    seen: np.ndarray
    guide: Guide
    builds: int = 0
    evaluations: int = 0
    build_evaluations: int = 0
    guided: int = 0
    turn: int = 0

    @property
    def memory(self) -> int:
        """Bytes of the cells on the device."""
        return sum(leaves.memory for leaves in self.leaves.values())

    @property
    def leaf_count(self) -> int:
        """Leaves of both techniques."""
        return sum(len(leaves.low) for leaves in self.leaves.values())


def structures(scene: Scene) -> list[Guiding]:
    """Return what guiding has built for a scene."""
    return list(kept(scene).values())


def built(r: Request, method: Method) -> bool:
    """Whether there is a structure for a boundary term."""
    return _key(r, method) in kept(r.scene)


def forget(r: Request, method: Method) -> None:
    """Forget what guiding has built for one boundary term."""
    kept(r.scene).pop(_key(r, method), None)


def kernels(r: Request) -> list[wp.Kernel]:
    """Return the kernels that build structures for a boundary term: the integrand, and what faces the lights."""
    return [make_secondary_kernel(r.config, "target", False, False, indirect=r.indirect), make_facing_kernel(r.config)]


def _key(r: Request, method: Method) -> tuple:
    return method, r.moves, r.sensor, r.plan.max_depth, r.method.without_counts(), r.indirect


def guide(r: Request, method: Method, seeds: Seeds | None = None) -> tuple[Edges | None, Guide]:
    """Return the edges and the structures that guide a boundary term; (None, empty): there are no edges.

    Args:
        r: the boundary term.
        method: how to guide it.
        seeds: technique, edges -> (N, 3) points of the cube near which the integrand is large; asked at a build only.
    """
    scene = r.scene
    values = scene.values.numpy()
    key = _key(r, method)
    old = kept(scene).get(key)
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    if old is not None and np.array_equal(old.seen, values, equal_nan=True):
        old.guided += samples
        return old.edges, old.guide
    keep, p = secondary_candidates(scene, set(r.moves.shapes))
    if not len(keep):
        return None, Guide()
    if old is not None and _covers(scene, old, keep) and _drift(r, old.ordered, values) <= MOST_DRIFTS * method.drift:
        follow(scene, old.edges, old.order, old.turned)
        if _drift(r, old.built, values) <= method.drift or old.build_evaluations > REBUILD_SHARE * old.guided:
            _refresh(r, method, old, samples)
        else:
            _build(r, method, old, seeds)
    else:
        old = _ordered(r, keep, p, old)
        _build(r, method, old, seeds)
    kept(scene)[key] = old
    old.seen = values.copy()
    old.guided += samples
    return old.edges, old.guide


def _covers(scene: Scene, found: Guiding, keep: np.ndarray) -> bool:
    """Return whether all of these edges are in a structure, but for those that are as good as flat."""
    edges = scene_adjacency(scene)
    if found.numbering is not edges.faces:
        return False
    outside = np.ones(len(edges.length), bool)
    outside[found.keep] = False
    return not (edges.wedge[keep[outside[keep]]] > STILL_FLAT * COPLANAR).any()


def _ordered(r: Request, keep: np.ndarray, p: np.ndarray, old: Guiding | None) -> Guiding:
    """Return a structure that has its edges and nothing else."""
    edges, facing, order, turned = ordered_edges(r.scene, keep, p, lambda edges: _facing(r, edges))
    values = r.scene.values.numpy().copy()
    numbering = scene_adjacency(r.scene).faces
    builds, evaluations = (old.builds, old.evaluations) if old else (0, 0)
    return Guiding(
        edges, keep, order, turned, numbering, {}, facing, values, values, values, Guide(), builds, evaluations
    )


def _drift(r: Request, a: np.ndarray, b: np.ndarray) -> float:
    """Largest way of a vertex, light or camera, in scene radii; turns in radians, what else a camera has as shares."""
    scene = r.scene
    rows = slice(scene.positions, scene.positions + 3 * scene.vertex_count)
    drift = float(np.abs(b[rows] - a[rows]).max(initial=0.0)) / scene.radius
    for p in scene.parameters.values():
        if not p.uses & {LIGHT_POSE, CAMERA}:
            continue
        old, new = (x[p.offset : p.offset + p.size].astype(np.float64) for x in (a, b))
        if p.shape == (4, 4):
            way, turn = (new - old).reshape(4, 4)[:3, 3], (new - old).reshape(4, 4)[:3, :3]
            size = np.linalg.norm(new.reshape(4, 4)[:3, 0]) or 1.0
            drift = max(drift, np.abs(way).max() / scene.radius, np.abs(turn).max() / size)
        elif p.placed:
            drift = max(drift, np.abs(new - old).max() / scene.radius)
        else:
            drift = max(drift, np.abs(new - old).max() / max(np.abs(old).max(), LEAST_SIZE))
    return float(drift)


def _build(r: Request, method: Method, found: Guiding, seeds: Seeds | None) -> None:
    before = found.evaluations
    shared: dict = {}
    for number, technique in enumerate(TECHNIQUES):
        random = np.random.default_rng((r.seed, number))
        target = Target(
            technique=technique,
            integrand=_Evaluator(r, found, technique),
            edge_cdf=found.edges.cdf.numpy().astype(np.float64),
            facing=found.facing if technique == "light" else None,
            seeds=None,
            random=random,
            request=r,
            edges=found.edges,
            shared=shared,
        )
        if technique == "wedge" and _aimed(r):
            found.leaves[technique] = whole()
        else:
            found.leaves[technique] = build(method, _seeded(target, seeds))
            if target.seeds is not None and found.leaves[technique].square.any():
                found.leaves[technique].add_seeds(target.seeds)
    found.built = r.scene.values.numpy().copy()
    found.builds += 1
    # A grid evaluates by maps: the points that it asks for count instead.
    found.build_evaluations = max(found.evaluations - before, found.leaf_count * method.samples)
    found.guided = 0
    _finish(r, method, found)


def _aimed(r: Request) -> bool:
    """Whether all light is found by aiming at it, being direct and not at infinity: little is left to the wedge."""
    return r.plan.max_depth == 2 and r.scene.builder.environment < 0


def _seeded(target: Target, seeds: Seeds | None) -> Target:
    """Ask for seeds, and keep those at which the integrand is not zero."""
    if seeds is not None:
        target.seeds = seeds(target.technique, target.edges)
        if len(target.seeds):
            target.seeds = target.seeds[target.integrand.at(target.seeds) > 0.0]
    return target


def whole() -> Leaves:
    """Return the cube as one leaf of unknown mass."""
    nodes = np.array([(-1, 0.0, 0)], NODE)
    low, high = np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32)
    return Leaves(nodes, low, high, np.zeros(1), np.zeros((1, 3), np.float32))


def _refresh(r: Request, method: Method, found: Guiding, samples: int) -> None:
    """Measure leaves again with few samples, which count as much as so many of the first ones.

    Every n-th leaf, in turns, with n such that the evaluations are few beside the samples that they guide.
    """
    count = method.refresh
    measured = {technique: leaves for technique, leaves in found.leaves.items() if leaves.square.any()}
    total = count * sum(len(leaves.low) for leaves in measured.values())
    stride = max(math.ceil(total / (REFRESH_SHARE * samples)), 1)
    weight = count / (count + method.samples)
    for technique, leaves in measured.items():
        which = np.arange(found.turn % stride, len(leaves.low), stride)
        if len(which):
            values = _Evaluator(r, found, technique).within(leaves.low[which], leaves.high[which], count)
            leaves.square[which] = (1.0 - weight) * leaves.square[which] + weight * (values**2).mean(axis=1)
    found.turn += 1
    _finish(r, method, found)


def _finish(r: Request, method: Method, found: Guiding) -> None:
    mass = {technique: float(leaves.mass.sum()) for technique, leaves in found.leaves.items()}
    total = sum(mass.values())
    share = mass["wedge"] / total if total > 0.0 else 0.5
    least = {technique: LEAST_SHARE if mass[technique] > 0.0 else UNSEEN_SHARE for technique in TECHNIQUES}
    if _aimed(r):
        least["wedge"] = LEAST_SHARE
    found.guide = Guide()
    found.guide.wedge = found.leaves["wedge"].upload(method.floor, r.scene.device)
    found.guide.light = found.leaves["light"].upload(method.floor, r.scene.device)
    found.guide.share = min(max(share, least["wedge"]), 1.0 - least["light"])


class _Evaluator:
    """The integrand of one technique (see ``build.Target``)."""

    def __init__(self, r: Request, found: Guiding, technique: str):
        self._r, self._found, self._technique = r, found, technique
        self._kernel, _facing = kernels(r)
        self._head = [r.scene.data(), r.camera, found.edges, moving_shapes(r.scene, r.moves)]

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
            return [*self._head, record, sample_job(first, count, seed, r.plan.max_depth, r.rr_depth, none)]

        _run(r, self._kernel, total, inputs, [out, none])
        values = out.numpy().astype(np.float64)
        return r.scene.invalid.drop("guiding", values)


def _facing(r: Request, edges: Edges) -> np.ndarray:
    """Share of points of the lights for which each edge can be a silhouette."""
    count = edges.cdf.shape[0] - 1
    _integrand, kernel = kernels(r)
    random = np.random.default_rng((r.seed, len(TECHNIQUES)))
    strata = np.stack([random.permutation(FACING) for _ in range(2)], axis=1)
    points = wp.array((strata + random.random((FACING, 2))) / FACING, dtype=wp.vec2d, device=r.scene.device)
    out = wp.zeros(count, dtype=wp.float32, device=r.scene.device)
    _run(r, kernel, count, lambda first: [r.scene.data(), edges, first, points], [out])
    return out.numpy().astype(np.float64)


def _run(r: Request, kernel: wp.Kernel, count: int, inputs: Callable[[int], list], outputs: list) -> None:
    """Launch one thread an item; every one has an output of its own, so chunks may run side by side."""
    launch_shards(
        kernel, count, lambda first, _n, _shard: (inputs(first), outputs), shards=workers.SHARDS, device=r.scene.device
    )

"""Built structures, kept on the scene from one gradient to the next.

A structure belongs to a method, to what moves, to a camera and a depth. At the same values of the scene it is used as
it is. While vertices and camera have moved by less than ``drift`` since it was built, its cells stay and their masses
are refreshed; beyond that, or where another set of edges can be a silhouette, it is built anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.boundary.motion import moving_shapes
from warp_psdr.device import launch_lanes
from warp_psdr.guiding.build import NODE, Leaves, Target
from warp_psdr.guiding.methods import Method
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.boundary.secondary import make_secondary_kernel
from warp_psdr.kernels.guiding.facing import make_facing_kernel
from warp_psdr.kernels.guiding.techniques import Guide
from warp_psdr.kernels.rng import mix_seed

if TYPE_CHECKING:
    from warp_psdr.boundary.terms import Request
    from warp_psdr.scene.scene import Scene

#: Bounds of the wedge's share of the samples.
LEAST_SHARE, MOST_SHARE = 0.05, 0.95
#: Points of the lights for which edges are tested to be a silhouette.
FACING = 32
#: Stream of the random numbers with which structures are built, and what an evaluation adds to it.
BUILD = 3
TECHNIQUES = ("wedge", "light")
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
        built: values of the scene when it was built.
        seen: values for which its masses were measured last.
        guide: the device's record.
        builds: how often it was built.
        evaluations: of the integrand, so far.
    """

    edges: Edges
    keep: np.ndarray
    order: np.ndarray
    turned: np.ndarray
    numbering: np.ndarray
    leaves: dict[str, Leaves]
    built: np.ndarray
    seen: np.ndarray
    guide: Guide
    builds: int = 1
    evaluations: int = 0

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
    return list(_kept(scene).values())


def reset(scene: Scene) -> None:
    """Forget what guiding has built for a scene."""
    _kept(scene).clear()


def describe(scene: Scene, method: Method) -> str:
    """Say what a method has built for a scene."""
    found = [g for key, g in _kept(scene).items() if key[0] == method]
    if not found:
        return "built with the first gradient"
    leaves, memory = sum(g.leaf_count for g in found), sum(g.memory for g in found)
    return f"{leaves} leaves, {memory / 1e6:.1f} MB; guiding.reset(scene) forgets them"


def _kept(scene: Scene) -> dict:
    return scene.__dict__.setdefault("_guiding", {})


def guide(r: Request, method: Method, seeds: Seeds | None = None) -> tuple[Edges | None, Guide]:
    """Return the edges and the structures that guide a boundary term; (None, empty): there are no edges.

    Args:
        r: the boundary term.
        method: how to guide it.
        seeds: technique, edges -> (N, 3) points of the cube near which the integrand is large; asked at a build only.
    """
    from warp_psdr.edges import moved_points, ordered_edges, scene_adjacency, secondary_candidates

    scene = r.scene
    values = scene.values.numpy()
    counted = replace(r.method, spp_primary=None, spp_secondary=None)
    key = (method, r.moves, r.sensor, r.plan.max_depth, counted)
    old = _kept(scene).get(key)
    if old is not None and np.array_equal(old.seen, values, equal_nan=True):
        return old.edges, old.guide
    keep, p = secondary_candidates(scene, set(r.moves.shapes))
    if not len(keep):
        return None, Guide()
    numbering = scene_adjacency(scene).faces
    same = old is not None and old.numbering is numbering and np.array_equal(old.keep, keep)
    if old is not None and same and _drift(r, old.built, values) <= method.drift:
        old.edges.points = moved_points(scene, old.order, old.turned)
        _refresh(r, method, old)
        old.seen = values.copy()
    else:
        edges, facing, order, turned = ordered_edges(scene, keep, p, lambda edges: _facing(r, edges))
        found = Guiding(
            edges,
            keep,
            order,
            turned,
            numbering,
            {},
            values.copy(),
            values.copy(),
            Guide(),
            1 + (old.builds if old else 0),
        )
        _build(r, method, found, facing, seeds)
        _kept(scene)[key] = old = found
    return old.edges, old.guide


def _drift(r: Request, a: np.ndarray, b: np.ndarray) -> float:
    """Largest way of a vertex or of the camera, relative to the scene's radius; turns in radians."""
    scene, camera = r.scene, r.camera
    rows = slice(scene.positions, scene.positions + 3 * scene.vertex_count)
    way = float(np.abs(b[rows] - a[rows]).max(initial=0.0)) / scene.radius
    pose = (b - a)[camera.to_world : camera.to_world + 12].reshape(3, 4).astype(np.float64)
    size = float(np.linalg.norm(b[camera.to_world : camera.to_world + 3])) or 1.0
    return max(way, float(np.abs(pose[:, 3]).max()) / scene.radius, float(np.abs(pose[:, :3]).max()) / size)


def _build(r: Request, method: Method, found: Guiding, facing: np.ndarray, seeds: Seeds | None) -> None:
    for number, technique in enumerate(TECHNIQUES):
        random = np.random.default_rng((r.seed, number))
        target = Target(
            technique=technique,
            integrand=_Evaluator(r, found, technique),
            edge_cdf=found.edges.cdf.numpy().astype(np.float64),
            facing=facing if technique == "light" else None,
            seeds=None,
            random=random,
            request=r,
            edges=found.edges,
        )
        # Light that is not at infinity is found by aiming at it: with that alone the wedge keeps its least share.
        aimed = r.plan.max_depth == 2 and r.scene.builder.environment < 0
        if technique == "wedge" and aimed:
            found.leaves[technique] = whole()
        else:
            found.leaves[technique] = method.build(_seeded(target, seeds))
            if target.seeds is not None and found.leaves[technique].square.any():
                found.leaves[technique].add_seeds(target.seeds)
    _finish(r, method, found)


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


def _refresh(r: Request, method: Method, found: Guiding) -> None:
    """Measure the leaves again with few samples, which count as much as so many of the first ones."""
    count = method.refresh
    for technique, leaves in found.leaves.items():
        if not leaves.square.any():
            continue
        values = _Evaluator(r, found, technique).within(leaves.low, leaves.high, count)
        weight = count / (count + method.samples)
        leaves.square = (1.0 - weight) * leaves.square + weight * (values**2).mean(axis=1)
    _finish(r, method, found)


def _finish(r: Request, method: Method, found: Guiding) -> None:
    mass = {technique: float(leaves.mass.sum()) for technique, leaves in found.leaves.items()}
    total = sum(mass.values())
    share = mass["wedge"] / total if total > 0.0 else 0.5
    found.guide = Guide()
    found.guide.wedge = found.leaves["wedge"].upload(method.floor, r.scene.device)
    found.guide.light = found.leaves["light"].upload(method.floor, r.scene.device)
    found.guide.share = min(max(share, LEAST_SHARE), MOST_SHARE)


class _Evaluator:
    """The integrand of one technique (see ``build.Target``)."""

    def __init__(self, r: Request, found: Guiding, technique: str):
        self._r, self._found, self._technique = r, found, technique
        self._kernel = make_secondary_kernel(r.config, "target", False, False)
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
        tail = [count, seed, r.plan.max_depth, r.rr_depth, none]
        self._found.evaluations += total
        _run(r, self._kernel, total, lambda first: [*self._head, record, first, *tail], [out, none])
        values = out.numpy().astype(np.float64)
        return r.scene.invalid.drop("guiding", values)


def _facing(r: Request, edges: Edges) -> np.ndarray:
    """Share of points of the lights for which each edge can be a silhouette."""
    count = edges.cdf.shape[0] - 1
    kernel = make_facing_kernel(r.config)
    random = np.random.default_rng((r.seed, len(TECHNIQUES)))
    strata = np.stack([random.permutation(FACING) for _ in range(2)], axis=1)
    points = wp.array((strata + random.random((FACING, 2))) / FACING, dtype=wp.vec2d, device=r.scene.device)
    out = wp.zeros(count, dtype=wp.float32, device=r.scene.device)
    _run(r, kernel, count, lambda first: [r.scene.data(), edges, first, points], [out])
    return out.numpy().astype(np.float64)


def _run(r: Request, kernel: wp.Kernel, count: int, inputs: Callable[[int], list], outputs: list) -> None:
    """Launch one thread an item; every one has an output of its own, so chunks may run side by side."""
    launch_lanes(
        kernel, count, lambda first, _n, _lane: (inputs(first), outputs), lanes=workers.LANES, device=r.scene.device
    )

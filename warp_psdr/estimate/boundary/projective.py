"""Host side of projective sampling [ZRJ23]: seeds from path segments (``kernels/boundary/guiding/projective.py``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch_shards
from warp_psdr.estimate.jobs import sample_job
from warp_psdr.kernels.boundary.guiding.path_segments import BLOCKED_LIGHT, SCATTERED
from warp_psdr.kernels.boundary.guiding.projective import make_seeds_kernel
from warp_psdr.kernels.boundary.guiding.projective_exact import make_exact_seeds_kernel
from warp_psdr.kernels.boundary.silhouette.exact_touch import OutlineItems
from warp_psdr.kernels.constants import DELTA_LIGHTS
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.boundary import Projective
from warp_psdr.topology.neighbours import neighbours

if TYPE_CHECKING:
    from warp_psdr.estimate.boundary.terms import Request
    from warp_psdr.kernels.boundary.local_form import Edges

#: Share of the uniform wedge beside point, spot and directional lights.
POINT_LIKE_SHARE = 0.5
#: Sub-stream of the seeds' random numbers, beside those of the terms.
SEEDS = 4
#: Largest share of all seeds that one path's segment may make up: a few paths of large weight must not hide the others.
MOST_COPIES = 0.01
#: Weights (N,) of paths, and the points (N, 3) of the cubes of the two techniques that their segments are projected to.
Traced = tuple[np.ndarray, np.ndarray, np.ndarray]


def uniform_share(r: Request) -> float:
    """Share of the samples whose direction is uniform in the wedge, unguided: all but what only aiming can reach."""
    return POINT_LIKE_SHARE if set(r.config.lights.others) & DELTA_LIGHTS else 1.0


def asker(r: Request) -> Callable[[str, Edges], np.ndarray]:
    """Return what ``guiding.store.guide`` asks for the seeds of a technique; paths are traced once, at the first."""
    found: dict[str, np.ndarray] = {}

    def ask(technique: str, edges: Edges) -> np.ndarray:
        if not found:
            assert isinstance(r.method, Projective)
            found.update(seeds(r, edges, r.method.paths))
        return found[technique]

    return ask


def seeds(r: Request, edges: Edges, paths: int) -> dict[str, np.ndarray]:
    """Trace camera paths and project their segments.

    Args:
        r: the boundary term.
        edges: whose cumulative probabilities the first coordinate runs through.
        paths: how many, for each kind of ray.

    Returns:
        technique -> (N, 3) points of its cube, repeated in proportion to the weight of their paths.
    """
    head = [r.scene.data(), r.camera, edges, neighbours(r.scene, edges), r.scene.radius]

    def trace(kind: int) -> Traced:
        tail = [mix_seed(r.seed, SEEDS + kind), r.plan.max_depth, r.rr_depth]
        return _trace(r, make_seeds_kernel(r.config, kind), paths, lambda first: [*head, first, *tail])

    return _both(r, trace)


def exact_asker(r: Request, items: OutlineItems) -> Callable[[str], np.ndarray]:
    """Return what guiding asks for the seeds of a technique at exact shapes; paths are traced once, at the first."""
    found: dict[str, np.ndarray] = {}

    def ask(technique: str) -> np.ndarray:
        if not found:
            found.update(exact_seeds(r, items))
        return found[technique]

    return ask


def exact_seeds(r: Request, items: OutlineItems) -> dict[str, np.ndarray]:
    """Trace camera paths and project their segments to the outlines of exact shapes, as ``seeds`` to edges."""
    assert isinstance(r.method, Projective)
    paths = r.method.paths
    head = [r.scene.data(), r.camera, items, r.scene.radius]
    none = wp.zeros((1, 1), dtype=wp.vec3, device=r.scene.device)

    def trace(kind: int) -> Traced:
        seed = mix_seed(r.seed, SEEDS + kind)

        def inputs(first: int) -> list:
            return [*head, sample_job(first, paths, seed, r.plan.max_depth, r.rr_depth, none)]

        return _trace(r, make_exact_seeds_kernel(r.config, kind), paths, inputs)

    return _both(r, trace)


def _both(r: Request, trace: Callable[[int], Traced]) -> dict[str, np.ndarray]:
    """Return the seeds of both techniques."""
    random = np.random.default_rng((r.seed, SEEDS))
    blocked = trace(BLOCKED_LIGHT)
    wedge = [_resampled(blocked[0], blocked[1], random)]
    # Aiming at lights finds all direct light but what comes from infinity.
    if r.plan.max_depth != 2 or r.scene.builder.environment >= 0:
        scattered = trace(SCATTERED)
        wedge.append(_resampled(scattered[0], scattered[1], random))
    return {"wedge": np.concatenate(wedge), "light": _resampled(blocked[0], blocked[2], random)}


def _trace(r: Request, kernel: wp.Kernel, paths: int, inputs: Callable[[int], list]) -> Traced:
    device = r.scene.device
    weight = wp.zeros(paths, dtype=wp.float32, device=device)
    wedge, light = (wp.zeros(paths, dtype=wp.vec3d, device=device) for _ in range(2))
    launch_shards(
        kernel,
        paths,
        lambda first, _n, _shard: (inputs(first), [weight, wedge, light]),
        shards=workers.SHARDS,
        device=device,
    )
    return r.scene.invalid.drop("guiding", weight.numpy().astype(np.float64)), wedge.numpy(), light.numpy()


def _resampled(weight: np.ndarray, points: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return the points of the cube, each as often as its weight says (systematic resampling)."""
    inside = (weight > 0.0) & ((points >= 0.0) & (points < 1.0)).all(axis=1)
    weight, points = weight[inside], points[inside]
    if not len(points):
        return points
    count = len(points)
    share = np.minimum(weight / weight.sum(), max(MOST_COPIES, 1.0 / count))
    sums = np.cumsum(share / share.sum())
    at = (np.arange(count) + random.random()) / count
    return points[np.minimum(np.searchsorted(sums, at), count - 1)]

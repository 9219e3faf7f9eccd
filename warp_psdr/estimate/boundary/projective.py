"""Host side of projective sampling [ZRJ23]: seeds from path segments (``kernels/boundary/guiding/projective.py``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch_shards
from warp_psdr.kernels.boundary.guiding.projective import BLOCKED_LIGHT, SCATTERED, make_seeds_kernel
from warp_psdr.kernels.constants import DELTA_LIGHTS
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.boundary import Projective
from warp_psdr.topology.neighbours import neighbours

if TYPE_CHECKING:
    from warp_psdr.estimate.boundary.terms import Request
    from warp_psdr.kernels.boundary.guiding.projective import Neighbours
    from warp_psdr.kernels.boundary.local_form import Edges

#: Share of the uniform wedge beside point, spot and directional lights.
POINT_LIKE_SHARE = 0.5
#: Sub-stream of the seeds' random numbers, beside those of the terms.
SEEDS = 4
#: Largest share of all seeds that one path's segment may make up: a few paths of large weight must not hide the others.
MOST_COPIES = 0.01


def uniform_share(r: Request) -> float:
    """Share of the samples whose direction is uniform in the wedge, unguided: all but what only aiming can reach."""
    return POINT_LIKE_SHARE if set(r.config.lights) & DELTA_LIGHTS else 1.0


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
    random = np.random.default_rng((r.seed, SEEDS))
    around = neighbours(r.scene, edges)
    blocked = _trace(r, edges, around, BLOCKED_LIGHT, paths)
    wedge = [_resampled(blocked[0], blocked[1], random)]
    # Aiming at lights finds all direct light but what comes from infinity.
    if r.plan.max_depth != 2 or r.scene.builder.environment >= 0:
        scattered = _trace(r, edges, around, SCATTERED, paths)
        wedge.append(_resampled(scattered[0], scattered[1], random))
    return {"wedge": np.concatenate(wedge), "light": _resampled(blocked[0], blocked[2], random)}


def _trace(
    r: Request, edges: Edges, around: Neighbours, kind: int, paths: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    device = r.scene.device
    weight = wp.zeros(paths, dtype=wp.float32, device=device)
    wedge, light = (wp.zeros(paths, dtype=wp.vec3d, device=device) for _ in range(2))
    head = [r.scene.data(), r.camera, edges, around, r.scene.radius]
    tail = [mix_seed(r.seed, SEEDS + kind), r.plan.max_depth, r.rr_depth]
    launch_shards(
        make_seeds_kernel(r.config, kind),
        paths,
        lambda first, _n, _shard: ([*head, first, *tail], [weight, wedge, light]),
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

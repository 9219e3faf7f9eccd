"""Guiding by a regular grid [ZMY*20, section 6.3], filled from photon and importon maps."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch_shards
from warp_psdr.estimate.guiding.build import QUANTUM, Growth, Leaves, Target
from warp_psdr.estimate.guiding.photons import PhotonMap, importon_map, photon_map
from warp_psdr.kernels.boundary.guiding.ends import make_ends_kernel
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.guiding import Grid
from warp_psdr.plan.motion import moving_shapes

#: Vertices of a photon's or importon's path where the depth has no limit: deeper ones are spread out anyway.
UNBOUNDED_VERTICES = 8
#: Sub-streams of the two maps.
PHOTONS, IMPORTONS = 10, 11


def build(method: Grid, target: Target) -> Leaves:
    """Return the grid's cells, with masses from the maps."""
    growth = Growth(target)
    cells = regular(growth, method.shape)
    low, high = growth.low[cells, None], growth.high[cells, None]
    points = low + target.random.random((len(cells), method.samples, 3)) * (high - low)
    values = _integrand(method, target, points.reshape(-1, 3)).reshape(len(cells), method.samples)
    growth.square[cells] = (values**2).mean(axis=1)
    return growth.finish()


def _integrand(method: Grid, target: Target, points: np.ndarray) -> np.ndarray:
    """Return radiance times importance times the measure at points (N, 3) of the cube."""
    r = target.request
    depth = r.plan.max_depth
    bounces = UNBOUNDED_VERTICES if depth < 0 else depth - 1
    if not target.shared:
        seeds = [mix_seed(r.seed, stream) for stream in (IMPORTONS, PHOTONS)]
        target.shared["importons"] = importon_map(r.scene, r.camera, r.config, method.importons, bounces, seeds[0])
        # x_2 is at least the second vertex, and light that it scatters takes another.
        target.shared["photons"] = photon_map(r.scene, r.config, method.photons, bounces - 1, seeds[1])
    importons, photons = target.shared["importons"], target.shared["photons"]
    return _Ends(target, points).integrand(importons, photons, method.neighbours)


def regular(growth: Growth, shape: tuple[int, int, int]) -> np.ndarray:
    """Split the cube into shape[0] x shape[1] x shape[2] equal cells; return their nodes."""
    for axis, count in enumerate(shape):
        node = growth.leaves()
        first, last = np.zeros(len(node), np.int64), np.full(len(node), count)
        while True:
            more = last - first > 1
            if not more.any():
                break
            first, last, node = first[more], last[more], node[more]
            middle = (first + last) // 2
            at = np.round(middle / count / QUANTUM) * QUANTUM
            node = growth.split(node, np.full(len(node), axis), at)
            first, last = (np.stack(pair, axis=1).reshape(-1) for pair in ((first, middle), (middle, last)))
    return growth.leaves()


class _Ends:
    """End points of the segments at points of the cube (``kernels/boundary/guiding/ends.py``)."""

    def __init__(self, target: Target, points: np.ndarray):
        r, count = target.request, len(points)
        device = r.scene.device
        guide = Guide()
        guide.share = 0.5
        guide.points = wp.array(np.ascontiguousarray(points, np.float64), dtype=wp.vec3d, device=device)
        x1, x2 = (wp.zeros(count, dtype=wp.vec3, device=device) for _ in range(2))
        emitted, scale = (wp.zeros(count, dtype=wp.float32, device=device) for _ in range(2))
        scatters = wp.zeros(count, dtype=wp.int32, device=device)
        moving = moving_shapes(r.scene, r.moves)
        technique = 1 if target.technique == "wedge" else 0
        head = [r.scene.data(), target.edges, moving, guide]
        outputs = [x1, x2, emitted, scatters, scale]
        launch_shards(
            make_ends_kernel(r.config),
            count,
            lambda first, _n, _shard: ([*head, first, technique, r.plan.max_depth == 2], outputs),
            shards=workers.SHARDS,
            device=device,
        )
        self.scale = r.scene.invalid.drop("guiding", scale.numpy().astype(np.float64))
        self.x1, self.x2 = x1.numpy().astype(np.float64), x2.numpy().astype(np.float64)
        self.emitted, self.scatters = emitted.numpy().astype(np.float64), scatters.numpy() == 1

    def integrand(self, importons: PhotonMap, photons: PhotonMap, neighbours: int) -> np.ndarray:
        used = self.scale > 0.0
        radiance = self.emitted.copy()
        far = used & self.scatters
        radiance[far] += photons.leaving(self.x2[far], neighbours)
        used &= radiance > 0.0
        values = np.zeros(len(used))
        values[used] = self.scale[used] * radiance[used] * importons.leaving(self.x1[used], neighbours)
        return values

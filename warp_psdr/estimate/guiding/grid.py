"""Guiding by a regular grid [ZMY*20, section 6.3], filled from photon and importon maps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch_shards
from warp_psdr.estimate.guiding.build import QUANTUM, Growth, Leaves, Target
from warp_psdr.estimate.guiding.photons import PhotonMap, importon_map, photon_map
from warp_psdr.estimate.jobs import sample_job
from warp_psdr.kernels.boundary.guiding.cube import END_NUMBERS
from warp_psdr.kernels.boundary.guiding.ends import make_ends_kernel
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.guiding import Grid
from warp_psdr.plan.motion import moving_shapes

if TYPE_CHECKING:
    from warp_psdr.estimate.boundary.terms import Request
    from warp_psdr.kernels.boundary.local_form import Edges

#: Vertices of a photon's or importon's path where the depth has no limit: deeper ones are spread out anyway.
UNBOUNDED_VERTICES = 8
#: Sub-streams of the two maps.
PHOTONS, IMPORTONS = 10, 11
#: Sub-stream of what a segment's ends need random numbers for.
ENDS = 12


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
    return target.ends(target.technique, points).integrand(importons, photons, method.neighbours)


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


@dataclass(frozen=True, eq=False)
class Ends:
    """End points of the segments at N points of the cube (``kernels/boundary/guiding/ends.py``).

    Attributes:
        scale: (N,) the measure over the density; 0: there is no segment.
        emitted: (N,) what x_2 emits.
        scatters: (N,) whether x_2 scatters light.
        x1: (N, 3) the end towards the camera.
        x2: (N, 3) that towards the light.
    """

    scale: np.ndarray
    emitted: np.ndarray
    scatters: np.ndarray
    x1: np.ndarray
    x2: np.ndarray

    def integrand(self, importons: PhotonMap, photons: PhotonMap, neighbours: int) -> np.ndarray:
        """Return radiance times importance times the measure (N,)."""
        used = self.scale > 0.0
        radiance = self.emitted.copy()
        far = used & self.scatters
        radiance[far] += photons.leaving(self.x2[far], neighbours)
        used &= radiance > 0.0
        values = np.zeros(len(used))
        values[used] = self.scale[used] * radiance[used] * importons.leaving(self.x1[used], neighbours)
        return values


def edge_ends(r: Request, edges: Edges, technique: str, points: np.ndarray) -> Ends:
    """Return the ends of segments at edges, of points (N, 3) of the cube."""
    count, device = len(points), r.scene.device
    guide = Guide()
    guide.share = 0.5
    guide.points = wp.array(np.ascontiguousarray(points, np.float64), dtype=wp.vec3d, device=device)
    x1, x2 = (wp.zeros(count, dtype=wp.vec3, device=device) for _ in range(2))
    emitted, scale = (wp.zeros(count, dtype=wp.float32, device=device) for _ in range(2))
    scatters = wp.zeros(count, dtype=wp.int32, device=device)
    head = [r.scene.data(), edges, moving_shapes(r.scene, r.vertex_motion), guide]
    outputs = [x1, x2, emitted, scatters, scale]
    number = 1 if technique == "wedge" else 0
    launch_shards(
        make_ends_kernel(r.config),
        count,
        lambda first, _n, _shard: ([*head, first, number, r.plan.max_depth == 2], outputs),
        shards=workers.SHARDS,
        device=device,
    )
    return Ends(
        scale=r.scene.invalid.drop("guiding", scale.numpy().astype(np.float64)),
        emitted=emitted.numpy().astype(np.float64),
        scatters=scatters.numpy() == 1,
        x1=x1.numpy().astype(np.float64),
        x2=x2.numpy().astype(np.float64),
    )


def surface_ends(r: Request, kernel: wp.Kernel, head: list, technique: str, points: np.ndarray) -> Ends:
    """Return the ends of segments that touch shapes without triangles, by a kernel of the role "ends"."""
    count, device = len(points), r.scene.device
    guide = Guide()
    guide.points = wp.array(np.ascontiguousarray(points, np.float64), dtype=wp.vec3d, device=device)
    guide.technique = 1 if technique == "wedge" else 0
    out = wp.zeros(END_NUMBERS * count, dtype=wp.float32, device=device)
    none = wp.zeros((1, 1), dtype=wp.vec3, device=device)
    seed = mix_seed(r.seed, ENDS)
    launch_shards(
        kernel,
        count,
        lambda first, _n, _shard: (
            [*head, guide, sample_job(first, 1, seed, r.plan.max_depth, r.rr_depth, none)],
            [out, none],
        ),
        shards=workers.SHARDS,
        device=device,
    )
    found = out.numpy().reshape(count, END_NUMBERS).astype(np.float64)
    return Ends(
        scale=r.scene.invalid.drop("guiding", found[:, 0]),
        emitted=found[:, 1],
        scatters=found[:, 2] == 1.0,
        x1=found[:, 3:6],
        x2=found[:, 6:9],
    )

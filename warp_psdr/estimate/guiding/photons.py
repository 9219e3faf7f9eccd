"""Photon and importon maps: k-nearest density estimates of leaving radiance and importance [ZMY*20, section 6.3]."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch_shards
from warp_psdr.kernels.boundary.guiding.photons import make_importons_kernel, make_photons_kernel

if TYPE_CHECKING:
    from warp_psdr.kernels.structs import Camera
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class PhotonMap:
    """Points with weights, N of them.

    Attributes:
        points: (N, 3) on surfaces.
        weights: (N,) what each of them scatters on: watts, or pixels of importance.
    """

    points: np.ndarray
    weights: np.ndarray

    @cached_property
    def _tree(self):
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    def leaving(self, x: np.ndarray, neighbours: int) -> np.ndarray:
        """Estimate the radiance, or the importance, that leaves diffuse surfaces at points x.

        Args:
            x: (M, 3).
            neighbours: number k of nearest points; the radius r is the distance of the farthest.

        Returns:
            (M,): the sum of the k weights over pi^2 r^2 (a disk, and pi for the hemisphere's cosine).
        """
        k = min(neighbours, len(self.points))
        if k == 0 or not len(x):
            return np.zeros(len(x))
        distance, index = self._tree.query(x, k=k)
        distance, index = distance.reshape(len(x), k), index.reshape(len(x), k)
        area = math.pi * np.maximum(distance[:, -1] ** 2, 1e-30)
        return self.weights[index].sum(axis=1) / (math.pi * area)


def photon_map(scene: Scene, config: PathConfig, count: int, vertices: int, seed: int) -> PhotonMap:
    """Trace light paths.

    Args:
        scene: with at least one light.
        config: of the path loop.
        count: light paths.
        vertices: most photons of a path.
        seed: of their random numbers.
    """
    if vertices < 1:
        return PhotonMap(np.zeros((0, 3)), np.zeros(0))
    points = scene.points
    low, high = points.min(axis=0), points.max(axis=0)
    center, radius = wp.vec3(*(0.5 * (low + high)).tolist()), 0.5 * float(np.linalg.norm(high - low))
    kernel = make_photons_kernel(config)
    return _collect(scene, kernel, [scene.data(), center, radius, seed], count, vertices, 1.0 / count)


def importon_map(scene: Scene, camera: Camera, config: PathConfig, count: int, vertices: int, seed: int) -> PhotonMap:
    """Trace camera paths (arguments as in ``photon_map``); the weight of a camera path is its share of the pixels."""
    pixels = camera.crop_width * camera.crop_height
    kernel = make_importons_kernel(config)
    return _collect(scene, kernel, [scene.data(), camera, seed], count, vertices, pixels / count)


def _collect(scene: Scene, kernel: wp.Kernel, inputs: list, count: int, vertices: int, scale: float) -> PhotonMap:
    x = wp.zeros((count, vertices), dtype=wp.vec3, device=scene.device)
    weight = wp.zeros((count, vertices), dtype=wp.float32, device=scene.device)
    launch_shards(
        kernel,
        count,
        lambda first, _n, _shard: ([*inputs, first], [x, weight]),
        shards=workers.SHARDS,
        device=scene.device,
    )
    flat = scene.invalid.drop("guiding", weight.numpy().reshape(-1).astype(np.float64))
    keep = flat > 0.0
    return PhotonMap(x.numpy().reshape(-1, 3)[keep].astype(np.float64), scale * flat[keep])

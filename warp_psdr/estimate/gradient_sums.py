"""Sums of the shards' gradients, in double precision.

Every shard of a launch adds to its own sums (``kernels/sink.py``), which are added up in a fixed order. A gradient
therefore has the same bits for any number of workers, and its last digits do not depend on the number of samples.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch
from warp_psdr.kernels.reduction import add_lanes
from warp_psdr.scene.derived_values import derived_ranges, pull_derived

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


class GradientSums:
    """The gradient of some parameters in the making.

    Args:
        scene: the scene.
        names: of the parameters.

    Attributes:
        buffers: what the shards of a launch add to, a shard each: the memory of its float64 sums as twice as many
            float32, the type that device code has for gradients and tangents.
    """

    def __init__(self, scene: Scene, names: list[str]):
        self._scene, self._names = scene, names
        size = scene.values.shape[0]
        shards = workers.shard_count(size) if scene.device.is_cpu else 1
        self._sums = _zeros((shards, size), np.float64, scene.device)
        self.buffers = [
            wp.array(ptr=self._sums[shard].ptr, dtype=wp.float32, shape=(2 * size,), device=scene.device, copy=False)
            for shard in range(shards)
        ]
        ranges = [(scene.parameters[n].offset, scene.parameters[n].size) for n in names]
        self._ranges = list(dict.fromkeys(ranges + derived_ranges(scene, names)))

    def result(self, shard: int | None = None) -> wp.array:
        """Return the flat gradient, or what one shard adds to it: (values,) float32, pulled to poses and positions."""
        sums = self._sums if shard is None else self._sums[shard : shard + 1]
        flat = _zeros((self._sums.shape[1],), np.float32, self._scene.device)
        for offset, size in self._ranges:
            launch(add_lanes, dim=size, inputs=[sums, offset], outputs=[flat], device=self._scene.device)
        pull_derived(self._scene, self._names, flat)
        return flat


def _zeros(shape: tuple[int, ...], dtype: type, device: wp.Device) -> wp.array:
    """Return zeros; on the CPU memory is taken where they are written, and most values get no gradient."""
    if device.is_cpu:
        return wp.array(np.zeros(shape, dtype), device=device, copy=False)
    return wp.zeros(shape, dtype=wp.dtype_from_numpy(dtype), device=device)

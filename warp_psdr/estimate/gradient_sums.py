"""Sums of the shards' gradients, in double precision.

Every shard of a launch adds to its own sums (``kernels/sink.py``), which are added pairwise. A gradient therefore has
the same bits for any number of workers, and its last digits do not depend on the number of samples.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch
from warp_psdr.kernels.reduction import add_range, round_range
from warp_psdr.scene.derived_values import derived_ranges, pull_derived

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


class GradientSums:
    """The gradient of some parameters in the making.

    Args:
        scene: the scene.
        names: of the parameters.
        share: which of the shards add to it.

    Attributes:
        shards: how many a launch has at most, all shares together.
    """

    def __init__(self, scene: Scene, names: list[str], share: workers.Share = workers.WHOLE):
        self._scene, self._names = scene, names
        self._size = scene.values.shape[0]
        self.shards = workers.shard_count(self._size) if scene.device.is_cpu else 1
        own = share.of(self.shards) if scene.device.is_cpu else range(1)
        self._first = own.start
        self._sums = _zeros((max(len(own), 1), self._size), np.float64, scene.device)
        self._buffers: dict[int, wp.array] = {}
        ranges = [(scene.parameters[n].offset, scene.parameters[n].size) for n in names]
        self._ranges = _united(ranges + derived_ranges(scene, names))

    def buffer(self, shard: int, shards: int | None = None) -> wp.array:
        """Return what a shard of a launch adds to.

        It is the memory of its float64 sums as twice as many float32, the type that device code has for gradients and
        tangents.

        Args:
            shard: of the launch.
            shards: of the launch, a power of two; None: as many as these sums have.
        """
        lane = shard * self.shards // (shards or self.shards) - self._first
        if lane not in self._buffers:
            shape, device = (2 * self._size,), self._scene.device
            ptr = self._sums.ptr + lane * self._sums.strides[0]
            self._buffers[lane] = wp.array(ptr=ptr, dtype=wp.float32, shape=shape, device=device, copy=False)
        return self._buffers[lane]

    def total(self) -> np.ndarray:
        """Return the sum over the shards, float64, of all values that gradients are pulled from, one after the other.

        May be called once: it overwrites the shards' sums.
        """
        self._add_up()
        row = self._sums[0].numpy()
        return np.concatenate([row[offset : offset + size] for offset, size in self._ranges])

    def take(self, total: np.ndarray) -> None:
        """Take what ``total`` of the same parameters returned, elsewhere or of other shards, in place of the sums."""
        flat = np.zeros(self._size)
        ends = np.cumsum([size for _offset, size in self._ranges])
        for (offset, size), values in zip(self._ranges, np.split(total, ends[:-1]), strict=True):
            flat[offset : offset + size] = values
        self._sums = wp.array(flat[None], dtype=wp.float64, device=self._scene.device)

    def result(self, shard: int | None = None) -> wp.array:
        """Return the flat gradient, or what one shard adds to it: (values,) float32, pulled to poses and positions.

        That of all of them may be called once: it overwrites the shards' sums.
        """
        if shard is None:
            self._add_up()
        flat = _zeros((self._size,), np.float32, self._scene.device)
        row = self._sums[shard or 0]
        for offset, size in self._ranges:
            launch(round_range, dim=size, inputs=[row, offset], outputs=[flat], device=self._scene.device)
        pull_derived(self._scene, self._names, flat)
        return flat

    def _add_up(self) -> None:
        """Add the shards' sums up in the first of them."""
        if self._sums.shape[0] > 1:  # never on CUDA
            for offset, size in self._ranges:
                workers.add_pairs(self._sums.numpy()[:, offset : offset + size])


def add_to_gradient(array: wp.array, total: wp.array, offset: int) -> None:
    """Add a stretch of flat values, float32, to the gradient of the array that holds a parameter.

    The gradient's standard deviation (``batches.py``), if it was told, is not known any more.
    """
    vars(array).pop("std", None)
    grad = array.grad
    size = grad.size * wp.types.type_size(grad.dtype)
    flat = wp.array(ptr=grad.ptr, dtype=wp.float32, shape=(size,), device=grad.device, copy=False)
    launch(add_range, dim=size, inputs=[total, offset], outputs=[flat], device=grad.device)


def _united(ranges: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return ranges (offset, size) in order, those that overlap as one: each value is added up once."""
    found: list[tuple[int, int]] = []
    for offset, size in sorted(ranges):
        first, end = found[-1] if found else (0, 0)
        if found and offset < first + end:
            found[-1] = (first, max(end, offset + size - first))
        else:
            found.append((offset, size))
    return found


def _zeros(shape: tuple[int, ...], dtype: type, device: wp.Device) -> wp.array:
    """Return zeros; on the CPU memory is taken where they are written, and most values get no gradient."""
    if device.is_cpu:
        return wp.array(np.zeros(shape, dtype), device=device, copy=False)
    return wp.zeros(shape, dtype=wp.dtype_from_numpy(dtype), device=device)

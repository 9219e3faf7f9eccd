"""Sums of the lanes' gradients.

Every lane of a launch adds to a flat float32 buffer of its own. Such a sum loses digits with its length
(``kernels/reduction.py``), so after ``most`` samples the lanes are added to a total in double precision and cleared.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.device import launch
from warp_psdr.kernels.reduction import add_lanes, round_range
from warp_psdr.scene.chain import derived_ranges, pull_derived

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Samples of a lane whose gradients are summed in float32: relative rounding errors of some 1e-6 (see
#: ``kernels/reduction.py``), and of 1e-3 where all terms are equal, which is free of noise. Fewer would cost time.
BUFFER_SAMPLES = 1 << 16


class GradientSums:
    """The gradient of some parameters in the making.

    Args:
        scene: the scene.
        names: of the parameters.

    Attributes:
        buffers: (lanes, values), what the lanes of a launch add to.
        most: samples of one launch, all lanes together, after which ``collect`` has to be called.
    """

    def __init__(self, scene: Scene, names: list[str]):
        self._scene, self._names = scene, names
        size = scene.values.shape[0]
        lanes = workers.lane_count(size) if scene.device.is_cpu else 1
        self.buffers = _zeros((lanes, size), np.float32, scene.device)
        self.most = BUFFER_SAMPLES * lanes
        self._total = _zeros((size,), np.float64, scene.device)
        ranges = [(scene.parameters[n].offset, scene.parameters[n].size) for n in names]
        self._ranges = list(dict.fromkeys(ranges + derived_ranges(scene, names)))

    def collect(self) -> None:
        """Add the lanes up, in fixed order, and clear them."""
        for offset, size in self._ranges:
            inputs, outputs = [self.buffers, offset], [self._total]
            launch(add_lanes, dim=size, inputs=inputs, outputs=outputs, device=self._scene.device)

    def result(self) -> wp.array:
        """Return the flat gradient, (values,) float32, pulled back to poses and positions."""
        flat = _zeros(self._total.shape, np.float32, self._scene.device)
        for offset, size in self._ranges:
            launch(round_range, dim=size, inputs=[self._total, offset], outputs=[flat], device=self._scene.device)
        pull_derived(self._scene, self._names, flat)
        return flat


def _zeros(shape: tuple[int, ...], dtype: type, device: wp.Device) -> wp.array:
    """Return zeros; on the CPU memory is taken where they are written, and most values get no gradient."""
    if device.is_cpu:
        return wp.array(np.zeros(shape, dtype), device=device, copy=False)
    return wp.zeros(shape, dtype=wp.dtype_from_numpy(dtype), device=device)

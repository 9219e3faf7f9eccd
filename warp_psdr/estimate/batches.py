"""Error bars of gradients: one gradient as the mean of eight, of independent random numbers and fewer samples.

Each has its own randomisation of the Sobol points (randomised quasi-Monte Carlo), so that their scatter tells the error
of their mean, stratification and guiding included.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.estimate.arguments import sample_count
from warp_psdr.estimate.gradient_sums import add_to_gradient
from warp_psdr.estimate.passes import Progress, part
from warp_psdr.estimate.views import count_of_views
from warp_psdr.kernels.rng import mix_seed

if TYPE_CHECKING:
    from warp_psdr.scene.description import Views
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene

#: Independent gradients. Their standard deviation has seven degrees of freedom.
BATCHES = 8
#: Stream of their random numbers: none is that of a gradient of a neighbouring seed.
STREAM_BARS = 0x62617273

#: Adds a gradient to arrays, by name: (arrays, samples a pixel, seed, progress).
Add = Callable[[dict[str, wp.array], int, int, Progress | None], None]


def count_in_batches(scene: Scene, views: Views, spp: int | None) -> int:
    """Return the samples a pixel of all batches.

    Raises:
        ValueError: they cannot be split into eighths, or sensors have each their own count.
    """
    count = count_of_views(scene, views, spp) if views.several else sample_count(scene, views.sensors[0], spp)
    if count is None:
        raise ValueError("errors=True: several sensors have each their own sample count; give spp")
    if count % BATCHES:
        raise ValueError(f"errors=True: got {count} samples a pixel; they are split into {BATCHES} equal batches")
    return count


def add_in_batches(
    params: Parameters, names: Sequence[str], add: Add, spp: int, seed: int, progress: Progress | None
) -> None:
    """Add a gradient to ``params[name].grad``, and its variance to the square of ``params[name].std``.

    Raises:
        ValueError: a gradient without error bars is there already.
    """
    for name in names:
        if not hasattr(params[name], "std") and params[name].grad.numpy().any():
            raise ValueError(f"errors=True: {name!r} has a gradient without error bars; call params.zero_grad() first")
    held = {n: wp.zeros(params[n].shape, params[n].dtype, params[n].device, requires_grad=True) for n in names}
    mean, squares = ({n: np.zeros(held[n].grad.numpy().shape) for n in names} for _ in range(2))
    for batch in range(BATCHES):
        add(
            held,
            spp // BATCHES,
            mix_seed(mix_seed(seed, STREAM_BARS), batch),
            part(progress, batch / BATCHES, 1.0 / BATCHES),
        )
        for name, array in held.items():  # Welford's sums
            found = array.grad.numpy().astype(np.float64)
            apart = found - mean[name]
            mean[name] += apart / (batch + 1)
            squares[name] += apart * (found - mean[name])
            array.grad.zero_()
    for name in names:
        array = params[name]
        before = getattr(array, "std", None)
        total = wp.array(mean[name].ravel().astype(np.float32), dtype=wp.float32, device=array.device)
        add_to_gradient(array, total, 0)
        variance = squares[name] / (BATCHES * (BATCHES - 1))
        if before is not None:
            variance += before.numpy().astype(np.float64) ** 2
        array.std = wp.array(  # type: ignore[attr-defined]
            np.sqrt(variance).astype(np.float32), dtype=array.dtype, device=array.device
        )

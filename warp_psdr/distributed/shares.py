"""How a call is split into jobs, and what comes back of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.options.boundary import PathSpace

if TYPE_CHECKING:
    from warp_psdr.distributed.jobs import Done
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.scene.scene import Scene

#: Shares of a call for every process: more balance better, each costs some milliseconds.
SHARES_PER_PROCESS = 4


class Fractions:
    """Tells the finished fraction of jobs that are sent one after the other."""

    def __init__(self, progress: Callable[[float], None] | None):
        self._progress, self._done, self._all = progress, 0, 0

    def expect(self, jobs: int) -> Callable[[], None]:
        """Return what is called as each of so many more jobs is done."""
        self._all += jobs
        return self._told

    def _told(self) -> None:
        self._done += 1
        if self._progress is not None:
            self._progress(min(self._done / self._all, 1.0))


def shares(processes: int, calls: int, shards: int) -> int:
    """Return into how many shares each of some calls is split, a power of two; results do not depend on it.

    ``shards``: of a call on the CPU.
    """
    wanted = max(math.ceil(SHARES_PER_PROCESS * processes / calls), 1)
    return min(workers.below(2 * wanted - 1), shards)


def refuse_guiding(integrator: PathIntegrator) -> None:
    """Refuse a guided boundary term, whose structures keep what earlier gradients have found.

    Raises:
        ValueError: the integrator names a guiding method.
    """
    guiding = getattr(integrator.boundary, "guiding", None)
    if guiding is not None:
        raise ValueError(
            f"boundary: {type(guiding).__name__} keeps a structure from one gradient to the next, which processes of a "
            f"pool do not share; say PathIntegrator(boundary={PathSpace.__name__}()), or call psdr.render_backward"
        )


def count(scene: Scene, done: Done) -> None:
    """Count what the jobs drew and dropped as this scene's."""
    for kind, found in done.invalid.items():
        scene.invalid.add(kind, found.samples, found.invalid, found.first)


def on_device(values: np.ndarray, scene: Scene) -> Any:
    """Return sums as kernels take them: films and images as vectors, gradients as they are."""
    if values.ndim == 1:
        return values
    scalar = wp.float64 if values.dtype == np.float64 else wp.float32
    return wp.array(values, dtype=wp.types.vector(values.shape[-1], scalar), device=scene.device)

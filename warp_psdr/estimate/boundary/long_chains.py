"""The share of the image that lies behind long chains of mirrors and glass, measured once a scene and camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.device import launch
from warp_psdr.estimate.jobs import sample_job
from warp_psdr.kernels.boundary.specular.long_chains import make_long_chains_kernel
from warp_psdr.plan import long_chains

if TYPE_CHECKING:
    from warp_psdr.estimate.boundary.terms.request import Request

#: Paths: a share of a hundredth is told to a tenth of it.
PATHS = 1 << 14
#: Stream of their random numbers.
SEED = 0x6C6F6E67


def check(r: Request) -> None:
    """Measure the share if it is not known, and refuse a gradient that would leave out too much.

    Raises:
        ValueError: it would.
    """
    if not long_chains.possible(r.plan.max_depth):
        return
    known, key = long_chains.known(r.scene), (r.sensor, r.plan.max_depth)
    if key not in known:
        known[key] = _measured(r)
    long_chains.refuse(known[key])


def _measured(r: Request) -> float:
    device = r.scene.device
    found = wp.zeros(PATHS, dtype=wp.vec2, device=device)
    job = sample_job(0, PATHS, SEED, r.plan.max_depth, r.plan.rr_depth, wp.zeros((1, 1), dtype=wp.vec3, device=device))
    inputs = [r.scene.data(), r.camera, job]
    launch(make_long_chains_kernel(r.config), dim=PATHS, inputs=inputs, outputs=[found], device=device)
    total, behind = found.numpy().sum(axis=0, dtype=np.float64)
    return float(behind / total) if total > 0.0 else 0.0

"""Consecutive path vertices at one point: forward mode stays finite and agrees with reverse mode."""

from __future__ import annotations

import numpy as np
import pytest

import warp_psdr as psdr
from tests.boundary import scenes

#: Float32 rounding of a sum over 1024 paths.
ROUNDING = 1e-3


@pytest.mark.slow
def test_ray_that_ends_where_it_started():
    """A found case: one of these paths scatters into a neighbouring triangle at distance zero."""
    scene, params = scenes.load("floating")
    velocity = np.broadcast_to(np.float32([1, -0.5, 0]), params["box.vertex_positions"].numpy().shape)
    integrator = psdr.PathIntegrator(max_depth=3, boundary=None)
    options = {"integrator": integrator, "spp": 1024, "seed": 106}
    image = psdr.render_forward(scene, params, {"box.vertex_positions": velocity}, **options).numpy()
    assert np.isfinite(image).all()
    adjoint = np.zeros_like(image)
    adjoint[2, 2] = 1.0
    params.requires_grad_only("box.vertex_positions")
    psdr.render_backward(scene, params, adjoint, **options)
    reverse = float(np.sum(params["box.vertex_positions"].grad.numpy() * velocity))
    assert image[2, 2].sum() != 0.0
    assert reverse == pytest.approx(float(image[2, 2].sum()), rel=ROUNDING, abs=1e-6)

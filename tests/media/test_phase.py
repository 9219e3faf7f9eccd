"""Phase functions: samples, densities, normalisation, derivatives."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

from tests.path.helpers import SIGNIFICANCE
from warp_psdr.kernels import structs
from warp_psdr.kernels.constants import PHASE_HG
from warp_psdr.kernels.phase.dispatch import make_phase

PHASE = make_phase((PHASE_HG,))


@wp.kernel(enable_backward=False)
def draw(scene: structs.Scene, d: wp.vec3, u: wp.array(dtype=wp.vec2), wo_out: wp.array(dtype=wp.vec3)):
    wo_out[wp.tid()] = wp.static(PHASE.sample)(scene, structs.Medium(), d, u[wp.tid()])


@wp.kernel(enable_backward=False)
def evaluate(scene: structs.Scene, d: wp.vec3, wo: wp.array(dtype=wp.vec3), value_out: wp.array2d(dtype=wp.float32)):
    value_out[wp.tid(), 0] = wp.static(PHASE.eval)(scene, structs.Medium(), d, wo[wp.tid()])
    value_out[wp.tid(), 1] = wp.static(PHASE.slope)(scene, structs.Medium(), d, wo[wp.tid()])


@pytest.mark.parametrize("g", [-0.99, -0.5, 0.0, 1e-4, 0.3, 0.9])
def test_hg_samples_its_density(g):
    """Chi-square of the cosine and of the azimuth; the density integrates to one and its mean cosine is g."""
    phase, n = make_phase((PHASE_HG,)), 1 << 16

    @wp.kernel(module="unique", enable_backward=False)
    def draw(scene: structs.Scene, d: wp.vec3, u: wp.array(dtype=wp.vec2), wo_out: wp.array(dtype=wp.vec3)):
        wo_out[wp.tid()] = phase.sample(scene, structs.Medium(), d, u[wp.tid()])

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(
        scene: structs.Scene, d: wp.vec3, wo: wp.array(dtype=wp.vec3), value_out: wp.array2d(dtype=wp.float32)
    ):
        value_out[wp.tid(), 0] = phase.eval(scene, structs.Medium(), d, wo[wp.tid()])
        value_out[wp.tid(), 1] = phase.slope(scene, structs.Medium(), d, wo[wp.tid()])

    scene = structs.Scene()
    scene.values = wp.array([g], dtype=wp.float32)
    d = np.array([0.36, 0.48, 0.8])
    u = np.random.default_rng(1).random((n, 2)).astype(np.float32)
    wo = wp.zeros(n, dtype=wp.vec3)
    wp.launch(draw, dim=n, inputs=[scene, wp.vec3(*d), wp.array(u, dtype=wp.vec2)], outputs=[wo])
    mu = wo.numpy() @ d
    np.testing.assert_allclose(np.linalg.norm(wo.numpy(), axis=1), 1.0, atol=2e-6)
    # The distribution of the cosine: (1 - g^2) / (2 g) (1 / sqrt(1 + g^2 - 2 g mu) - 1 / (1 + g)).
    edges = np.linspace(-1.0, 1.0, 41)
    root = np.sqrt(1.0 + g * g - 2.0 * g * edges)
    share = (1.0 - g * g) / (2.0 * g) * (1.0 / root - 1.0 / (1.0 + g)) if abs(g) > 0.01 else 0.5 * (edges + 1.0)
    if 0.0 < abs(g) < 0.01:
        share = share + 0.75 * g * (edges**2 - 1.0) / 1.5
    expected = n * np.diff(share)
    expected *= n / expected.sum()
    found, _ = np.histogram(np.clip(mu, -1.0, 1.0), edges)
    used = expected > 10.0
    p = stats.chisquare(
        [*found[used], found[~used].sum() + 1e-9], [*expected[used], expected[~used].sum() + 1e-9]
    ).pvalue
    assert p > SIGNIFICANCE
    turned = np.histogram(np.arctan2(wo.numpy() @ np.array([0.8, 0.0, -0.36]), wo.numpy() @ np.array([0, 1, -0.6])), 16)
    assert turned[0].min() > 0
    nodes, weights = np.polynomial.legendre.leggauss(400)
    sine = np.sqrt(1.0 - nodes**2)
    across = np.cross(d, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(d, [0.0, 0.0, 1.0]))
    grid = wp.array(nodes[:, None] * d + sine[:, None] * across, dtype=wp.vec3)
    out = wp.zeros((400, 2), dtype=wp.float32)
    wp.launch(evaluate, dim=400, inputs=[scene, wp.vec3(*d), grid], outputs=[out])
    values, slopes = out.numpy().astype(np.float64).T
    tolerance = 1e-5 if abs(g) < 0.95 else 2e-3
    assert 2.0 * np.pi * weights @ values == pytest.approx(1.0, abs=tolerance)
    assert 2.0 * np.pi * weights @ (values * nodes) == pytest.approx(g, abs=tolerance)
    if abs(g) < 0.95:
        assert 2.0 * np.pi * weights @ slopes == pytest.approx(0.0, abs=1e-4)
        assert 2.0 * np.pi * weights @ (slopes * nodes) == pytest.approx(1.0, abs=1e-4)

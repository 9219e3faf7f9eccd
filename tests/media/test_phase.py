"""Phase functions: samples, densities, normalisation, derivatives."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

from tests.path.helpers import SIGNIFICANCE
from warp_psdr.kernels import structs
from warp_psdr.kernels.constants import PHASE_BLEND, PHASE_HG, PHASE_ISOTROPIC, PHASE_RAYLEIGH, PHASE_TABLE
from warp_psdr.kernels.phase.dispatch import make_phase, make_phase_sink, make_phase_slopes
from warp_psdr.kernels.phase.hg import hg_slope
from warp_psdr.scene.media.super_grid import integrals


@pytest.mark.slow_rows("-0.5", "0.0001", "0.3")
@pytest.mark.parametrize("g", [-0.99, -0.5, 0.0, 1e-4, 0.3, 0.9])
def test_hg_samples_its_density(g):
    """Chi-square of the cosine and of the azimuth; the density integrates to one and its mean cosine is g."""
    phase, n = make_phase((PHASE_HG,)), 1 << 16

    @wp.kernel(module="unique", enable_backward=False)
    def draw(scene: structs.Scene, d: wp.vec3, u: wp.array(dtype=wp.vec2), wo_out: wp.array(dtype=wp.vec3)):
        wo_out[wp.tid()] = phase.sample(scene, structs.Medium(), wp.vec3(), d, u[wp.tid()])

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(
        scene: structs.Scene, d: wp.vec3, wo: wp.array(dtype=wp.vec3), value_out: wp.array2d(dtype=wp.float32)
    ):
        value_out[wp.tid(), 0] = phase.eval(scene, structs.Medium(), wp.vec3(), d, wo[wp.tid()])
        value_out[wp.tid(), 1] = hg_slope(scene.values[0], wp.dot(d, wo[wp.tid()]))

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


#: A table with a zero, steep and level parts.
TABLE = np.array([0.5, 0.5, 0.0, 0.3, 0.1, 2.0, 4.0], np.float32)


def scene_with(values):
    """A scene that holds nothing but a table: its values, and their integrals behind them."""
    record = structs.Texture()
    record.offset, record.second, record.width, record.channels = 0, len(values), len(values), 1
    scene = structs.Scene()
    scene.values = wp.array(np.concatenate([values, integrals(values)]), dtype=wp.float32)
    scene.textures = wp.array([record], dtype=structs.Texture)
    return scene


@pytest.fixture(scope="module")
def kernels():
    """Samples and values of ``rayleigh`` (number 0) and of a table (1); derivatives by the table's values."""
    phase = make_phase((PHASE_RAYLEIGH, PHASE_TABLE))
    accumulate = make_phase_sink((PHASE_RAYLEIGH, PHASE_TABLE), "forward")

    @wp.func
    def medium(number: wp.int32) -> structs.Medium:
        m = structs.Medium()
        m.phase = wp.where(number == 0, PHASE_RAYLEIGH, PHASE_TABLE)
        return m

    @wp.kernel(module="unique", enable_backward=False)
    def draw(
        scene: structs.Scene, number: wp.int32, d: wp.vec3, u: wp.array(dtype=wp.vec2), wo_out: wp.array(dtype=wp.vec3)
    ):
        wo_out[wp.tid()] = phase.sample(scene, medium(number), wp.vec3(), d, u[wp.tid()])

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(
        scene: structs.Scene,
        tangent: wp.array(dtype=wp.float32),
        number: wp.int32,
        d: wp.vec3,
        wo: wp.array(dtype=wp.vec3),
        value_out: wp.array2d(dtype=wp.float32),
    ):
        i = wp.tid()
        value_out[i, 0] = phase.eval(scene, medium(number), wp.vec3(), d, wo[i])
        value_out[i, 1] = accumulate(scene, tangent, medium(number), wp.vec3(), d, wo[i], 1.0)

    return draw, evaluate


def evaluated(kernels, values, tangent, number, mu):
    """Values and derivatives at cosines, float64."""
    wo = np.stack([np.sqrt(1.0 - mu * mu), 0.0 * mu, mu], axis=1)
    out = wp.zeros((len(mu), 2), dtype=wp.float32)
    inputs = [scene_with(values), wp.array(tangent, dtype=wp.float32), number, wp.vec3(0.0, 0.0, 1.0)]
    wp.launch(kernels[1], dim=len(mu), inputs=[*inputs, wp.array(wo, dtype=wp.vec3)], outputs=[out])
    return out.numpy().astype(np.float64).T


@pytest.mark.parametrize("number", [0, 1], ids=["rayleigh", "tabphase"])
def test_samples_have_the_density(kernels, number):
    n = 1 << 16
    wo = wp.zeros(n, dtype=wp.vec3)
    u = wp.array(np.random.default_rng(3).random((n, 2)).astype(np.float32), dtype=wp.vec2)
    wp.launch(kernels[0], dim=n, inputs=[scene_with(TABLE), number, wp.vec3(0.0, 0.0, 1.0), u], outputs=[wo])
    edges = np.linspace(-1.0, 1.0, 43)
    fine = np.linspace(-1.0, 1.0, 42 * 256 + 1)
    middle = 0.5 * (fine[1:] + fine[:-1])
    value, _ = evaluated(kernels, TABLE, np.zeros(14), number, middle)
    share = 2.0 * np.pi * value.reshape(42, 256).mean(axis=1) * (2.0 / 42.0)
    assert share.sum() == pytest.approx(1.0, abs=1e-5)
    if number == 0:
        np.testing.assert_allclose(value, 3.0 / (16.0 * np.pi) * (1.0 + middle**2), rtol=1e-5)
    found, _ = np.histogram(wo.numpy()[:, 2], edges)
    used = share * n > 10.0
    expected = share[used] * found[used].sum() / share[used].sum()
    assert stats.chisquare(found[used], expected).pvalue > SIGNIFICANCE


def test_derivatives_by_a_table_include_its_integral(kernels):
    mu = np.linspace(-0.99, 0.99, 60)
    v = np.random.default_rng(4).normal(size=7).astype(np.float32)
    tangent = np.concatenate([v, np.zeros(7)])
    _, slope = evaluated(kernels, TABLE + 0.5, tangent, 1, mu)
    h = 1e-2
    high, low = (evaluated(kernels, (TABLE + 0.5 + s * h * v).astype(np.float32), tangent, 1, mu)[0] for s in (1, -1))
    np.testing.assert_allclose(slope, (high - low) / (2.0 * h), atol=2e-4)
    assert np.abs(slope).max() > 0.05


@pytest.fixture(scope="module")
def blended():
    """Samples, values and derivatives by [g, weight] of a blend of an even phase function and of a lobe."""
    kinds = (PHASE_ISOTROPIC, PHASE_HG, PHASE_BLEND)
    phase, accumulate = make_phase(kinds), make_phase_sink(kinds, "forward")
    by_cosine, _by_place = make_phase_slopes(kinds)

    @wp.kernel(module="unique", enable_backward=False)
    def run(
        scene: structs.Scene,
        tangent: wp.array(dtype=wp.float32),
        kind: wp.int32,
        u: wp.array(dtype=wp.vec2),
        wo: wp.array(dtype=wp.vec3),
        drawn_out: wp.array(dtype=wp.vec3),
        value_out: wp.array2d(dtype=wp.float32),
    ):
        i = wp.tid()
        m = structs.Medium()
        m.phase = kind
        d = wp.vec3(0.0, 0.0, 1.0)
        drawn_out[i] = phase.sample(scene, m, wp.vec3(), d, u[i])
        value_out[i, 0] = phase.eval(scene, m, wp.vec3(), d, wo[i])
        value_out[i, 1] = accumulate(scene, tangent, m, wp.vec3(), d, wo[i], 1.0)
        value_out[i, 2] = by_cosine(scene, m, wp.vec3(), wo[i][2])

    def call(weight, kind=PHASE_BLEND, tangent=(0.0, 1.0), n=1 << 16):
        record = structs.Texture()
        record.offset, record.width, record.height, record.first, record.second = 1, PHASE_ISOTROPIC, PHASE_HG, 0, 0
        scene = structs.Scene()
        scene.values = wp.array([0.7, weight], dtype=wp.float32)
        scene.textures = wp.array([record], dtype=structs.Texture)
        u = wp.array(np.random.default_rng(3).random((n, 2)).astype(np.float32), dtype=wp.vec2)
        mu = (np.arange(n) + 0.5) / (0.5 * n) - 1.0
        wo = wp.array(np.stack([np.sqrt(1.0 - mu * mu), 0.0 * mu, mu], axis=1), dtype=wp.vec3)
        drawn, value = wp.zeros(n, dtype=wp.vec3), wp.zeros((n, 3), dtype=wp.float32)
        inputs = [scene, wp.array(tangent, dtype=wp.float32), kind, u, wo]
        wp.launch(run, dim=n, inputs=inputs, outputs=[drawn, value])
        return drawn.numpy()[:, 2], *value.numpy().astype(np.float64).T

    return call


@pytest.mark.parametrize("weight", [0.0, 0.3, 1.0])
def test_a_blend_has_the_sum_of_both_and_is_drawn_from_it(blended, weight):
    """At the ends samples and values have the bits of the one that is left; the slope is the difference anywhere."""
    drawn, value, slope, turned = blended(weight)
    ends = [blended(weight, kind) for kind in (PHASE_ISOTROPIC, PHASE_HG)]
    np.testing.assert_allclose(value, (1.0 - weight) * ends[0][1] + weight * ends[1][1], rtol=1e-6)
    np.testing.assert_allclose(slope, ends[1][1] - ends[0][1], atol=1e-6)
    if weight in (0.0, 1.0):
        np.testing.assert_array_equal(drawn, ends[int(weight)][0])
        np.testing.assert_array_equal(value, ends[int(weight)][1])
    np.testing.assert_allclose(np.cumsum(turned) * 2.0 / len(value), value - value[0], atol=2e-3 * value.max())
    share = 2.0 * np.pi * value.reshape(64, -1).mean(axis=1) * (2.0 / 64.0)
    assert share.sum() == pytest.approx(1.0, abs=1e-4)
    found, _ = np.histogram(drawn, np.linspace(-1.0, 1.0, 65))
    assert stats.chisquare(found, share * found.sum() / share.sum()).pvalue > SIGNIFICANCE
    np.testing.assert_allclose(blended(weight, tangent=(1.0, 0.0))[2], weight * blended(1.0, tangent=(1.0, 0.0))[2])

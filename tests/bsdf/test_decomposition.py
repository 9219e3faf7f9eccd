"""The lobes of a microfacet distribution's derivative: their masses, signs, and that samples have their density."""

import functools

import numpy as np
import pytest
import scipy.stats
import warp as wp

from warp_psdr.kernels.bsdf.decomposition import ACROSS, ALONG, BOTH, make_decomposition

#: Largest statistic of a chi-square test that right samples exceed once in 10^4 tries.
CHANCE = 1e-4
SAMPLES = 200_000
#: Cells of slopes, bent to angles so that all have some.
CELLS = 24
#: Points of a quadrature in each, a side.
POINTS = 24

CASES = [
    (distribution, axis, outer)
    for distribution in ("ggx", "beckmann")
    for axis in (ALONG, ACROSS, BOTH)
    for outer in (0, 1)
]


@functools.cache
def make_drawing(distribution: str):
    lobes = make_decomposition(distribution)

    @wp.kernel(module="unique", enable_backward=False)
    def drawing(
        axis: wp.int32,
        outer: wp.int32,
        u: wp.array(dtype=wp.vec3),
        at: wp.array(dtype=wp.vec2),
        slopes_out: wp.array(dtype=wp.vec2),
        rate_out: wp.array(dtype=wp.float32),
        mass_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        slopes_out[i] = lobes.draw(axis, outer == 1, u[i])
        rate_out[i] = lobes.rate(at[i][0], at[i][1], axis)
        mass_out[i] = lobes.mass(axis)

    return drawing


def drawn(distribution, axis, outer, u, at):
    """Return slopes drawn with the numbers ``u``, the rates at ``at``, and the mass of a lobe."""
    outputs = [wp.zeros(len(u), dtype=t, device="cpu") for t in (wp.vec2, wp.float32, wp.float32)]
    inputs = [axis, outer, wp.array(u, dtype=wp.vec3, device="cpu"), wp.array(at, dtype=wp.vec2, device="cpu")]
    wp.launch(make_drawing(distribution), dim=len(u), inputs=inputs + outputs, device="cpu")
    return tuple(x.numpy().astype(np.float64) for x in outputs)


def density(distribution, x, y):
    """P(X, Y) of slopes over the roughness."""
    s = x * x + y * y
    return 1.0 / (np.pi * (1.0 + s) ** 2) if distribution == "ggx" else np.exp(-s) / np.pi


def rate(distribution, x, y, axis):
    """Return d log P / d log alpha, by differences of P(X / a, Y / b) / (a b)."""
    h = 1e-4
    along, across = axis in (ALONG, BOTH), axis in (ACROSS, BOTH)

    def log(e):
        a, b = 1.0 + e * along, 1.0 + e * across
        return np.log(density(distribution, x / a, y / b) / (a * b))

    return (log(h) - log(-h)) / (2.0 * h)


@pytest.mark.parametrize(("distribution", "axis", "outer"), CASES)
def test_samples_have_the_density_of_a_lobe(distribution, axis, outer):
    random = np.random.default_rng(17)
    u = random.uniform(size=(SAMPLES, 3)).astype(np.float32)
    slopes, _rates, mass = drawn(distribution, axis, outer, u, u[:, :2])
    edges = np.linspace(-0.5 * np.pi, 0.5 * np.pi, CELLS + 1)
    counts = np.histogram2d(*np.arctan(slopes.T), bins=(edges, edges))[0]
    assert counts.sum() == SAMPLES
    # dX = (1 + X^2) d(atan X), midpoints.
    step = (edges[1] - edges[0]) / POINTS
    t = -0.5 * np.pi + step * (np.arange(CELLS * POINTS) + 0.5)
    x, y = np.meshgrid(np.tan(t), np.tan(t), indexing="ij")
    p = density(distribution, x, y)
    derivative = p * np.where(p > 1e-300, rate(distribution, x, y, axis), 0.0) if distribution == "ggx" else None
    if derivative is None:
        s = {ALONG: x * x, ACROSS: y * y, BOTH: x * x + y * y}[axis]
        derivative = p * (2.0 * s - (2.0 if axis == BOTH else 1.0))
    lobe = np.maximum(derivative if outer else -derivative, 0.0) * (1.0 + x * x) * (1.0 + y * y) * step * step
    expected = lobe.reshape(CELLS, POINTS, CELLS, POINTS).sum((1, 3))
    assert abs(expected.sum() / mass[0] - 1.0) < 2e-3
    expected *= SAMPLES / expected.sum()
    full = expected > 20.0
    statistic = ((counts - expected)[full] ** 2 / expected[full]).sum()
    assert scipy.stats.chi2.sf(statistic, full.sum() - 1) > CHANCE, statistic / full.sum()


@pytest.mark.parametrize("distribution", ["ggx", "beckmann"])
@pytest.mark.parametrize("axis", [ALONG, ACROSS, BOTH])
def test_rates_are_derivatives_and_lobes_have_one_sign(distribution, axis):
    at = np.random.default_rng(3).normal(size=(2000, 2)).astype(np.float32)
    u = np.random.default_rng(4).uniform(size=(2000, 3)).astype(np.float32)
    u[0, 0], u[1, 0], u[2, 1], u[3, 1] = 0.0, 1.0 - 2.0**-24, 0.0, 1.0 - 2.0**-24
    for outer in (0, 1):
        slopes, rates, _mass = drawn(distribution, axis, outer, u, at)
        np.testing.assert_allclose(rates, rate(distribution, *at.T.astype(np.float64), axis), rtol=1e-3, atol=1e-3)
        assert np.isfinite(slopes).all()
        sign = drawn(distribution, axis, outer, u, slopes.astype(np.float32))[1]
        assert ((sign > -1e-3) if outer else (sign < 1e-3)).all()

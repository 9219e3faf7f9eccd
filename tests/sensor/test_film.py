"""Filter importance sampling: offsets are distributed as the filters that Mitsuba 3 defines."""

import functools

import numpy as np
import pytest
import warp as wp
from scipy import special, stats

from warp_psdr.kernels.constants import RFILTER_BOX, RFILTER_GAUSSIAN, RFILTER_TENT
from warp_psdr.kernels.sensor.film import make_filter
from warp_psdr.kernels.splat import make_filter_steps

SIGNIFICANCE = 1e-5


def box_cdf(x, radius, stddev):
    return np.clip((x + radius) / (2.0 * radius), 0.0, 1.0)


def tent_cdf(x, radius, stddev):
    t = np.clip(x / radius, -1.0, 1.0)
    return 0.5 + t - 0.5 * t * np.abs(t)


def gaussian_cdf(x, radius, stddev):
    """Of exp(-x^2 / 2 s^2) - exp(-r^2 / 2 s^2), cut at r."""
    t, end = np.clip(x, -radius, radius) / stddev, radius / stddev

    def mass(t):
        return np.sqrt(np.pi / 2.0) * special.erf(t / np.sqrt(2.0)) - np.exp(-0.5 * end * end) * t

    return 0.5 + 0.5 * mass(t) / mass(end)


#: name: (kind, radius, standard deviation, cumulative distribution)
FILTERS = {
    "box": (RFILTER_BOX, 0.5, 0.0, box_cdf),
    "tent": (RFILTER_TENT, 1.0, 0.0, tent_cdf),
    "wide tent": (RFILTER_TENT, 2.5, 0.0, tent_cdf),
    "gaussian": (RFILTER_GAUSSIAN, 2.0, 0.5, gaussian_cdf),
    "wide gaussian": (RFILTER_GAUSSIAN, 6.0, 1.5, gaussian_cdf),
}


@functools.cache
def filter_kernel(kind: int):
    sample = make_filter(kind)

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(u: wp.array(dtype=wp.vec2), radius: wp.float32, stddev: wp.float32, out: wp.array(dtype=wp.vec2)):
        i = wp.tid()
        out[i] = sample(u[i], radius, stddev)

    return kernel


def offsets(name, u, device="cpu"):
    kind, radius, stddev, _ = FILTERS[name]
    out = wp.zeros(len(u), dtype=wp.vec2, device=device)
    inputs = [wp.array(u, dtype=wp.vec2, device=device), radius, stddev]
    wp.launch(filter_kernel(kind), dim=len(u), inputs=inputs, outputs=[out], device=device)
    return out.numpy().astype(np.float64)


@pytest.mark.parametrize("name", FILTERS)
def test_offsets_invert_the_cumulative_distribution(name, device):
    _, radius, stddev, cdf = FILTERS[name]
    # Multiples of 2^-24, both ends included.
    ends = np.array([0, 1, 2, 100, 2**23 - 1, 2**23, 2**23 + 1, 2**24 - 100, 2**24 - 2, 2**24 - 1]) / 2.0**24
    u = np.concatenate([ends, (np.arange(4096) + 0.5) / 4096])
    x = offsets(name, np.stack([u, u[::-1]], axis=1), device)
    assert np.abs(x).max() <= radius
    # 6e-6: the polynomial fit of the Gaussian; rounding is 1e-7.
    np.testing.assert_allclose(cdf(x[:, 0], radius, stddev), u, rtol=0.0, atol=6e-6)
    np.testing.assert_allclose(cdf(x[:, 1], radius, stddev), u[::-1], rtol=0.0, atol=6e-6)


@pytest.mark.parametrize("name", FILTERS)
def test_chi_square(name):
    _, radius, stddev, cdf = FILTERS[name]
    u = np.random.default_rng(3).random((400_000, 2), dtype=np.float32)
    x = offsets(name, u)
    edges = np.linspace(-radius, radius, 33)
    observed = np.histogram2d(x[:, 0], x[:, 1], bins=(edges, edges))[0].ravel()
    p = np.diff(cdf(edges, radius, stddev))
    expected = len(u) * np.outer(p, p).ravel()
    # Cells of fewer than 5 expected samples are pooled.
    rare = expected < 5.0
    observed = np.append(observed[~rare], observed[rare].sum())
    expected = np.append(expected[~rare], expected[rare].sum())
    keep = expected > 0.0
    assert stats.chisquare(observed[keep], expected[keep] * observed.sum() / expected.sum()).pvalue > SIGNIFICANCE


@pytest.mark.parametrize(
    ("name", "plugin"),
    [
        ("box", {"type": "box"}),
        ("tent", {"type": "tent"}),
        ("wide tent", {"type": "tent", "radius": 2.5}),
        ("gaussian", {"type": "gaussian"}),
        ("wide gaussian", {"type": "gaussian", "stddev": 1.5}),
    ],
)
def test_filters_are_mitsubas(name, plugin):
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    reference = mitsuba.load_dict(plugin)
    _, radius, stddev, cdf = FILTERS[name]
    assert reference.radius() == pytest.approx(radius)
    x = np.linspace(-radius, radius, 2001)
    middle = 0.5 * (x[1:] + x[:-1])
    value = np.array([reference.eval(t) for t in middle])
    # 2e-3 of the peak: Mitsuba evaluates its Gaussian by a polynomial.
    density = np.diff(cdf(x, radius, stddev)) / np.diff(x)
    np.testing.assert_allclose(value / value.max(), density / density.max(), atol=2e-3)


def test_unknown_filter_is_named():
    with pytest.raises(ValueError, match="unknown pixel filter 7"):
        make_filter(7)


@pytest.mark.parametrize(
    ("kind", "radius", "stddev"),
    [
        (RFILTER_GAUSSIAN, 2.0, 0.5),
        (RFILTER_GAUSSIAN, 6.0, 1.5),
        (RFILTER_GAUSSIAN, 0.8, 0.2),
        (RFILTER_TENT, 3.0, 0.0),
    ],
)
def test_filter_steps_are_the_filter(kind, radius, stddev):
    first, following = make_filter_steps(kind)

    @wp.kernel(module="unique", enable_backward=False)
    def walk(start: wp.array(dtype=wp.float32), weights_out: wp.array2d(dtype=wp.float32)):
        i = wp.tid()
        step = first(start[i], radius, stddev)
        for j in range(weights_out.shape[1]):
            weights_out[i, j] = step.weight
            step = following(step)

    # From the last pixel within reach on one side to the first on the other.
    start = np.linspace(radius - min(1.0, radius), radius, 33, dtype=np.float32)
    weights = wp.zeros((len(start), int(2.0 * radius) + 1), dtype=wp.float32, device="cpu")
    wp.launch(walk, len(start), [wp.array(start, device="cpu")], [weights], device="cpu")
    x = start[:, None].astype(np.float64) - np.arange(weights.shape[1])
    if kind == RFILTER_TENT:
        expected = np.maximum(1.0 - np.abs(x) / radius, 0.0)
    else:
        expected = np.maximum(np.exp(-0.5 * (x / stddev) ** 2) - np.exp(-0.5 * (radius / stddev) ** 2), 0.0)
    assert expected.max() > 0.5
    np.testing.assert_allclose(weights.numpy(), expected, atol=2.0e-6)  # float32, 12 products of numbers up to 1

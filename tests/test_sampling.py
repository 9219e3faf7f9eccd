"""Warps and discrete distributions against their densities, and the weights of multiple importance sampling."""

import functools

import numpy as np
import pytest
import warp as wp
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import stats

from warp_psdr.kernels import sampling
from warp_psdr.kernels.distribution import LEVELS, find_guided, find_interval, find_interval_64
from warp_psdr.scene.lights.light_sampling import cumulative, with_guide

SIGNIFICANCE = 1e-5
SAMPLES = 400_000


@functools.cache
def warp_kernel(name: str):
    function = getattr(sampling, name)

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(u: wp.array(dtype=wp.vec2), out: wp.array2d(dtype=wp.float32)):
        i = wp.tid()
        v = function(u[i])
        for k in range(wp.static(3 if "sphere" in name else 2)):
            out[i, k] = v[k]

    return kernel


def warped(name, u, device="cpu"):
    out = wp.zeros((len(u), 3 if "sphere" in name else 2), dtype=wp.float32, device=device)
    inputs = [wp.array(u, dtype=wp.vec2, device=device)]
    wp.launch(warp_kernel(name), dim=len(u), inputs=inputs, outputs=[out], device=device)
    return out.numpy().astype(np.float64)


def equal_share_cells(name, p, n):
    """Number of each point's cell, of n x n cells that the warp's exact density gives equal shares."""
    if name == "square_to_triangle":
        # Of the part of a triangle with b1 < t the area is 1 - (1 - t)^2; b2 is uniform in [0, 1 - b1].
        a, b = 1.0 - (1.0 - p[:, 0]) ** 2, p[:, 1] / (1.0 - p[:, 0])
    else:
        b = np.arctan2(p[:, 1], p[:, 0]) / (2.0 * np.pi) % 1.0
        a = {
            "square_to_disk": lambda: (p**2).sum(axis=1),
            "square_to_cosine_hemisphere": lambda: p[:, 2] ** 2,
            "square_to_sphere": lambda: 0.5 * (1.0 - p[:, 2]),
        }[name]()
    return np.minimum((a * n).astype(int), n - 1) * n + np.minimum((b * n).astype(int), n - 1)


WARPS = ("square_to_disk", "square_to_cosine_hemisphere", "square_to_sphere", "square_to_triangle")


@pytest.mark.parametrize("name", WARPS)
def test_chi_square(name, device):
    u = np.random.default_rng(5).random((SAMPLES, 2), dtype=np.float32)
    cells = equal_share_cells(name, warped(name, u, device), 24)
    assert stats.chisquare(np.bincount(cells, minlength=24 * 24)).pvalue > SIGNIFICANCE


@pytest.mark.parametrize("name", WARPS)
def test_points_stay_in_the_domain_at_the_corners_of_the_square(name):
    one = 1.0 - 2.0**-24
    u = np.array([(a, b) for a in (0.0, 0.5, one) for b in (0.0, 0.5, one)], np.float32)
    p = warped(name, u)
    assert np.all(np.isfinite(p))
    if "sphere" in name:
        np.testing.assert_allclose(np.linalg.norm(p, axis=1), 1.0, atol=1e-6)
    if name == "square_to_cosine_hemisphere":
        assert p[:, 2].min() >= 0.0
    if name == "square_to_disk":
        assert np.linalg.norm(p, axis=1).max() <= 1.0 + 1e-6
    if name == "square_to_triangle":
        assert p.min() >= 0.0
        assert p.sum(axis=1).max() <= 1.0


@wp.kernel(enable_backward=False)
def mis_kernel(a: wp.array(dtype=wp.float32), b: wp.array(dtype=wp.float32), out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    out[i] = sampling.mis_weight(a[i], b[i])


def mis_weight(a, b):
    out = wp.zeros(len(a), dtype=wp.float32, device="cpu")
    inputs = [wp.array(np.array(v, np.float32), device="cpu") for v in (a, b)]
    wp.launch(mis_kernel, dim=len(a), inputs=inputs, outputs=[out], device="cpu")
    return out.numpy()


def test_mis_weight_is_the_power_heuristic():
    a, b = np.random.default_rng(2).lognormal(0.0, 3.0, (2, 1000))
    np.testing.assert_allclose(mis_weight(a, b), a**2 / (a**2 + b**2), rtol=1e-5)
    np.testing.assert_allclose(mis_weight(a, b) + mis_weight(b, a), 1.0, rtol=1e-6)


def test_mis_weight_at_zero_and_infinity():
    inf = np.inf
    cases = {(0, 0): 0, (0, 1): 0, (1, 0): 1, (inf, 1): 1, (1, inf): 0, (inf, 0): 1, (0, inf): 0, (inf, inf): 0.5}
    cases |= {(1e30, 1e30): 0.5, (1e-30, 1e-30): 0.5, (1e30, 1e-30): 1, (2e-30, 1e-30): 0.8}
    a, b = np.array(list(cases)).T
    np.testing.assert_allclose(mis_weight(a, b), list(cases.values()), rtol=1e-6)


@wp.kernel(enable_backward=False)
def interval_kernel(
    cdf: wp.array(dtype=wp.float32),
    first: wp.int32,
    count: wp.int32,
    u: wp.array(dtype=wp.float32),
    out: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    out[i] = find_interval(cdf, first, count, u[i])


@wp.kernel(enable_backward=False)
def interval_64_kernel(
    cdf: wp.array(dtype=wp.float32),
    first: wp.int32,
    count: wp.int32,
    u: wp.array(dtype=wp.float64),
    out: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    out[i] = find_interval_64(cdf, first, count, u[i])


@wp.kernel(enable_backward=False)
def guided_kernel(
    cdf: wp.array(dtype=wp.float32),
    first: wp.int32,
    guide: wp.int32,
    u: wp.array(dtype=wp.float32),
    out: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    out[i] = find_guided(cdf, first, guide, wp.int32(cdf[guide - 1]), u[i])


def intervals(cdf, u, device="cpu", kernel=interval_kernel, dtype=np.float32):
    # Other distributions around it, as in the scene's arrays.
    padded = np.concatenate([[0.3, 0.7], cdf, [0.0, 0.1]]).astype(np.float32)
    u = np.asarray(u, dtype)
    out = wp.zeros(len(u), dtype=wp.int32, device=device)
    inputs = [wp.array(padded, device=device), 2, len(cdf) - 1, wp.array(u, device=device)]
    wp.launch(kernel, dim=len(u), inputs=inputs, outputs=[out], device=device)
    return out.numpy()


@pytest.mark.parametrize(
    "weights", [[1.0], [0.0, 1.0], [1.0, 0.0], [0.0, 0.0, 2.0, 0.0, 3.0, 0.0], [1e-30, 1.0, 1e-30], [0.0, 0.0, 0.0]]
)
def test_no_entry_of_probability_zero_is_found(weights, device):
    cdf = cumulative(np.array(weights))
    u = np.concatenate([cdf[:-1], np.nextafter(cdf[1:], 0.0), [0.0, 0.5, 1.0 - 2.0**-24, 1.0]])
    found = intervals(cdf, np.clip(u, 0.0, 1.0), device)
    probability = np.diff(cdf)
    assert np.all(probability[found] > 0.0)
    # Every entry of positive weight has its share.
    assert set(found) == set(np.flatnonzero(probability))
    fine = np.concatenate([u, [np.nextafter(1.0, 0.0)]])
    found = intervals(cdf, np.clip(fine, 0.0, 1.0), device, interval_64_kernel, np.float64)
    assert np.all(probability[found] > 0.0)


@pytest.mark.parametrize("count", [1, 2, 5, 8, 100])
def test_a_guide_leads_to_what_the_whole_search_finds(count, device):
    rng = np.random.default_rng(count)
    even, gaps, steep = np.ones(count), rng.random(count) * (rng.random(count) > 0.5), 10.0 ** rng.uniform(-9, 1, count)
    cdf = cumulative(np.stack([even, gaps, steep]))
    flat = with_guide(cdf)
    buckets = 1 << (count.bit_length() - 1)
    assert flat[cdf.size] == buckets and flat.size == cdf.size + 1 + 3 * (buckets + 1)
    # Where buckets and entries begin and end, and anywhere.
    edges = np.concatenate([np.arange(buckets + 1) / buckets, cdf.reshape(-1)]).astype(np.float32)
    u = np.concatenate([edges, edges - np.float32(1.0 / LEVELS), rng.integers(0, LEVELS, 1000) / LEVELS])
    u = np.clip(u, 0.0, 1.0 - 1.0 / LEVELS).astype(np.float32)
    numbers = wp.array(u, device=device)
    for row in range(3):
        out = wp.zeros(len(u), dtype=wp.int32, device=device)
        # The guides of all rows follow their values; the kernel finds the number of buckets in front of the first one.
        moved = np.concatenate([cdf[row], [buckets], flat[cdf.size + 1 + row * (buckets + 1) :][: buckets + 1]])
        inputs = [wp.array(moved.astype(np.float32), device=device), 0, count + 2, numbers]
        wp.launch(guided_kernel, dim=len(u), inputs=inputs, outputs=[out], device=device)
        np.testing.assert_array_equal(out.numpy(), intervals(cdf[row], u, device))


def test_every_entry_is_drawn_with_exactly_the_probability_that_the_array_states():
    weights = np.random.default_rng(4).lognormal(0.0, 4.0, 500) * (np.arange(500) % 7 != 0)
    cdf = cumulative(weights)
    # All 2^24 random numbers there are.
    counts = np.bincount(intervals(cdf, np.arange(LEVELS) / LEVELS), minlength=500)
    np.testing.assert_array_equal(counts / LEVELS, np.diff(cdf))


def test_a_million_entries_are_accurate():
    weights = np.random.default_rng(6).random(1_000_000) + 0.1
    weights[::3] = 0.0
    weights[1] = 1e-12
    cdf = cumulative(weights)
    assert cdf.dtype == np.float32
    assert cdf[0] == 0.0
    assert cdf[-1] == 1.0
    exact = np.cumsum(weights) / weights.sum()
    # Half a level of rounding, plus what the one entry below a level was lifted.
    np.testing.assert_allclose(cdf[1:], exact, rtol=0.0, atol=2.0 / LEVELS)
    np.testing.assert_array_equal(np.diff(cdf) > 0.0, weights > 0.0)


@settings(deadline=None)
@given(st.lists(st.floats(0.0, 1e300), min_size=1, max_size=60))
@example([2.6e299, 3.1e299, 3.3e299, 3.7e299, 4.2e299, 5.2e-24])
def test_cumulative_keeps_every_positive_weight(weights):
    cdf = cumulative(np.array(weights))
    assert cdf[0] == 0.0
    assert cdf[-1] == 1.0
    np.testing.assert_array_equal(cdf * LEVELS, np.round(cdf * LEVELS))
    largest = max(weights)
    if largest > 0.0:
        # A weight whose ratio to the largest underflows in float64 counts as zero.
        np.testing.assert_array_equal(np.diff(cdf) > 0.0, np.array(weights) / largest > 0.0)
        p = np.array(weights) / largest
        np.testing.assert_allclose(np.diff(cdf), p / p.sum(), rtol=0.0, atol=(len(weights) + 1.5) / LEVELS)
    else:
        np.testing.assert_allclose(np.diff(cdf), 1.0 / len(weights), atol=1.0 / LEVELS)


def test_rows_are_distributions_of_their_own():
    weights = np.random.default_rng(7).random((5, 9))
    cdf = cumulative(weights)
    assert cdf.shape == (5, 10)
    for row, expected in zip(cdf, weights, strict=True):
        np.testing.assert_array_equal(row, cumulative(expected))


@pytest.mark.parametrize("weights", [[1.0, -1.0], [1.0, np.nan], [np.inf, 1.0], [], 3.0])
def test_bad_weights_are_refused(weights):
    with pytest.raises(ValueError, match="weight"):
        cumulative(np.array(weights))

"""Adjoints: random ones, and those that see much of derivatives and little noise."""

import numpy as np

from warp_psdr.certify.adjoints import Seen, factors, random_adjoints

SHAPE = (12, 16, 3)


def test_random_adjoints_are_smooth_and_of_size_one() -> None:
    found = random_adjoints((24, 32), 0)
    assert found.shape == (3, 24, 32, 3) and found.dtype == np.float32
    np.testing.assert_allclose((found**2).mean(axis=(1, 2, 3)), 1.0, rtol=1e-5)
    assert np.abs(np.diff(found, axis=1)).max() < 0.6 and not np.array_equal(found, random_adjoints((24, 32), 1))


def seen(signal: np.ndarray, noisy: slice = slice(0), level: float = 1.0) -> Seen:
    noise = np.full(SHAPE, level)
    noise[noisy] *= 100.0
    return Seen(signal, noise, noise)


def noise_of(adjoint: np.ndarray, found: Seen) -> float:
    """Return the variance of <adjoint, derivative> at a slope of 1."""
    variance = (adjoint**2 * (found.differences + found.derivative)).sum()
    return float(variance / (adjoint * found.signal).sum() ** 2)


def test_noisy_pixels_count_less_and_are_not_left_out() -> None:
    signal = np.random.default_rng(1).normal(size=SHAPE)
    found = seen(signal, slice(0, 4))
    adjoint = found.adjoint
    assert abs(float((adjoint * signal).sum()) - 1.0) < 1e-12
    share = (np.abs(adjoint[:4]) / np.abs(signal[:4])).mean() / (np.abs(adjoint[4:]) / np.abs(signal[4:])).mean()
    assert 0.1 < share < 0.5
    assert noise_of(adjoint, found) < 0.5 * noise_of(signal, found)


def test_nothing_seen_has_no_adjoint() -> None:
    assert not seen(np.zeros(SHAPE)).adjoint.any()
    assert not Seen(*(np.zeros(SHAPE),) * 3).adjoint.any()


def test_one_adjoint_sees_directions_that_cancel_in_a_sum() -> None:
    signal, rest = np.random.default_rng(2).normal(size=(2, *SHAPE))
    pair = [seen(signal), seen(rest - signal)]
    weights = factors(pair)
    adjoint = np.einsum("d,dhwc->hwc", weights, np.stack([s.adjoint for s in pair]))
    for found in pair:
        assert noise_of(adjoint, found) < 4.0 * noise_of(found.adjoint, found)

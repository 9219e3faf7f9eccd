"""The benchmark of a lidar: what an instrument makes of light, its derivatives, and its calibration."""

import numpy as np
import pytest

ZONES, BINS, FINE = 4, 64, 0.01
LENGTHS = FINE * (np.arange(100) + 0.5)
RATE = np.random.default_rng(1).random((2, 3, 8)) * 0.2
BACKGROUND = np.float64([[0.01], [0.02], [0.03]])
#: Of second-order differences with steps of 1e-4.
DIFFERENCES = 1e-6


@pytest.fixture
def lidar(modules):
    return modules("lidar_histograms")


def pulse(lidar):
    """A pulse that rises fast and falls slowly."""
    t = np.arange(40.0)
    return lidar.free_pulse(lidar.reference_pulse(np.exp(-t / 2.0) * t**2 + 1e-3))


def planes(distances, geometry):
    """Images of planes that zones see at angles, light falls off, and derivatives by a shift: (n, Z, T)."""
    ratios = np.float64([2.0, 2.02, 2.03, 2.06])
    d = (np.asarray(distances) + geometry[0])[:, None, None]
    x = (LENGTHS - ratios[:, None] * d) / 0.02
    shape = np.exp(-0.5 * x**2)
    moved = shape * x * ratios[:, None] / 0.02 / d**2 - 2.0 * shape / d**3
    return shape / d**2, moved[None]


def truth(lidar, distances):
    """An instrument, what it counts, and the photons of each."""
    spline = pulse(lidar)
    offsets = np.array([5.0, 5.3, 4.9, 5.2])
    widths, background = np.array([0.030, 0.031, 0.031, 0.030]), np.full(ZONES, 2e-5)
    gains = 2.0e-4 * np.array([1.0, 1.5, 1.2, 0.8])
    own = lidar.Instrument(0.4, 4.0e6, 0.0, np.array([0.003]), widths, offsets, gains, background, spline)
    images = planes(distances, own.geometry)[0]
    response = own.response(LENGTHS, np.zeros((ZONES, BINS)))[0]
    rates = np.einsum("zbt,nzt->nzb", response, images)
    return own, np.maximum(lidar.counted(rates, background[:, None], own.shots, own.blind), 0.0)


def test_few_photons_are_all_counted_and_many_are_not(lidar):
    few = 1e-6 * RATE
    np.testing.assert_allclose(lidar.counted(few, 0.0 * BACKGROUND, 1e6, 0.4), 1e6 * few, rtol=1e-5)
    many = lidar.counted(10.0 * RATE, BACKGROUND, 1e6, 0.0)
    # No shot has two counts, and without blindness it has none as often as no photon comes.
    missed = np.exp(-(10.0 * RATE + BACKGROUND).sum(axis=-1))
    np.testing.assert_allclose(many.sum(axis=-1), 1e6 * (1.0 - missed), rtol=1e-12)


def test_derivatives_of_counts_are_those_of_differences(lidar):
    rng, h = np.random.default_rng(2), 1e-4
    dr, db = rng.random(RATE.shape), rng.random(BACKGROUND.shape)
    high, low = (lidar.counted(RATE + s * dr, BACKGROUND + s * db, 1.0, 0.4 + 0.3 * s) for s in (h, -h))
    found = lidar.counted_moved(RATE, BACKGROUND, 1.0, 0.4, dr, db, 0.3)
    np.testing.assert_allclose(found, (high - low) / (2.0 * h), atol=DIFFERENCES)


def test_a_calibration_comes_back(lidar):
    distances = np.linspace(0.1, 0.45, 4)
    own, counts = truth(lidar, distances)
    clocks, bounds = np.array([0, 1, 1, 0]), np.array([[-0.01], [0.01]])
    geometry = np.zeros(1)
    start = lidar.guessed(counts, LENGTHS, planes(distances, geometry)[0], 0.0295, geometry, own.pulse)
    found, residual = lidar.calibrated(counts, LENGTHS, lambda g: planes(distances, g), start, clocks, bounds)
    assert np.sqrt((residual**2).mean()) < 0.05
    np.testing.assert_allclose(found.widths, own.widths, rtol=2e-3)
    assert found.geometry[0] == pytest.approx(own.geometry[0], abs=1e-3)
    assert found.shots == pytest.approx(own.shots, rel=0.02) and found.blind == pytest.approx(own.blind, abs=0.02)


def test_residuals_of_histograms_have_their_derivatives(lidar):
    own, counts = truth(lidar, [0.2])
    image, moved = (np.repeat(x[0].reshape(2, 2, -1, 1), 3, axis=3) for x in planes([0.2], np.zeros(1)))
    seen = lidar.Histograms(counts[0], own, own.response(LENGTHS, counts[0]), (2, 2, len(LENGTHS)))
    h = 1e-6
    high, low = (seen.residual(image + s * moved) for s in (h, -h))
    np.testing.assert_allclose(seen.pushed(image, moved), (high - low) / (2.0 * h), rtol=1e-5, atol=1e-5)
    kept = seen.values["background"].copy()
    sides = []
    for s in (1e-4, -1e-4):
        seen.move(np.array([s]))
        sides.append(seen.residual(image))
        seen.values["background"] = kept.copy()
    np.testing.assert_allclose(seen.derivatives(image)[0], (sides[0] - sides[1]) / 2e-4, rtol=1e-5, atol=1e-6)
    assert seen.doubts(image).shape == (3, ZONES, BINS, 1)


def test_peaks_lie_between_bins(modules):
    lidar_plane = modules("lidar_plane")
    places = np.array([20.0, 20.3, 41.7])
    counts = 1e6 * np.exp(-0.5 * ((np.arange(BINS) - places[:, None]) / 1.5) ** 2)
    np.testing.assert_allclose(lidar_plane.peaks(counts), places, atol=1e-5)

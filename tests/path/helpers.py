"""Images with their statistical error: batches of independent seeds, and z-tests between means of batches."""

from pathlib import Path

import numpy as np
from scipy import stats

import warp_psdr as psdr

SCENES = Path(__file__).resolve().parents[2] / "scenes"
CLOSED_FORM = SCENES / "tests"
#: Chance that one test of a right renderer fails; the bound on |z| follows from the number of values compared.
SIGNIFICANCE = 1e-5
#: Absorbs float32 rounding of a mean and the width of the cameras that look at "one" point, relative.
ROUNDING = 3e-4


def batches(scene, *, count=16, spp=16, seed=0, **options):
    """Return images of independent seeds, shape (count, H, W, 3)."""
    integrator = psdr.PathIntegrator(**options) if options else None
    render = (psdr.render(scene, integrator=integrator, spp=spp, seed=seed + i) for i in range(count))
    images = np.stack([image.numpy() for image in render])
    assert np.isfinite(images).all(), f"{(~np.isfinite(images)).sum()} values of the image are not finite"
    return images.astype(np.float64)


def blocks(images, size):
    """Average blocks of ``size`` x ``size`` pixels: (count, H, W, 3) to (count, H / size * W / size, 3)."""
    n, h, w, c = images.shape
    assert h % size == 0 and w % size == 0
    return images.reshape(n, h // size, size, w // size, size, c).mean(axis=(2, 4)).reshape(n, -1, c)


def mean_and_variance(samples):
    """Return the mean over batches and the variance of that mean."""
    return samples.mean(axis=0), samples.var(axis=0, ddof=1) / len(samples)


def largest_z(variance_a, variance_b, difference, scale, rounding):
    """Return the largest |z|; differences below ``rounding * scale`` count as none."""
    excess = np.maximum(np.abs(difference) - rounding * np.abs(scale), 0.0)
    sigma = np.sqrt(variance_a + variance_b)
    return np.where(excess > 0.0, excess / np.maximum(sigma, 1e-30), 0.0)


def z_limit(values, degrees):
    """Return the bound on the largest of ``values`` Student-distributed numbers."""
    return stats.t.isf(0.5 * SIGNIFICANCE / values, degrees)


def assert_mean(samples, expected, what, rounding=ROUNDING):
    """Fail unless the mean over batches (first axis) is ``expected`` within its own error."""
    mean, variance = mean_and_variance(samples)
    expected = np.broadcast_to(expected, mean.shape)
    z = largest_z(variance, 0.0, mean - expected, expected, rounding)
    i = np.unravel_index(z.argmax(), z.shape)
    limit = z_limit(z.size, len(samples) - 1)
    assert z[i] < limit, f"{what}: |z| = {z[i]:.2f} > {limit:.2f} at {i}: got {mean[i]:.6g}, expected {expected[i]:.6g}"


def assert_same_mean(a, b, what, rounding=ROUNDING):
    """Fail unless two sets of batches (first axis) have one mean within their errors."""
    (mean_a, var_a), (mean_b, var_b) = mean_and_variance(a), mean_and_variance(b)
    z = largest_z(var_a, var_b, mean_a - mean_b, mean_b, rounding)
    i = np.unravel_index(z.argmax(), z.shape)
    limit = z_limit(z.size, min(len(a), len(b)) - 1)
    assert mean_b.any(), f"{what}: the image is black, nothing is compared"
    assert z[i] < limit, f"{what}: |z| = {z[i]:.2f} > {limit:.2f} at {i}: got {mean_a[i]:.6g}, expected {mean_b[i]:.6g}"


def chi_square_p(observed: np.ndarray, expected: np.ndarray) -> float:
    """p-value; the rarest bins are pooled into one that expects at least 5 samples."""
    order = np.argsort(expected)
    observed, expected = observed[order], expected[order]
    pooled = max(int(np.searchsorted(np.cumsum(expected), 5.0)) + 1, int(np.searchsorted(expected, 5.0)))
    observed = np.append(observed[pooled:], observed[:pooled].sum())
    expected = np.append(expected[pooled:], expected[:pooled].sum())
    return float(stats.chi2.sf(((observed - expected) ** 2 / expected).sum(), df=len(expected) - 1))

"""Rays through smooth grids of signed distances against float64: none passes the surface, and points are on it."""

import numpy as np
import pytest
import warp as wp

from warp_psdr.kernels.primitive.sdfgrid_cubic import BERNSTEIN, first_crossing

from .test_sdfgrid import check_rays, rough_grid


@wp.kernel(module="unique", enable_backward=False)
def cross(p: wp.array(dtype=wp.float32, ndim=2), out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    q = BERNSTEIN()
    for m in range(10):
        q[m] = p[i, m]
    out[i] = first_crossing(q, 1.0, q[0] < 0.0)


def weights(x: np.ndarray, order: int = 0) -> np.ndarray:
    """Weights (..., 4) of uniform cubic B-splines at places (...) in a voxel, or their derivatives."""
    y = 1.0 - x
    found = [
        (y**3 / 6.0, (4.0 - 6.0 * x**2 + 3.0 * x**3) / 6.0, (4.0 - 6.0 * y**2 + 3.0 * y**3) / 6.0, x**3 / 6.0),
        (-(y**2) / 2.0, 1.5 * x**2 - 2.0 * x, 2.0 * y - 1.5 * y**2, x**2 / 2.0),
        (y, 3.0 * x - 2.0, 3.0 * y - 2.0, x),
    ][order]
    return np.stack(found, axis=-1)


def spline(grid: np.ndarray, p: np.ndarray, orders: tuple[int, int, int] = (0, 0, 0)) -> np.ndarray:
    """Values (...) at points (..., 3) of [0, 1]^3, or derivatives by x, y, z in voxels, float64."""
    count = np.array(grid.shape[::-1])
    place = np.clip(p, 0.0, 1.0) * (count - 1)
    cell = np.minimum(place.astype(int), count - 2)
    w = [weights(place[..., k] - cell[..., k], orders[k]) for k in range(3)]
    total = np.zeros(p.shape[:-1])
    for a, b, c in np.ndindex(4, 4, 4):
        at = np.clip(cell + np.array([a - 1, b - 1, c - 1]), 0, count - 1)
        total += w[0][..., a] * w[1][..., b] * w[2][..., c] * grid[at[..., 2], at[..., 1], at[..., 0]]
    return total


@pytest.mark.parametrize("count", [1000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_no_ray_passes_the_surface(count: int) -> None:
    rng = np.random.default_rng(count)
    # The spline takes noise away: more of it.
    grid = rough_grid(rng) + 0.06 * rng.standard_normal((9, 16, 12)).astype(np.float32)
    check_rays({"type": "sdfgrid", "grid": grid, "interpolation": "cubic"}, rng, count, spline)


def test_first_crossing_of_polynomials() -> None:
    """Random coefficients, many roots close together, and double roots, against samples in float64."""
    rng = np.random.default_rng(5)
    p = rng.standard_normal((6000, 10))
    p[1000:3000] = p[1000:3000].cumsum(axis=1) * 0.1
    s = np.linspace(0.0, 1.0, 4001)
    m = np.arange(10)
    binomials = np.array([1, 9, 36, 84, 126, 126, 84, 36, 9, 1])
    basis = binomials * s[:, None] ** m * (1.0 - s[:, None]) ** (9 - m)
    # The last ones touch zero, from one side.
    values = p[4000:] @ basis.T
    p[4000:] -= values.min(axis=1)[:, None]
    p = p.astype(np.float32)
    out = wp.zeros(len(p), dtype=wp.float32, device="cpu")
    wp.launch(cross, len(p), inputs=[wp.array(p, device="cpu")], outputs=[out], device="cpu")
    found = out.numpy().astype(np.float64)
    values = p.astype(np.float64) @ basis.T
    changed = (values < 0.0) != (p[:, :1] < 0.0)
    before = changed & (s < np.where(found < 0.0, 2.0, found)[:, None] - 1e-6)
    assert np.abs(values[before]).max(initial=0.0) < 2e-6
    hit = found >= 0.0
    at = found[hit, None]
    there = (p[hit] * binomials * at**m * (1.0 - at) ** (9 - m)).sum(axis=1)
    assert np.abs(there).max() < 2e-6
    assert 0.5 < hit[:4000].mean() < 0.95

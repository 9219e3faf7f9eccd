"""Rays through smooth grids of signed distances against float64: none passes the surface, and points are on it."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr.kernels.constants import PRIMITIVE_SDFGRID_CUBIC
from warp_psdr.kernels.primitive.dispatch import make_hit, make_surface_at
from warp_psdr.kernels.primitive.sdfgrid_cubic import BERNSTEIN, first_crossing
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene

from .test_sdfgrid import ROUNDING, rays, rough_grid, samples

HIT = make_hit((PRIMITIVE_SDFGRID_CUBIC,))
SURFACE = make_surface_at(False, True, False, False, (PRIMITIVE_SDFGRID_CUBIC,))


@wp.kernel(module="unique", enable_backward=False)
def trace(
    scene: Scene, o: wp.array(dtype=wp.vec3), d: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32, ndim=2)
):
    i = wp.tid()
    tri = triangle_at(scene, 0)
    hit = HIT(scene, tri, o[i], d[i], 1.0e30)
    out[i, 0] = wp.where(hit.face < 0, -1.0, hit.t)
    if hit.face >= 0:
        surface = SURFACE(scene, tri, hit.u, hit.v)
        for k in range(3):
            out[i, 1 + k] = surface.x[k]
            out[i, 4 + k] = surface.ng[k]


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
    body = {"type": "sdfgrid", "grid": grid, "interpolation": "cubic"}
    held = psdr.load_dict(
        {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}, "body": body}
    )
    o, d = rays(rng, count)
    given = [wp.array(x, dtype=wp.vec3, device=held.device) for x in (o, d)]
    out = wp.zeros((count, 7), dtype=wp.float32, device=held.device)
    wp.launch(trace, count, inputs=[held.data(), *given], outputs=[out], device=held.device)
    found = out.numpy().astype(np.float64)
    found[:, 1:4] += held.origin
    exact = grid.astype(np.float64)
    hits = 0
    for start in range(0, count, 2000):
        part = slice(start, start + 2000)
        a, b, row = o[part].astype(np.float64), d[part].astype(np.float64), found[part]
        t, meets = samples(grid.shape, a, b)
        phi = spline(exact, a[:, None] + t[..., None] * b[:, None])
        hit = row[:, 0] >= 0.0
        ends = np.where(hit, row[:, 0], np.inf)[:, None] - ROUNDING * (1.0 + np.abs(a).max(axis=1))[:, None]
        crossed = ((phi < 0.0) != (phi[:, :1] < 0.0)) & (t < ends) & meets[:, None]
        assert np.abs(phi[crossed]).max(initial=0.0) < ROUNDING
        x = row[hit, 1:4]
        assert np.abs(spline(exact, x)).max() < ROUNDING
        assert np.abs(x - (a + row[:, :1] * b)[hit]).max() < 5e-6
        step = 1e-4 * row[hit, 4:7]
        assert (spline(exact, x + step) > spline(exact, x - step)).mean() > 0.999
        hits += hit.sum()
    assert hits > count // 4


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

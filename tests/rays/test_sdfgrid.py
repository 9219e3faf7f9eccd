"""Rays through grids of signed distances against float64: none passes the surface, and points are on it."""

from collections.abc import Callable

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr.kernels.primitive.cubic_grid import CUBIC_GRID
from warp_psdr.kernels.primitive.dispatch import make_hit, make_surface_at
from warp_psdr.kernels.primitive.linear_grid import LINEAR_GRID
from warp_psdr.kernels.primitive.sdfgrid import pack, unpack
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.scene.kinds.zero_set import held_points

KINDS = (LINEAR_GRID.number, CUBIC_GRID.number)
HIT = make_hit(KINDS)
SURFACE = make_surface_at(False, True, False, False, KINDS)
#: Rounding of points of the unit cube, and of distances along rays.
ROUNDING = 1e-6


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
def hold(q: wp.array(dtype=wp.vec3), held: wp.array(dtype=wp.vec2), back: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    at = pack(q[i])
    held[i] = at
    back[i] = unpack(at[0], at[1])


def interpolated(grid: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Values (...) at points (..., 3) of [0, 1]^3, float64."""
    count = np.array(grid.shape[::-1])
    place = np.clip(p, 0.0, 1.0) * (count - 1)
    cell = np.minimum(place.astype(int), count - 2)
    f = place - cell
    total = np.zeros(p.shape[:-1])
    for a, b, c in np.ndindex(2, 2, 2):
        weight = np.prod([f[..., k] if on else 1.0 - f[..., k] for k, on in enumerate((a, b, c))], axis=0)
        total += weight * grid[cell[..., 2] + c, cell[..., 1] + b, cell[..., 0] + a]
    return total


def samples(shape: tuple[int, ...], o: np.ndarray, d: np.ndarray, inside_voxels: int = 8) -> tuple[np.ndarray, ...]:
    """Return distances (N, K) along rays, some in each voxel that they cross, and whether they meet the box."""
    with np.errstate(divide="ignore"):
        low, high = -o / d, (1.0 - o) / d
        planes = [(np.arange(n) / (n - 1) - o[:, k, None]) / d[:, k, None] for k, n in enumerate(shape[::-1])]
    near = np.maximum(np.minimum(low, high).max(axis=1), 0.0)[:, None]
    far = np.maximum(low, high).min(axis=1)[:, None]
    t = np.sort(np.clip(np.concatenate([*planes, near, far], axis=1), near, np.maximum(near, far)), axis=1)
    between = np.arange(inside_voxels) / inside_voxels
    inner = t[:, :-1, None] + (t[:, 1:] - t[:, :-1])[:, :, None] * between
    return inner.reshape(len(o), -1), (near < far)[:, 0]


def rays(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays from within the box, beside it and far away; a tenth of them runs along an axis."""
    away, towards = rng.standard_normal((count, 3)), rng.random((count, 3))
    o = 0.5 + np.exp(rng.uniform(-1.0, 3.0, (count, 1))) * away / np.linalg.norm(away, axis=1)[:, None]
    d = towards - o
    along, axis = rng.random(count) < 0.1, rng.integers(0, 3, count)
    d[along] = 0.0
    d[along, axis[along]] = 1.0
    o[along] = rng.random((along.sum(), 3))
    o[along, axis[along]] = -1.0
    return o.astype(np.float32), (d / np.linalg.norm(d, axis=1)[:, None]).astype(np.float32)


def rough_grid(rng: np.random.Generator) -> np.ndarray:
    z, y, x = np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in (9, 16, 12)), indexing="ij")
    smooth = np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - 0.33
    smooth += 0.08 * np.sin(9.0 * x) * np.sin(8.0 * y + 1.0) * np.sin(10.0 * z)
    return (smooth + 0.02 * rng.standard_normal(smooth.shape)).astype(np.float32)


def check_rays(body: dict, rng: np.random.Generator, count: int, field: Callable[..., np.ndarray]) -> None:
    """Rays against samples of ``field(grid, points)``, float64: none passes the surface, and points are on it."""
    grid = body["grid"]
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
        phi = field(exact, a[:, None] + t[..., None] * b[:, None])
        hit = row[:, 0] >= 0.0
        ends = np.where(hit, row[:, 0], np.inf)[:, None] - ROUNDING * (1.0 + np.abs(a).max(axis=1))[:, None]
        # In front of the hit, and everywhere on rays without one, the sign is that of the start.
        crossed = ((phi < 0.0) != (phi[:, :1] < 0.0)) & (t < ends) & meets[:, None]
        assert np.abs(phi[crossed]).max(initial=0.0) < ROUNDING
        x = row[hit, 1:4]
        assert np.abs(field(exact, x)).max() < ROUNDING
        assert np.abs(x - (a + row[:, :1] * b)[hit]).max() < 5e-6
        step = 1e-4 * row[hit, 4:7]
        assert (field(exact, x + step) > field(exact, x - step)).mean() > 0.999
        hits += hit.sum()
    assert hits > count // 4


@pytest.mark.parametrize("count", [4000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_no_ray_passes_the_surface(count: int) -> None:
    rng = np.random.default_rng(count)
    check_rays({"type": "sdfgrid", "grid": rough_grid(rng)}, rng, count, interpolated)


def test_two_numbers_hold_a_point() -> None:
    rng = np.random.default_rng(0)
    q = np.concatenate([rng.random((2000, 3)), np.indices((2, 2, 2)).reshape(3, -1).T]).astype(np.float32)
    held = wp.zeros(len(q), dtype=wp.vec2, device="cpu")
    back = wp.zeros(len(q), dtype=wp.vec3, device="cpu")
    wp.launch(hold, len(q), inputs=[wp.array(q, dtype=wp.vec3, device="cpu")], outputs=[held, back], device="cpu")
    assert np.isfinite(held.numpy()).all()
    assert np.abs(back.numpy() - q).max(axis=0) == pytest.approx([0.0, 0.0, 0.0], abs=5e-7)
    u, v = held.numpy().T
    np.testing.assert_allclose(held_points(u, v), back.numpy(), atol=1e-7)

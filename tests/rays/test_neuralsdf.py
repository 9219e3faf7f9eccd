"""Rays through networks of signed distances against float64: none passes the surface, and points are on it."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.networks import Net, blob, fitted, neck
from warp_psdr.kernels.primitive.dispatch import make_hit, make_surface_at
from warp_psdr.kernels.primitive.network_kind import NETWORK
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.scene.kinds.network_bounds import bounds_of, cells_of, values_of
from warp_psdr.scene.kinds.neuralsdf import Network

from .test_sdfgrid import rays, samples

HIT = make_hit((NETWORK.number,))
SURFACE = make_surface_at(False, True, False, False, (NETWORK.number,))
#: Rounding of phi in float32, and of distances along rays.
ROUNDING = 4e-6
NETS = {
    "softplus": (blob, (32, 32), 0, False, 10.0),
    "sharp": (blob, (32, 32), 0, False, 100.0),
    "sine": (neck, (32, 32), 0, True, 3.0),
    "frequencies": (neck, (24, 32), 2, False, 20.0),
    "deep": (blob, (40, 64, 64, 24), 0, False, 10.0),
}


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


def network(name: str) -> tuple[Net, Network]:
    net = fitted(*NETS[name], *([1.5] if name == "sine" else []))
    return net, Network(net.layers, net.frequencies, net.sine, net.scale, 32)


@pytest.mark.slow_rows("softplus-2000")
@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("softplus", 2000),
        ("sine", 2000),
        *(pytest.param(name, 100_000 if name == "softplus" else 20_000, marks=pytest.mark.slow) for name in NETS),
    ],
)
def test_no_ray_passes_the_surface(name: str, count: int) -> None:
    net, _ = network(name)
    held = psdr.load_dict(
        {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}, "body": net.plugin()}
    )
    rng = np.random.default_rng(count)
    o, d = rays(rng, count)
    given = [wp.array(x, dtype=wp.vec3, device=held.device) for x in (o, d)]
    out = wp.zeros((count, 7), dtype=wp.float32, device=held.device)
    wp.launch(trace, count, inputs=[held.data(), *given], outputs=[out], device=held.device)
    found = out.numpy().astype(np.float64)
    found[:, 1:4] += held.origin
    hits = 0
    for start in range(0, count, 1000):
        part = slice(start, start + 1000)
        a, b, row = o[part].astype(np.float64), d[part].astype(np.float64), found[part]
        t, meets = samples((17, 17, 17), a, b, 6)
        phi = net.phi(a[:, None] + t[..., None] * b[:, None])
        hit = row[:, 0] >= 0.0
        ends = np.where(hit, row[:, 0], np.inf)[:, None] - ROUNDING * (1.0 + np.abs(a).max(axis=1))[:, None]
        # In front of the hit, and everywhere on rays without one, the sign is that of the start.
        crossed = ((phi < 0.0) != (phi[:, :1] < 0.0)) & (t < ends) & meets[:, None]
        assert np.abs(phi[crossed]).max(initial=0.0) < ROUNDING
        x = row[hit, 1:4]
        assert np.abs(net.phi(x)).max() < ROUNDING
        assert np.abs(x - (a + row[:, :1] * b)[hit]).max() < 1e-5
        step = 1e-4 * row[hit, 4:7]
        assert (net.phi(x + step) > net.phi(x - step)).mean() > 0.999
        hits += hit.sum()
    assert hits > count // 8


@pytest.mark.slow_rows("sharp", "frequencies")
@pytest.mark.parametrize("name", NETS)
def test_bounds_hold(name: str) -> None:
    """In boxes of several sizes phi, and its second derivatives, lie between the bounds at random points."""
    net, held = network(name)
    rng = np.random.default_rng(1)
    for half in (0.0625, 0.0078):
        x = rng.uniform(half, 1.0 - half, (500, 3))
        found = bounds_of(held, x, np.full(3, half))
        inside = x[:, None] + half * rng.uniform(-1.0, 1.0, (500, 20, 3))
        phi = net.phi(inside)
        signs = (phi.min(axis=1) <= 0.0) & (phi.max(axis=1) >= 0.0)
        assert not (signs & ~found.passed).any()
        w = rng.standard_normal(inside.shape)
        w *= 1e-4 / np.linalg.norm(w, axis=-1, keepdims=True)
        bend = (net.phi(inside + w) - 2.0 * phi + net.phi(inside - w)) / 1e-8
        assert (np.abs(bend) <= found.bend[:, None] + 1e-5).all()
        np.testing.assert_allclose(values_of(held, x)[0], net.phi(x), atol=1e-12)
        np.testing.assert_allclose(values_of(held, x)[0], found.phi, atol=1e-12)


def test_cells_are_few() -> None:
    _net, held = network("softplus")
    cells = cells_of(held, 32)
    size = np.linalg.norm(values_of(held, (np.argwhere(cells <= 0.0)[:, ::-1] + 0.5) / 32)[1], axis=1)
    phi = values_of(held, (np.argwhere(cells <= 0.0)[:, ::-1] + 0.5) / 32)[0]
    assert (np.abs(phi) < 1.1 * size * np.sqrt(3.0) / 64).mean() > 0.9

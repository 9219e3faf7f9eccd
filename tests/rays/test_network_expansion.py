"""Networks next to a point: phi, its gradient and its Hessian, and bounds of slopes, against float64."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.networks import fitted, sphere
from warp_psdr.kernels.primitive.network import POSE
from warp_psdr.kernels.primitive.network_expansion import EXPANSION, network_expansion
from warp_psdr.scene.kinds.network_bounds import cells_of, steepness, values_of
from warp_psdr.scene.kinds.neuralsdf import Network

#: Rounding of float32 gradients and Hessians over their size, and that of phi, which comes out of double precision.
ROUNDING, ROUNDING_OF_PHI = 1e-4, 1e-7
NETS = {
    "softplus": {"widths": (24, 17)},
    "sines": {"sine": True, "scale": 3.0, "gain": 1.5, "widths": (32, 8, 16)},
    "frequencies": {"frequencies": 2, "widths": (40,)},
}


@wp.kernel(module="unique", enable_backward=False)
def expand(
    values: wp.array(dtype=wp.float32), place: wp.int32, at: wp.array(dtype=wp.vec3d), out: wp.array(dtype=EXPANSION)
):
    """Evaluate at points."""
    i = wp.tid()
    out[i] = network_expansion(values, place, at[i])


@pytest.mark.parametrize("name", NETS)
def test_expansion(name: str) -> None:
    net = fitted(sphere, **NETS[name])
    scene = psdr.load_dict(
        {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}, "body": net.plugin()}
    )
    x = np.random.default_rng(2).random((64, 3))
    found = wp.zeros(len(x), dtype=EXPANSION, device="cpu")
    place = scene.parameters["body.to_world"].offset + POSE
    wp.launch(expand, len(x), [scene.values, place, wp.array(x, dtype=wp.vec3d, device="cpu")], [found], device="cpu")
    found = found.numpy().astype(np.float64)
    network = Network(net.layers, net.frequencies, net.sine, net.scale, 32)
    phi, gradient = values_of(network, x)
    step = 1e-5 * np.eye(3)
    hessian = np.stack([(values_of(network, x + e)[1] - values_of(network, x - e)[1]) / 2e-5 for e in step], axis=1)
    second = hessian[:, [0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]
    assert np.abs(second).max() > 1.0
    assert np.abs(found[:, 0] - phi).max() < ROUNDING_OF_PHI * np.abs(phi).max()
    assert np.abs(found[:, 1:4] - gradient).max() < ROUNDING * np.abs(gradient).max()
    assert np.abs(found[:, 4:] - second).max() < ROUNDING * np.abs(second).max()


@pytest.mark.slow
@pytest.mark.slow_rows("sines")
@pytest.mark.parametrize("name", NETS)
def test_no_slope_is_above_its_bound(name: str) -> None:
    net = fitted(sphere, **NETS[name])
    network = Network(net.layers, net.frequencies, net.sine, net.scale, 16)
    slope, level = steepness(network, cells_of(network, 16))
    phi, gradient = values_of(network, np.random.default_rng(3).random((20000, 3)))
    met = np.linalg.norm(gradient, axis=1)[np.abs(phi) <= level].max()
    assert 0.05 < level < 1.0
    assert met < slope

"""Networks of signed distances: adjoints of phi and its gradient, and interior derivatives where all is seen."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.networks import Net, fitted, neck
from tests.path.test_sdfgrid import DIFFUSE, T
from warp_psdr.kernels.primitive.network import HEAD, make_network_sink, phi_along, pull_phi
from warp_psdr.scene.kinds.neuralsdf import Network, derived

from .test_sdfgrid import assert_slope, entry

FORWARD, REVERSE = make_network_sink("forward"), make_network_sink("reverse")
COUNT, A_PHI, STEP = 64, 0.7, 1e-5


@wp.kernel(module="unique", enable_backward=False)
def evaluate(
    values: wp.array(dtype=wp.float32),
    tangents: wp.array(dtype=wp.float32),
    sums: wp.array(dtype=wp.float32),
    q: wp.array(dtype=wp.vec3),
    w: wp.array(dtype=wp.vec3),
    out: wp.array2d(dtype=wp.float32),
):
    i = wp.tid()
    along = phi_along(values, 0, q[i], w[i])
    pulled = pull_phi(values, 0, q[i], wp.static(A_PHI), w[i])
    out[i, 0] = along[0]
    out[i, 1] = along[1]
    for k in range(4):
        out[i, 2 + k] = pulled[k]
    out[i, 6] = FORWARD(values, tangents, 0, q[i], wp.static(A_PHI), w[i])
    out[i, 7] = REVERSE(values, sums, 0, q[i], wp.static(A_PHI), w[i])


@pytest.mark.parametrize(
    "given", [((24, 33), 0, False, 10.0), ((20, 33), 2, False, 20.0), ((40, 16), 0, True, 3.0, 1.5)]
)
def test_adjoints(given: tuple) -> None:
    """Of a_phi phi + w . grad phi, by the place and by the weights, against differences in float64."""
    net = fitted(neck, *given)
    head, packed, cells = derived(Network(net.layers, net.frequencies, net.sine, net.scale, 16))
    weights = [np.concatenate([w.ravel(), b]) for w, b in net.layers]
    values = np.concatenate([head, *weights, packed, cells.ravel()]).astype(np.float32)
    size = sum(map(len, weights))
    rng = np.random.default_rng(2)
    q, w = rng.random((COUNT, 3)).astype(np.float32), rng.standard_normal((COUNT, 3)).astype(np.float32)
    tangents = np.zeros_like(values)
    tangents[HEAD : HEAD + size] = 0.1 * rng.standard_normal(size)
    out = wp.zeros((COUNT, 8), dtype=wp.float32, device="cpu")
    sums = wp.zeros(2 * len(values), dtype=wp.float32, device="cpu")
    flat = [wp.array(a, dtype=wp.float32, device="cpu") for a in (values, tangents)]
    places = [wp.array(a, dtype=wp.vec3, device="cpu") for a in (q, w)]
    wp.launch(evaluate, dim=COUNT, inputs=[*flat, sums, *places], outputs=[out], device="cpu")
    found, (q, w) = out.numpy().astype(np.float64), (a.astype(np.float64) for a in (q, w))

    def moved(step: float) -> Net:
        rest, layers = tangents[HEAD:].astype(np.float64), []
        for weight, bias in net.layers:
            a, rest = rest[: weight.size].reshape(weight.shape), rest[weight.size :]
            b, rest = rest[: bias.size], rest[bias.size :]
            layers.append((weight + step * a, bias + step * b))
        return Net(layers, net.frequencies, net.sine, net.scale)

    def pairing(of: Net, at: np.ndarray) -> np.ndarray:
        return A_PHI * of.phi(at) + (of.phi(at + STEP * w) - of.phi(at - STEP * w)) / (2.0 * STEP)

    by_place = [
        (pairing(net, q + 1e-4 * e) - pairing(net, q - 1e-4 * e)) / 2e-4 for e in np.eye(3)
    ]  # fmt: skip
    by_weights = (pairing(moved(1e-4), q) - pairing(moved(-1e-4), q)) / 2e-4
    expected = np.stack([net.phi(q), pairing(net, q) - A_PHI * net.phi(q), *by_place, net.phi(q), by_weights], axis=1)
    np.testing.assert_allclose(found[:, :7], expected, atol=1e-3 * np.abs(expected[:, 2:5]).max(), rtol=1e-4)
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=2e-5 * (1.0 + np.abs(expected[:, 1]).max()))
    reverse = sums.numpy().view(np.float64) @ tangents.astype(np.float64)
    assert reverse == pytest.approx(found[:, 6].sum(), rel=1e-4)
    assert not found[:, 7].any()


def hollow(x: np.ndarray) -> np.ndarray:
    c = (x - 0.5) * [1.0, 1.1, 0.95]
    return 0.42 - np.sqrt((c * c).sum(axis=-1) + 1e-3)


def cave() -> psdr.Scene:
    """A camera and a lamp in an ellipsoid of a network, where everything is seen from everywhere."""
    pose = np.eye(4)
    pose[:3, :3] = 2.0 * np.array([[1.0, 0.2, 0.0], [-0.1, 0.9, 0.1], [0.0, 0.1, 1.1]])
    pose[:3, 3] = -0.5 * pose[:3, :3].sum(axis=1)
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    view = T.look_at([0.1, -0.5, 0.1], [0.0, 0.3, 0.05], [0, 0, 1])
    return psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 80.0, "near_clip": 0.01, "to_world": view, "film": film},
            "light": {"type": "point", "position": [0.15, 0.1, 0.25], "intensity": 1.0},
            "cave": fitted(hollow, (16, 24)).plugin(cells=16, to_world=T(pose), bsdf=DIFFUSE),
        }
    )


def direction(shape: tuple[int, ...], size: float) -> np.ndarray:
    return size * np.random.default_rng(5).standard_normal(shape)


@pytest.mark.slow_rows(
    "cave.layer1.weight", "cave.layer0.weight", "cave.layer2.bias", "cave.to_world", "sensor.to_world"
)
@pytest.mark.parametrize(
    ("name", "tangent", "step"),
    [
        ("cave.layer1.weight", direction((24, 16), 1.0), 0.002),
        ("cave.layer0.weight", direction((16, 3), 1.0), 0.002),
        ("cave.layer2.bias", np.ones(1), 0.003),
        ("cave.to_world", entry(2, 2), 0.005),
        ("sensor.to_world", entry(2, 3), 0.005),
    ],
    ids=["cave.layer1.weight", "cave.layer0.weight", "cave.layer2.bias", "cave.to_world", "sensor.to_world"],
)
def test_slope_of_what_moves_where_all_is_seen(name: str, tangent: np.ndarray, step: float) -> None:
    assert_slope(cave(), name, tangent, step, 64)

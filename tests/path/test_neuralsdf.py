"""Images of networks of signed distances: those of B-splines through their values."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.networks import Net, blob, fitted, neck
from warp_psdr.sdf import coefficients

from .helpers import batches, blocks, largest_z, mean_and_variance, z_limit
from .test_sdfgrid import DIFFUSE, PLAIN, ROUGH, TURNED, T, scene

#: Of images of a network and of a B-spline through its values at 49^3 nodes.
SPLINE = 2e-3
SPP = 12


def of_network(net: Net, pose: psdr.Transform, bsdf: dict, **more) -> dict:
    described = scene(np.zeros((2, 2, 2)), pose, "analytic", bsdf, **more)
    return {**described, "body": net.plugin(to_world=pose, bsdf=bsdf)}


def of_spline(net: Net, pose: psdr.Transform, bsdf: dict) -> dict:
    described = scene(coefficients(net.grid(49)), pose, "analytic", bsdf)
    described["body"]["interpolation"] = "cubic"
    return described


@pytest.mark.slow
@pytest.mark.parametrize(
    ("net", "pose", "bsdf"),
    [
        ((blob, (32, 32), 0, False, 10.0), TURNED, DIFFUSE),
        ((neck, (32, 32), 0, True, 3.0, 1.5), PLAIN, ROUGH),
        ((blob, (24, 32), 2, False, 20.0), PLAIN, {"type": "dielectric"}),
        ((neck, (40, 64, 64, 24)), TURNED, DIFFUSE),
    ],
    ids=["softplus", "rough", "glass", "deep"],
)
def test_image_is_that_of_a_spline(net: tuple, pose: psdr.Transform, bsdf: dict) -> None:
    net = fitted(*net)
    a = batches(psdr.load_dict(of_network(net, pose, bsdf)), count=8, spp=SPP, max_depth=4)
    b = batches(psdr.load_dict(of_spline(net, pose, bsdf)), count=8, spp=SPP, seed=100, max_depth=4)
    (mean_a, var_a), (mean_b, var_b) = (mean_and_variance(blocks(x, 8)) for x in (a, b))
    z = largest_z(var_a, var_b, mean_a - mean_b, mean_b, SPLINE)
    assert z.max() < z_limit(z.size, len(a) - 1)
    assert np.abs(mean_a / mean_b - 1.0).max() < 0.04


@pytest.mark.slow
def test_traced_vertices_lie_on_it() -> None:
    net = fitted()
    held = psdr.load_dict(of_network(net, TURNED, DIFFUSE))
    vertex = psdr.trace_sample(held, pixel=(16, 14), sample=0).vertices[0]
    assert vertex.shape == "body" and vertex.face == -1
    local = np.linalg.inv(TURNED.matrix) @ np.append(vertex.position, 1.0)
    assert net.phi(local[:3]) == pytest.approx(0.0, abs=1e-5)


@pytest.mark.slow
def test_it_stands_beside_other_shapes() -> None:
    """A grid, a network and an exact sphere in one scene."""
    net = fitted(neck)
    ball = {"type": "sphere", "center": [0.9, -0.6, 0.3], "radius": 0.3, "bsdf": DIFFUSE}
    other = {"type": "sdfgrid", "grid": coefficients(fitted().grid(33)), "interpolation": "cubic", "bsdf": ROUGH}
    other["to_world"] = T.translate([-1.5, -0.8, 0.1])
    images = []
    for exact in (True, False):
        more = {"ball": {**ball, "exact": exact, **({} if exact else {"resolution": 512})}, "other": other}
        if not exact:
            more["ball"].pop("exact")
        images.append(batches(psdr.load_dict(of_network(net, PLAIN, DIFFUSE, **more)), count=4, spp=32, max_depth=3))
    (mean_a, var_a), (mean_b, var_b) = (mean_and_variance(blocks(x, 8)) for x in images)
    z = largest_z(var_a, var_b, mean_a - mean_b, mean_b, 5e-3)
    assert z.max() < z_limit(z.size, 3)

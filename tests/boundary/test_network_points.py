"""Samplers of silhouettes of networks against each other, and items that are left out."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.networks import fitted, neck, sphere
from warp_psdr.kernels.boundary.silhouette.grid_points import (
    GridItems,
    TouchPoint,
    area_of_voxel_area,
    choose_item,
    eye_in_voxels,
    item_parts,
)
from warp_psdr.kernels.boundary.silhouette.grid_sampling import own_density, own_direction
from warp_psdr.kernels.boundary.silhouette.network_points import network_curve_point, network_surface_point
from warp_psdr.kernels.boundary.silhouette.spline_points import spline_curvature
from warp_psdr.kernels.primitive.network import network_of
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.scene.kinds.network_bounds import cells_of
from warp_psdr.scene.kinds.neuralsdf import Network
from warp_psdr.topology.kinds.network_silhouettes import network_items, network_shapes, passed_cells, seen_cells

from .etendue import LIMIT, assert_shares_agree, bin_of, spread

SAMPLES = 100_000


@wp.kernel(module="unique", enable_backward=False)
def touch_network(scene: Scene, found: GridItems, towards: wp.int32, seed: wp.int32, out: wp.array2d(dtype=wp.float64)):
    """One line that touches the network: its measure, and an element of area."""
    t = wp.tid()
    state = wp.rand_init(seed, t)
    count = found.items.shape[0]
    n, _along = choose_item(found, count, wp.float64(wp.randf(state)))
    item = found.items[n]
    tri = triangle_at(scene, item[0])
    g = network_of(scene, tri)
    parts = item_parts(g, item[1])
    a = wp.randf(state)
    b = wp.randf(state)
    eye = wp.sample_unit_sphere_surface(state)
    u = wp.randf(state)
    v = wp.randf(state)
    choice = wp.randf(state)
    point = TouchPoint()
    if towards == 1:
        point = network_curve_point(scene, tri, g, parts, eye_in_voxels(tri, g, eye, True), True, u, choice)
    else:
        point = network_surface_point(scene, tri, g, parts, u, v, choice)
    if point.valid == 0:
        return
    each = wp.float32(count) * point.roots
    w = eye
    if towards == 0:
        w = own_direction(point, wp.vec2(a, b))
        out[t, 1] = wp.float64(each * area_of_voxel_area(tri, g, point) / point.density)
    curvature = spline_curvature(tri, g, point, w)
    if curvature <= 0.0:
        return
    measure = wp.float32(0.0)
    if towards == 1:
        measure = 4.0 * 3.14159265 / point.density * wp.length(wp.cross(point.along, w))
    else:
        measure = 1.0 / own_density(tri, g, point, curvature)
    out[t, 0] = wp.float64(each * measure)
    out[t, 2] = bin_of(point.q - wp.vec3(0.5), w)


def measured(scene: psdr.Scene, towards: int, samples: int = SAMPLES) -> np.ndarray:
    found = network_items(scene, network_shapes(scene), None)
    out = wp.zeros((samples, 3), dtype=wp.float64, device=scene.device)
    wp.launch(touch_network, samples, inputs=[scene.data(), found, towards, 3 + towards], outputs=[out])
    return out.numpy()


@pytest.mark.slow
def test_both_techniques_have_one_measure() -> None:
    """All lines that touch a network under an affine map, by directions of items and by directions of the sphere."""
    pose = np.eye(4)
    pose[:3, :3] = [[1.5, 0.4, 0.0], [0.0, -0.8, 0.1], [0.2, 0.0, 1.1]]
    body = fitted(neck, (24, 24)).plugin(to_world=psdr.Transform(pose), cells=16)
    scene = psdr.load_dict(
        {"type": "scene", "body": body, "sensor": {"type": "perspective"}, "sky": {"type": "constant"}}
    )
    found = [measured(scene, k) for k in range(2)]
    (own, own_error), (towards, error) = (spread(f) for f in found)
    limit = LIMIT * np.hypot(own_error, error)[0]
    assert abs(own - towards)[0] < limit < 0.1 * own[0], (own, towards, limit)
    assert_shares_agree([(f[:, 0], f[:, 2]) for f in found])


@pytest.mark.slow
def test_lines_that_touch_a_ball() -> None:
    """Their integral is 8 pi^2 r, also where rounding of phi is large: values of some 6 / omega^2 are subtracted."""
    omega, radius = 0.6, 1.0 / 3.0
    ball = {
        "type": "neuralsdf",
        "activation": "sine",
        "omega": omega,
        "layer0.weight": np.eye(3),
        "layer0.bias": np.full(3, 0.5 * np.pi / omega - 0.5),
        "layer1.weight": np.full((1, 3), -2.0 / omega**2),
        "layer1.bias": np.array([6.0 / omega**2 - radius**2]),
    }
    scene = psdr.load_dict(
        {"type": "scene", "body": ball, "sensor": {"type": "perspective"}, "sky": {"type": "constant"}}
    )
    found, error = spread(measured(scene, 1, 16 * SAMPLES))
    expected = 8.0 * np.pi**2 * radius
    assert error[0] < 0.01 * expected
    assert abs(found[0] - expected) < 3.0 * error[0], (found, error, expected)


@pytest.mark.parametrize("distant", [False, True])
def test_items_left_out_have_no_silhouette(distant: bool) -> None:
    """No point of a cell that bounds leave out is one, seen from anywhere in a box."""
    net = fitted(sphere, (24, 24))
    network = Network(net.layers, net.frequencies, net.sine, net.scale, 16)
    at = passed_cells(cells_of(network, 16))
    low = np.array([0.3, -0.9, 0.2]) if distant else np.array([2.0, -1.4, 1.2])
    high = low + (0.02 if distant else 0.1)
    shown = seen_cells(network, at, low, high, distant)
    assert 0.02 < shown.mean() < 0.9
    rng, step = np.random.default_rng(2), 1e-5

    def slopes(points: np.ndarray) -> np.ndarray:
        return np.stack([net.phi(points + step * e) - net.phi(points - step * e) for e in np.eye(3)], axis=1) / 2e-5

    told = 0
    for i in np.flatnonzero(~shown)[::5]:
        points = (at[i] + rng.random((256, 3))) / 16.0
        for _ in range(4):  # onto the surface
            slope = slopes(points)
            points = points - (net.phi(points) / (slope * slope).sum(axis=1))[:, None] * slope
        points = points[(np.abs(16.0 * points - at[i] - 0.5) < 0.5).all(axis=1) & (np.abs(net.phi(points)) < 1e-9)]
        eyes = low + rng.random(points.shape) * (high - low)
        facing = (slopes(points) * (eyes if distant else points - eyes)).sum(axis=1)
        assert (facing > 0.0).all() or (facing < 0.0).all()
        told += len(points)
    assert told > 300

"""Samplers of silhouettes of smooth grids against each other, closed forms, and the étendue that a grid blocks."""

import numpy as np
import pytest
import warp as wp

from tests.path.test_sdfgrid import sphere
from warp_psdr.kernels.boundary.silhouette.grid_points import (
    GridItems,
    TouchPoint,
    area_of_voxel_area,
    choose_item,
    eye_in_voxels,
    item_parts,
)
from warp_psdr.kernels.boundary.silhouette.grid_sampling import own_density, own_direction
from warp_psdr.kernels.boundary.silhouette.spline_points import (
    make_cubic_touch_sink,
    spline_curvature,
    spline_curve_point,
    spline_surface_point,
)
from warp_psdr.kernels.primitive.sdfgrid import grid_of
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.topology.grid_contacts import spline_interpolated
from warp_psdr.topology.kinds.grid_silhouettes import items_of, spline_may_show

from .etendue import LIMIT, assert_shares_agree, bin_of, blocked, growth, is_free, loaded, shapes, spread, sums, touches

ACCUMULATE = make_cubic_touch_sink("forward")
SAMPLES = 400_000
CUBIC = {"interpolation": "cubic"}


@wp.kernel(module="unique", enable_backward=False)
def touch_smoothly(
    scene: Scene,
    found: GridItems,
    tangents: wp.array(dtype=wp.float32),
    towards: wp.int32,
    seed: wp.int32,
    out: wp.array2d(dtype=wp.float64),
):
    """One line that touches the grid: its measure, times the speed, of those that pass, and an element of area."""
    t = wp.tid()
    state = wp.rand_init(seed, t)
    count = found.items.shape[0]
    n, _along = choose_item(found, count, wp.float64(wp.randf(state)))
    item = found.items[n]
    tri = triangle_at(scene, item[0])
    g = grid_of(scene, tri)
    parts = item_parts(g, item[1])
    a = wp.randf(state)
    b = wp.randf(state)
    eye = wp.sample_unit_sphere_surface(state)
    u = wp.randf(state)
    v = wp.randf(state)
    choice = wp.randf(state)
    point = TouchPoint()
    if towards == 1:
        point = spline_curve_point(scene, tri, g, parts, eye_in_voxels(tri, g, eye, True), True, u, choice)
    else:
        point = spline_surface_point(scene, tri, g, parts, u, v, choice)
    if point.valid == 0:
        return
    point.face = item[0]
    each = wp.float32(count) * point.roots
    w = eye
    if towards == 0:
        w = own_direction(point, wp.vec2(a, b))
        out[t, 3] = wp.float64(each * area_of_voxel_area(tri, g, point) / point.density)
    curvature = spline_curvature(tri, g, point, w)
    if curvature <= 0.0:
        return
    measure = wp.float32(0.0)
    if towards == 1:
        measure = 4.0 * 3.14159265 / point.density * wp.length(wp.cross(point.along, w))
    else:
        measure = 1.0 / own_density(tri, g, point, curvature)
    out[t, 0] = wp.float64(each * measure)
    out[t, 4] = bin_of(point.q - wp.vec3(0.5), w)
    if towards == 0:
        speed = ACCUMULATE(scene, tangents, point, point.out)
        out[t, 1] = wp.float64(each * measure * speed)
        if is_free(scene, point.x, point.out, w):
            out[t, 2] = out[t, 1]


@pytest.mark.slow
def test_lines_that_touch_a_sphere() -> None:
    """The integral of kappa_n dA dtheta is pi dS/dr = 8 pi^2 r, and the density of points gives the area."""
    count, radius = 24, 0.4
    found, error = sums(touch_smoothly, (SAMPLES, 5), loaded(sphere(count, radius), **CUBIC), -1.0, 0, 11)
    smoothed = radius - 1.0 / (3.0 * radius * (count - 1) ** 2)
    assert (error[[1, 3]] < 0.003 * found[[1, 3]]).all()
    assert found[1] == pytest.approx(8.0 * np.pi**2 * smoothed, rel=0.01)
    assert found[3] == pytest.approx(4.0 * np.pi * smoothed**2, rel=0.01)


@pytest.mark.slow
def test_both_techniques_have_one_measure() -> None:
    """All lines that touch a grid under an affine map, by directions of items and by directions of the sphere."""
    pose = np.eye(4)
    pose[:3, :3] = [[1.5, 0.4, 0.0], [0.0, -0.8, 0.1], [0.2, 0.0, 1.1]]
    scene = loaded(shapes(10), pose, **CUBIC)
    found = [touches(touch_smoothly, (SAMPLES, 5), scene, 0.0, k, 7 + k) for k in range(2)]
    (own, own_error), (towards, error) = (spread(f) for f in found)
    limit = LIMIT * np.hypot(own_error, error)[0]
    assert abs(own - towards)[0] < limit < 0.05 * own[0], (own, towards, limit)
    assert_shares_agree([(f[:, 0], f[:, 4]) for f in found])


@pytest.mark.slow
def test_blocked_etendue() -> None:
    """By all values of a grid, of two spheres that are blended, with a neck that curves both ways."""
    grid, tangent = shapes(16), growth(16)
    found, error = sums(touch_smoothly, (SAMPLES, 5), loaded(grid, **CUBIC), tangent, 0, 3)
    expected, deviation = blocked(grid, tangent, **CUBIC)
    assert abs(found[2] - expected) < LIMIT * np.hypot(error[2], deviation), (found, error, expected, deviation)
    assert max(deviation, error[2]) < 0.03 * expected


def test_items_left_out_have_no_silhouette() -> None:
    """No point of a voxel that interval arithmetic leaves out is one, seen from anywhere in a box."""
    rng = np.random.default_rng(2)
    values = (shapes(12)[..., 0] + 0.003 * rng.standard_normal((12, 12, 12))).astype(np.float64)
    numbers = items_of(values, cubic=True)
    low, high = np.array([24.0, -16.0, 14.0]), np.array([25.0, -15.0, 15.0])
    shown = spline_may_show(values, numbers, low, high, False)
    assert 0.02 < shown.mean() < 0.9
    node, step = numbers >> 2, 1e-5
    corner = np.stack([node % 12, node // 12 % 12, node // 144], axis=1)
    for i in np.flatnonzero(~shown)[::7]:
        points = corner[i] + rng.uniform(0.001, 0.999, (64, 3))
        eyes = low + rng.random((64, 3)) * (high - low)
        slope = [
            spline_interpolated(values, points + step * e) - spline_interpolated(values, points - step * e)
            for e in np.eye(3)
        ]
        facing = (np.stack(slope, axis=1) * (points - eyes)).sum(axis=1)
        assert (facing > 0.0).all() or (facing < 0.0).all()

"""Samplers of creases and silhouettes of grids against each other, and the étendue that grids block."""

import numpy as np
import pytest
import warp as wp

from tests.path.test_sdfgrid import sphere
from warp_psdr.kernels.boundary.silhouette.grid_points import (
    VOXEL_ITEM,
    GridItems,
    TouchPoint,
    area_of_voxel_area,
    choose_item,
    crease_point,
    crease_side,
    curve_point,
    eye_in_voxels,
    item_parts,
    make_linear_touch_sink,
    surface_point,
    touch_curvature,
)
from warp_psdr.kernels.boundary.silhouette.grid_sampling import own_density, own_direction
from warp_psdr.kernels.primitive.sdfgrid import grid_of
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.topology.kinds.grid_silhouettes import (
    Eyes,
    facing_creases,
    grid_items,
    grid_shapes,
    items_of,
    may_face,
    may_show,
)

from .etendue import LIMIT, assert_shares_agree, bin_of, blocked, growth, is_free, loaded, shapes, spread, sums, touches

ACCUMULATE = make_linear_touch_sink("forward")
SAMPLES = 1_000_000
ANALYTIC = {"normals": "analytic"}


@wp.kernel(module="unique", enable_backward=False)
def touch(
    scene: Scene,
    found: GridItems,
    tangents: wp.array(dtype=wp.float32),
    towards: wp.int32,
    seed: wp.int32,
    out: wp.array2d(dtype=wp.float64),
):
    """One line that touches the grid: 1 / density, of creases and in voxels; and what of it is blocked anew.

    ``towards``: 0 in a direction of its own, 1 in any, 2 along z.
    """
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
    if towards == 2:
        eye = wp.vec3(0.0, 0.0, 1.0)
    u = wp.randf(state)
    v = wp.randf(state)
    point = TouchPoint()
    if parts[3] != VOXEL_ITEM:
        point = crease_point(scene, tri, g, parts, u)
    elif towards > 0:
        point = curve_point(scene, tri, g, parts, eye_in_voxels(tri, g, eye, True), True, u)
    else:
        point = surface_point(scene, tri, g, parts, u, v)
    if point.valid == 0:
        return
    point.face = item[0]
    w = eye
    if towards == 0:
        w = own_direction(point, wp.vec2(a, b))
    curvature = wp.float32(0.0)
    normal = point.out
    size = wp.float32(1.0)
    measure = wp.float32(0.0)
    if point.crease == 1:
        side = crease_side(point, w)
        if side == 0.0:
            return
        normal = -side * wp.cross(point.along, w)
        size = wp.length(normal)
        normal /= size
    else:
        curvature = touch_curvature(tri, g, point, w)
        if curvature <= 0.0:
            return
    if towards > 0:
        measure = 4.0 * 3.14159265 / point.density
        if point.crease == 0:
            size = wp.length(wp.cross(point.along, w))
    else:
        measure = 1.0 / own_density(tri, g, point, curvature)
    value = wp.float64(wp.float32(count) * measure * size)
    column = 1 - point.crease
    out[t, column] = value
    out[t, 5] = bin_of(point.q - wp.vec3(0.5), w)
    if towards == 0:
        out[t, 4] = wp.float64(wp.where(point.crease == 1, 0.0, wp.float32(count) * area_of_voxel_area(tri, g, point)))
        out[t, 4] = out[t, 4] / wp.float64(point.density)
        if is_free(scene, point.x, normal, w):
            out[t, 2 + column] = value * wp.float64(ACCUMULATE(scene, tangents, point, normal))


def test_both_techniques_have_one_measure() -> None:
    """All lines that touch a grid under an affine map, by directions of items and by directions of the sphere."""
    pose = np.eye(4)
    pose[:3, :3] = [[1.5, 0.4, 0.0], [0.0, -0.8, 0.1], [0.2, 0.0, 1.1]]
    scene = loaded(shapes(10), pose, **ANALYTIC)
    found = [touches(touch, (SAMPLES, 6), scene, 0.0, k, 7 + k) for k in range(2)]
    (own, own_error), (towards, error) = (spread(f) for f in found)
    gap, limit = np.abs(own - towards)[:2], LIMIT * np.hypot(own_error, error)[:2]
    assert (gap < limit).all() and (limit < 0.1 * own[:2]).all(), (own, towards, limit)
    for column in (0, 1):
        assert_shares_agree([(f[:, column], f[:, 5]) for f in found])


@pytest.mark.parametrize("count", [16, 17])
def test_outline_along_an_axis(count: int) -> None:
    """With 16 nodes the sheets around the middle are seen from their edges."""
    found, error = sums(touch, (SAMPLES, 6), loaded(sphere(count, 0.4), **ANALYTIC), 0.0, 2, 5)
    outline = (found[0] + found[1]) / (4.0 * np.pi)
    assert (error[:2] < 0.015 * (4.0 * np.pi) * outline).all()
    assert outline == pytest.approx(2.0 * np.pi * 0.4, rel=0.05)


@pytest.mark.slow_rows("16")
@pytest.mark.parametrize("count", [16, pytest.param(64, marks=pytest.mark.slow)])
def test_blocked_etendue(count: int) -> None:
    """By all values of a grid: creases have most of it, also where the grid is fine."""
    grid, tangent = shapes(count), growth(count)
    found, error = sums(touch, (SAMPLES, 6), loaded(grid, **ANALYTIC), tangent, 0, 3)
    expected, deviation = blocked(grid, tangent, **ANALYTIC)
    total = found[2] + found[3]
    assert abs(total - expected) < LIMIT * np.sqrt(error[2] ** 2 + error[3] ** 2 + deviation**2)
    assert max(deviation, error[2]) < 0.03 * expected
    assert 0.85 < found[2] / total < 0.99


def test_area_of_a_sphere() -> None:
    """The sampler's density on the surface: tri-linear interpolation moves a sphere by parts of a voxel squared."""
    found, error = sums(touch, (SAMPLES, 6), loaded(sphere(32, 0.4), **ANALYTIC), 0.0, 0, 11)
    assert error[4] < 0.005 * found[4]
    assert found[4] == pytest.approx(4.0 * np.pi * 0.16, rel=0.015)


def test_items_left_out_have_no_silhouette() -> None:
    """No point of an item that interval arithmetic leaves out is one, seen from anywhere in a box."""
    rng = np.random.default_rng(2)
    values = (shapes(12)[..., 0] + 0.01 * rng.standard_normal((12, 12, 12))).astype(np.float64)
    numbers = items_of(values)
    low, high = np.array([20.0, -6.0, 14.0]), np.array([22.0, -3.0, 17.0])
    shown = may_show(values, numbers, low, high, False)
    assert 0.02 < shown.mean() < 0.6
    scene = loaded(values[..., None].astype(np.float32), **ANALYTIC)
    eyes = Eyes(np.array([[20.5, -4.0, 15.0]]) / 11.0, False)
    found = grid_items(scene, grid_shapes(scene), [eyes])
    assert found is not None and 0 < found.aimed < shown.sum()
    node = numbers >> 2
    corner = np.stack([node % 12, node // 12 % 12, node // 144], axis=1)
    hidden = np.flatnonzero(~shown & ((numbers & 3) == 3))
    for i in hidden[:: max(1, len(hidden) // 40)]:
        signs = set()
        for _ in range(64):
            place, eye = rng.random(3), low + rng.random(3) * (high - low)
            c = values[tuple(slice(a, a + 2) for a in corner[i][::-1])].transpose(2, 1, 0)
            w = [np.array([1.0 - f, f]) for f in place]
            rate = np.array([-1.0, 1.0])
            slope = [np.einsum("ijk,i,j,k", c, *(rate if a == b else w[b] for b in range(3))) for a in range(3)]
            signs.add(bool(np.dot(slope, corner[i] + place - eye) > 0.0))
        assert len(signs) == 1


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["solid", "hollow"])
def test_creases_left_out_turn_a_back(sign: float) -> None:
    """Of a crease that interval arithmetic leaves out a sheet is seen from behind, from anywhere in a box outside."""
    rng = np.random.default_rng(3)
    values = sign * (shapes(12)[..., 0] + 0.01 * rng.standard_normal((12, 12, 12))).astype(np.float64)
    numbers = items_of(values, concave=True)
    low, high = np.array([20.0, -6.0, 14.0]), np.array([22.0, -3.0, 17.0])
    faces = may_face(values, numbers, low, high, False)
    assert 0.3 < faces.mean() < 0.7
    assert may_face(values, numbers, np.full(3, -1.0), np.full(3, 3.0), False).all()
    away = np.array([5.5, 5.5, 5.5]) - 0.5 * (low + high)
    distant = may_face(values, numbers, -away, -away, True)
    assert (distant == faces).mean() > 0.8
    node, kind = numbers >> 2, numbers & 3
    corner = np.stack([node % 12, node // 12 % 12, node // 144], axis=1)
    hidden = np.flatnonzero(~faces)
    for i in hidden[:: max(1, len(hidden) // 40)]:
        turned = np.ones(2, bool)
        for _ in range(64):
            place, eye = rng.random(3), low + rng.random(3) * (high - low)
            place[kind[i]] = 0.0
            for side in range(2):
                before = corner[i] - side * np.eye(3, dtype=int)[kind[i]]
                w = [np.array([1.0 - f, f]) for f in corner[i] + place - before]
                c = values[tuple(slice(a, a + 2) for a in before[::-1])].transpose(2, 1, 0)
                rate = np.array([-1.0, 1.0])
                slope = [np.einsum("ijk,i,j,k", c, *(rate if a == b else w[b] for b in range(3))) for a in range(3)]
                turned[side] &= bool(sign * np.dot(slope, corner[i] + place - eye) > 0.0)
        assert turned.any()
    scene = loaded(values[..., None].astype(np.float32), **ANALYTIC)
    found = facing_creases(scene, grid_shapes(scene), Eyes(np.array([[20.5, -4.0, 15.0]]) / 11.0, False))
    assert found is not None and found.aimed == 0 and 0 < len(found.items) <= faces.sum()

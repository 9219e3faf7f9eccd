"""Vector algebra: frames, and roots whose derivatives stay finite."""

import numpy as np
import pytest
import warp as wp

from tests.bsdf.helpers import direction, random_directions
from warp_psdr.kernels.math import aligned_tangent, any_tangent, safe_normalize, safe_sqrt, to_local, to_world


@wp.kernel(module="unique", enable_backward=False)
def frames(
    n: wp.array(dtype=wp.vec3),
    tangent: wp.array(dtype=wp.vec3),
    plain_out: wp.array(dtype=wp.mat33),
    aligned_out: wp.array(dtype=wp.mat33),
    round_trip_out: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    s = any_tangent(n[i])
    t = wp.cross(n[i], s)
    plain_out[i] = wp.matrix_from_rows(s, t, n[i])
    round_trip_out[i] = to_world(s, t, n[i], to_local(s, t, n[i], tangent[i]))
    a = aligned_tangent(n[i], tangent[i])
    aligned_out[i] = wp.matrix_from_rows(a, wp.cross(n[i], a), n[i])


@wp.func
def first_component(x: wp.float32) -> wp.float32:
    return safe_normalize(wp.vec3(x, 0.0, x))[0]


@wp.kernel(module="unique", enable_backward=False)
def safe_functions(
    x: wp.array(dtype=wp.float32), value_out: wp.array(dtype=wp.vec2), slope_out: wp.array(dtype=wp.vec2)
):
    i = wp.tid()
    value_out[i] = wp.vec2(safe_sqrt(x[i]), first_component(x[i]))
    slope_out[i] = wp.vec2(wp.grad(safe_sqrt)(x[i]), wp.grad(first_component)(x[i]))


def run_frames(device: str, n: np.ndarray, tangent: np.ndarray) -> list[np.ndarray]:
    inputs = [wp.array(a, dtype=wp.vec3, device=device) for a in (n, tangent)]
    outputs = [wp.empty(len(n), dtype=t, device=device) for t in (wp.mat33, wp.mat33, wp.vec3)]
    wp.launch(frames, len(n), inputs, outputs, device=device)
    return [a.numpy() for a in outputs]


def test_frames_are_right_handed_orthonormal_and_end_in_the_normal(device: str) -> None:
    rng = np.random.default_rng(0)
    n = random_directions(rng, 200, both_sides=True)
    n[:4] = [0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], direction(179.999)
    tangent = random_directions(rng, 200, both_sides=True)
    plain, aligned, round_trip = run_frames(device, n, tangent)
    for frame in (plain, aligned):
        np.testing.assert_allclose(frame @ frame.swapaxes(1, 2), np.tile(np.eye(3), (200, 1, 1)), atol=2e-6)
        np.testing.assert_allclose(np.linalg.det(frame), 1.0, atol=2e-6)
        np.testing.assert_allclose(frame[:, 2], n, atol=1e-7)
    along = np.einsum("ni,ni->n", aligned[:, 0], tangent)
    np.testing.assert_allclose(along, np.linalg.norm(np.cross(n, tangent), axis=1), atol=2e-6)
    np.testing.assert_allclose(round_trip, tangent, atol=2e-6)


@pytest.mark.parametrize("tangent", [(0.0, 0.0, 0.0), (0.6, 0.0, 0.8), (-1.2, 0.0, -1.6)])
def test_a_useless_tangent_falls_back_on_the_normal_alone(device: str, tangent) -> None:
    n = np.array([[0.6, 0.0, 0.8]])
    plain, aligned, _ = run_frames(device, n, np.array([tangent]))
    np.testing.assert_array_equal(plain, aligned)


def test_safe_functions_have_their_values_and_finite_slopes(device: str) -> None:
    x = np.array([-2.0, -1.0, -0.5, 0.0, 1e-35, 0.25, 1.0, 2.0], np.float32)
    value, slope = (wp.empty(len(x), dtype=wp.vec2, device=device) for _ in range(2))
    wp.launch(safe_functions, len(x), [wp.array(x, device=device)], [value, slope], device=device)
    value, slope = value.numpy(), slope.numpy()
    np.testing.assert_allclose(value[:, 0], np.sqrt(np.where(x > 1e-30, x, 0.0)), rtol=1e-6)
    np.testing.assert_allclose(value[:, 1], np.where(np.abs(x) > 1e-20, np.sign(x) * np.sqrt(0.5), 0.0), atol=1e-6)
    assert np.all(np.isfinite(slope))
    np.testing.assert_allclose(slope[5:, 0], 0.5 / np.sqrt(x[5:]), rtol=1e-5)
    assert np.all(slope[x <= 0.0, 0] == 0.0)
    np.testing.assert_allclose(slope[:, 1], 0.0, atol=1e-6)

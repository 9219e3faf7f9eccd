"""Velocities of points and normals on grids of signed distances against finite differences in float64."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.rays.test_sdfgrid_cubic import weights as spline_weights
from warp_psdr.kernels.primitive.cubic_grid import CUBIC_GRID
from warp_psdr.kernels.primitive.dispatch import make_hit, make_velocity
from warp_psdr.kernels.primitive.linear_grid import LINEAR_GRID
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene

KINDS = (LINEAR_GRID.number, CUBIC_GRID.number)
HIT = make_hit(KINDS)
VELOCITY = make_velocity(False, True, False, False, KINDS)
STEP = 1e-6
#: Of velocities of size one: float32, and points within 2.4e-7 of the box.
ROUNDING = 2e-3


@wp.kernel(module="unique", enable_backward=False)
def move(
    scene: Scene,
    tangents: wp.array(dtype=wp.float32),
    rays: wp.array2d(dtype=wp.vec3),
    moved: wp.array2d(dtype=wp.vec3),
    out: wp.array2d(dtype=wp.vec3),
):
    i = wp.tid()
    o = rays[i, 0]
    d = rays[i, 1]
    hit = HIT(scene, triangle_at(scene, 0), o, d, 1.0e30)
    if hit.face >= 0:
        zero = wp.vec3(0.0, 0.0, 0.0)
        found = VELOCITY(scene, tangents, 0, hit.u, hit.v, True, o, d, moved[i, 0], moved[i, 1])
        tied = VELOCITY(scene, tangents, 0, hit.u, hit.v, False, o, d, zero, zero)
        out[i, 0] = found.x
        out[i, 1] = found.n
        out[i, 2] = tied.x
        out[i, 3] = wp.vec3(hit.t, 0.0, 0.0)


def slopes(values: np.ndarray, q: np.ndarray, cubic: bool = False) -> tuple[float, np.ndarray]:
    """Value and gradient of an interpolation, both in voxels; ``values`` by x, y, z."""
    cell = np.clip(q.astype(int), 0, np.array(values.shape) - 2)
    f = q - cell
    if cubic:
        c = np.pad(values, 1, mode="edge")[tuple(slice(a, a + 4) for a in cell)]
        weights, rates = ([spline_weights(x, order) for x in f] for order in range(2))
    else:
        c = values[tuple(slice(a, a + 2) for a in cell)]
        weights = [np.array([1.0 - x, x]) for x in f]
        rates = [np.array([-1.0, 1.0])] * 3
    value = np.einsum("ijk,i,j,k", c, *weights)
    return value, np.array([
        np.einsum("ijk,i,j,k", c, *(rates[b] if b == a else weights[b] for b in range(3))) for a in range(3)
    ])  # fmt: skip


def smooth(values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The dual interpolation of normals, inside of the outer half voxels."""
    n, first = np.array(values.shape) - 1, np.floor(q + 0.5).astype(int) - 1
    w = q - first - 0.5
    total = np.zeros(3)
    for corner in np.ndindex(2, 2, 2):
        m = np.empty(3)
        for a in range(3):
            at = q.copy()
            at[a] = first[a] + corner[a] + 0.5  # the slope along an axis is constant along it
            m[a] = slopes(values, at)[1][a]
        m *= n
        share = np.prod([w[a] if on else 1.0 - w[a] for a, on in enumerate(corner)])
        total += share * m / np.linalg.norm(m)
    return total


def hit(values, pose, o, d, t, normals):
    """The point that Newton's steps find from t, and its shading normal."""
    n, inverse, cubic = np.array(values.shape) - 1, np.linalg.inv(pose[:3, :3]), normals == "cubic"
    for _ in range(4):
        q = inverse @ (o + t * d - pose[:3, 3]) * n
        value, gradient = slopes(values, q, cubic)
        t -= value / ((gradient * n) @ inverse @ d)
    q = inverse @ (o + t * d - pose[:3, 3]) * n
    m = smooth(values, q) if normals == "smooth" else slopes(values, q, cubic)[1] * n
    m = inverse.T @ m
    return o + t * d, m / np.linalg.norm(m), inverse.T @ (slopes(values, q, cubic)[1] * n)


@pytest.mark.slow
@pytest.mark.parametrize("normals", ["smooth", "analytic", "cubic"])
def test_velocities(normals: str) -> None:
    rng = np.random.default_rng(3)
    at = np.linspace(0.0, 1.0, 9)
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    grid = np.sqrt((x - 0.5) ** 2 + 1.2 * (y - 0.5) ** 2 + (z - 0.5) ** 2) - 0.3 + 0.02 * rng.standard_normal(x.shape)
    grid = grid.astype(np.float32)
    pose = np.eye(4, dtype=np.float32)
    pose[:3] = [[1.5, 0.3, 0.1, -0.8], [-0.2, 1.2, 0.1, -0.6], [0.1, -0.3, 1.4, -0.7]]
    form = {"interpolation": "cubic"} if normals == "cubic" else {"normals": normals}
    body = {"type": "sdfgrid", "grid": grid, **form, "to_world": psdr.Transform(pose)}
    scene = psdr.load_dict(
        {"type": "scene", "body": body, "sensor": {"type": "perspective"}, "sky": {"type": "constant"}}
    )
    count = 256
    o = rng.standard_normal((count, 3))
    o = 3.0 * o / np.linalg.norm(o, axis=1)[:, None]
    target = 0.35 * rng.uniform(-1.0, 1.0, (count, 3))
    d = (target - o) / np.linalg.norm(target - o, axis=1)[:, None]
    rays = np.stack([o, d], axis=1).astype(np.float32)
    moved = rng.standard_normal((count, 2, 3)).astype(np.float32)
    grid_dot, pose_dot = rng.standard_normal(grid.shape), np.zeros((4, 4))
    grid_dot, pose_dot[:3] = 0.1 * grid_dot, rng.standard_normal((3, 4))
    params = psdr.traverse(scene)
    tangents = np.zeros(len(scene.values), np.float32)
    for name, value in (("body.grid", grid_dot), ("body.to_world", pose_dot)):
        p = scene.parameters[name]
        tangents[p.offset : p.offset + p.size] = value.ravel()
    assert params["body.grid"].shape == (9, 9, 9, 1)
    out = wp.zeros((count, 4), dtype=wp.vec3, device="cpu")
    inputs = [scene.data(), wp.array(tangents, device="cpu")]
    inputs += [wp.array(a, dtype=wp.vec3, device="cpu") for a in (rays, moved)]
    wp.launch(move, dim=count, inputs=inputs, outputs=[out], device="cpu")
    found = out.numpy().astype(np.float64)
    values, values_dot = grid.transpose(2, 1, 0).astype(np.float64), grid_dot.transpose(2, 1, 0)
    told = 0
    for i in np.flatnonzero(found[:, 3, 0] > 0.0):
        (o, d), (o_dot, d_dot), t = rays[i].astype(np.float64), moved[i].astype(np.float64), found[i, 3, 0]
        _x, _n, gradient = hit(values, pose, o, d, t, normals)
        slope = gradient @ d
        if abs(slope) < 0.2 * np.linalg.norm(gradient):
            continue
        ends = [
            hit(values + s * values_dot, pose + s * pose_dot, o + s * o_dot, d + s * d_dot, t, normals)
            for s in (STEP, -STEP)
        ]
        x_dot, n_dot = ((ends[0][k] - ends[1][k]) / (2.0 * STEP) for k in range(2))
        if np.abs(found[i, :2] - [x_dot, n_dot]).max() > ROUNDING * (1.0 + np.abs([x_dot, n_dot]).max()):
            # A finite difference across a face of a voxel, where normals have kinks.
            q = np.linalg.inv(pose[:3, :3]) @ (_x - pose[:3, 3]) * 8.0
            apart = np.abs(2.0 * q - np.round(2.0 * q)).min()
            assert apart < 1e-4, (i, found[i, :2], x_dot, n_dot)
            continue
        # What a ray that leaves is tied to stays on the surface.
        still = [hit(values + s * values_dot, pose + s * pose_dot, o, d, t, normals)[0] for s in (STEP, -STEP)]
        across = gradient @ (still[0] - still[1]) / (2.0 * STEP)
        np.testing.assert_allclose(gradient @ found[i, 2], across, atol=ROUNDING * (1.0 + abs(across)) * 3.0)
        told += 1
    assert told > 100

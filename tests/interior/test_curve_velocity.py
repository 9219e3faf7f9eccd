"""Velocities of points, normals and texture coordinates on curves against finite differences in float64."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.rays.test_curves import KINDS, hair, load
from warp_psdr.kernels.primitive.dispatch import make_hit, make_surface_at, make_velocity
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.scene.kinds.bsplinecurve import coefficients

STEP = 1e-6
#: Of velocities: float32, on points that are held to some 1e-6 of a segment.
ROUNDING = 1e-2


def make_move(kind: int):
    hit_of, surface_of = make_hit((kind,)), make_surface_at(False, True, True, True, (kind,))
    velocity = make_velocity(False, True, True, True, (kind,))

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
        tri = triangle_at(scene, 0)
        hit = hit_of(scene, tri, o, d, 1.0e30)
        if hit.face >= 0:
            zero = wp.vec3(0.0, 0.0, 0.0)
            found = velocity(scene, tangents, 0, hit.u, hit.v, True, o, d, moved[i, 0], moved[i, 1])
            tied = velocity(scene, tangents, 0, hit.u, hit.v, False, o, d, zero, zero)
            s = surface_of(scene, tri, hit.u, hit.v)
            out[i, 0] = found.x
            out[i, 1] = found.n
            out[i, 2] = found.tangent
            out[i, 3] = wp.vec3(found.uv[0], found.uv[1], 0.0)
            out[i, 4] = tied.x
            out[i, 5] = s.x
            out[i, 6] = s.ng
            out[i, 7] = wp.vec3(s.uv[0], s.uv[1], hit.t)

    return move


def told(points: np.ndarray, first: int, v: float, x: np.ndarray, cubic: bool) -> tuple:
    """Return what holds at a place v: how far x is from its circle, and the normal, turns and tangent."""
    if cubic:
        a = coefficients(points, np.array([first]))[:, 0]
        c, slope, bend = (
            a[0] + v * (a[1] + v * (a[2] + v * a[3])),
            a[1] + v * (2 * a[2] + 3 * v * a[3]),
            2 * a[2] + 6 * v * a[3],
        )
    else:
        c, slope, bend = (1 - v) * points[first] + v * points[first + 1], points[first + 1] - points[first], np.zeros(4)
    q, b = x - c[:3], slope[:3]
    axis = b / np.linalg.norm(b)
    up = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
    up /= np.linalg.norm(up)
    right = np.cross(up, axis)
    e = q - (q @ axis) * axis
    n = (b @ b - q @ bend[:3]) * q / np.linalg.norm(q) - slope[3] * b if cubic else q
    still = q @ b if cubic else q @ b + np.linalg.norm(q) * slope[3]
    return (
        still,
        np.linalg.norm(q) - c[3],
        n / np.linalg.norm(n),
        np.arctan2(e @ up, e @ right) / (2 * np.pi),
        np.cross(axis, e / np.linalg.norm(e)),
    )


def follow(points: np.ndarray, first: int, v: float, o: np.ndarray, d: np.ndarray, t: float, cubic: bool) -> tuple:
    """Return (x, n, tangent, turns, v) of the hit next to (v, t), by Newton's steps in both."""
    for _round in range(8):
        f = np.array(told(points, first, v, o + t * d, cubic)[:2])
        h = 1e-6
        by_v = (np.array(told(points, first, v + h, o + t * d, cubic)[:2]) - f) / h
        by_t = (np.array(told(points, first, v, o + (t + h) * d, cubic)[:2]) - f) / h
        dv, dt = np.linalg.solve(np.column_stack([by_v, by_t]), -f)
        v, t = v + dv, t + dt
    x = o + t * d
    _still, _phi, n, turns, tangent = told(points, first, v, x, cubic)
    return np.concatenate([x, n, tangent, [turns, v]])


@pytest.mark.slow_rows("bsplinecurve", "linearcurve")
@pytest.mark.parametrize("plugin", ["bsplinecurve", pytest.param("linearcurve", marks=pytest.mark.slow)])
def test_velocities(plugin: str) -> None:
    rng = np.random.default_rng(5)
    points, starts = hair(rng, plugin, 0.06, 0.03)
    pose = np.eye(4, dtype=np.float32)
    pose[:3] = [[1.1, 0.2, 0.1, 0.1], [-0.1, 0.9, 0.1, -0.2], [0.1, -0.1, 1.2, -0.3]]
    scene = load(plugin, points, starts, to_world=psdr.Transform(pose))
    curves = scene.description.shapes[0].geometry
    assert curves is not None
    count, cubic = 160, curves.cubic
    local = points.astype(np.float64)
    o = rng.standard_normal((count, 3))
    o = 3.0 * o / np.linalg.norm(o, axis=1)[:, None]
    goal = (
        local[rng.integers(0, len(local), count), :3] @ pose[:3, :3].T
        + pose[:3, 3]
        + 0.02 * rng.standard_normal((count, 3))
    )
    d = (goal - o) / np.linalg.norm(goal - o, axis=1)[:, None]
    rays = np.stack([o, d], axis=1).astype(np.float32)
    moved = rng.standard_normal((count, 2, 3)).astype(np.float32)
    points_dot = rng.standard_normal(points.shape) * [1.0, 1.0, 1.0, 0.3]
    pose_dot = np.zeros((4, 4))
    pose_dot[:3] = rng.standard_normal((3, 4))
    tangents = np.zeros(len(scene.values), np.float32)
    for name, value in (("body.control_points", points_dot), ("body.to_world", pose_dot)):
        p = scene.parameters[name]
        tangents[p.offset : p.offset + p.size] = value.ravel()
    out = wp.zeros((count, 8), dtype=wp.vec3, device=scene.device)
    shifted = rays.copy()
    shifted[:, 0] -= scene.origin.astype(np.float32)
    inputs = [scene.data(), wp.array(tangents, device=scene.device)]
    inputs += [wp.array(a, dtype=wp.vec3, device=scene.device) for a in (shifted, moved)]
    wp.launch(make_move(KINDS[plugin]), dim=count, inputs=inputs, outputs=[out], device=scene.device)
    found = out.numpy().astype(np.float64)

    def world(step: float) -> np.ndarray:
        moved_points, matrix = local + step * points_dot, pose + step * pose_dot
        return np.column_stack([moved_points[:, :3] @ matrix[:3, :3].T + matrix[:3, 3], moved_points[:, 3]])

    checked, worst = 0, []
    for i in np.flatnonzero(found[:, 7, 2] > 0.0):
        (o, d), (o_dot, d_dot) = rays[i].astype(np.float64), moved[i].astype(np.float64)
        at = found[i, 7, 1] * len(curves.firsts)
        segment = min(int(at), len(curves.firsts) - 1)
        v, t, n = at - segment, found[i, 7, 2], found[i, 6]
        if abs(n @ d) < 0.3 or not 0.02 < v < 0.98:
            continue
        first = int(curves.firsts[segment])
        ends = [follow(world(s), first, v, o + s * o_dot, d + s * d_dot, t, cubic) for s in (STEP, -STEP)]
        rates = (ends[0] - ends[1]) / (2.0 * STEP)
        if abs(rates[9]) > 1e3:  # the seam of the angle
            continue
        mine = np.concatenate([found[i, :3].ravel(), [found[i, 3, 0], found[i, 3, 1] * len(curves.firsts)]])
        worst.append(np.abs(mine - rates).max() / (1.0 + np.abs(rates).max()))
        # What a ray that leaves is tied to stays on the surface.
        still = [follow(world(s), first, v, o, d, t, cubic)[:3] for s in (STEP, -STEP)]
        across = n @ (still[0] - still[1]) / (2.0 * STEP)
        assert n @ found[i, 4] == pytest.approx(across, abs=ROUNDING * (1.0 + abs(across)))
        checked += 1
    assert checked > 30
    assert np.quantile(worst, 0.95) < ROUNDING / 4.0 and max(worst) < 4.0 * ROUNDING

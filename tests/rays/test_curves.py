"""Rays against curves, in float64: what lies on one is not passed, and hits are on it, where a ray enters."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr.kernels.primitive.curve_kinds import CONES, TUBES
from warp_psdr.kernels.primitive.dispatch import make_hit, make_surface_at
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.scene.kinds.bsplinecurve import coefficients

KINDS = {"linearcurve": CONES.number, "bsplinecurve": TUBES.number}
#: Rounding of points, over the largest coordinate.
ROUNDING = 2e-5


def make_trace(kind: int):
    hit_of, surface_of = make_hit((kind,)), make_surface_at(False, True, True, False, (kind,))

    @wp.kernel(module="unique", enable_backward=False)
    def trace(
        scene: Scene, o: wp.array(dtype=wp.vec3), d: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32, ndim=2)
    ):
        i = wp.tid()
        tri = triangle_at(scene, 0)
        hit = hit_of(scene, tri, o[i], d[i], 1.0e30)
        out[i, 0] = wp.where(hit.face < 0, -1.0, hit.t)
        if hit.face >= 0:
            surface = surface_of(scene, tri, hit.u, hit.v)
            for k in range(3):
                out[i, 1 + k] = surface.x[k]
                out[i, 4 + k] = surface.ng[k]
            out[i, 7] = surface.uv[0]
            out[i, 8] = surface.uv[1]

    return trace


def hair(rng: np.random.Generator, plugin: str, radius: float, curl: float) -> tuple[np.ndarray, list[int]]:
    """Return control points (N, 4) and starts of curves that taper, turn and cross."""
    points, starts = [], []
    for _curve in range(20):
        starts.append(8 * len(points))
        steps = rng.normal([0.0, 0.0, 0.2], curl, (7, 3))
        places = rng.uniform(-0.7, 0.7, 3) * [1, 1, 0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        points.append(np.column_stack([places, radius * np.linspace(1.0, rng.uniform(0.0, 2.0), 8)]))
    return np.concatenate(points).astype(np.float32), starts


def load(plugin: str, points: np.ndarray, starts: list[int], **more) -> psdr.Scene:
    body = {"type": plugin, "control_points": points, "curve_starts": starts, **more}
    return psdr.load_dict(
        {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}, "body": body}
    )


def on_tubes(rng: np.random.Generator, points: np.ndarray, firsts: np.ndarray, count: int) -> tuple[np.ndarray, ...]:
    """Return points on the tubes about B-splines, and their normals; where a tube folds, none."""
    a = coefficients(points.astype(np.float64), firsts)[:, rng.integers(0, len(firsts), count)]
    v = rng.random((count, 1))
    c, slope, bend = (
        a[0] + v * (a[1] + v * (a[2] + v * a[3])),
        a[1] + v * (2 * a[2] + 3 * v * a[3]),
        2 * a[2] + 6 * v * a[3],
    )
    across = np.cross(slope[:, :3], rng.standard_normal((count, 3)))
    q = c[:, 3:] * across / np.linalg.norm(across, axis=1)[:, None]
    stretch = (slope[:, :3] ** 2).sum(axis=1) - (q * bend[:, :3]).sum(axis=1)
    n = stretch[:, None] * q - (slope[:, 3] * c[:, 3])[:, None] * slope[:, :3]
    keep = (stretch > 0.1 * (slope[:, :3] ** 2).sum(axis=1)) & (c[:, 3] > 0.0)
    return (c[:, :3] + q)[keep], (n / np.linalg.norm(n, axis=1)[:, None])[keep]


def on_cones(rng: np.random.Generator, points: np.ndarray, firsts: np.ndarray, count: int) -> tuple[np.ndarray, ...]:
    """Return points on the spheres and the cones of straight segments, and their normals."""
    i = firsts[rng.integers(0, len(firsts), count)]
    p0, p1 = points[i].astype(np.float64), points[i + 1].astype(np.float64)
    b = (p1 - p0)[:, :3]
    length = np.linalg.norm(b, axis=1)[:, None]
    v = np.clip(rng.uniform(-0.5, 1.5, (count, 1)), 0.0, 1.0)
    cosine = np.clip((p0 - p1)[:, 3:] / length, -1.0, 1.0)
    up, down = rng.uniform(cosine, 1.0), rng.uniform(-1.0, cosine)
    cosine = np.where(v == 0.0, down, np.where(v == 1.0, up, cosine))
    across = np.cross(b, rng.standard_normal((count, 3)))
    n = np.sqrt(1.0 - cosine**2) * across / np.linalg.norm(across, axis=1)[:, None] + cosine * b / length
    c = (1.0 - v) * p0 + v * p1
    return c[:, :3] + c[:, 3:] * n, n


def distance_of(points: np.ndarray, firsts: np.ndarray, plugin: str, x: np.ndarray) -> np.ndarray:
    """Return how far points (N, 3) are from the nearest circle of a fine row of them, or the nearest cone."""
    nearest = np.full(len(x), np.inf)
    exact = points.astype(np.float64)
    for first in firsts:
        if plugin == "linearcurve":
            p0, p1 = exact[first], exact[first + 1]
            b, fall = (p1 - p0)[:3], p0[3] - p1[3]
            inner = max(b @ b - fall**2, 1e-300)
            beside = np.linalg.norm(np.cross(x - p0[:3], b), axis=1) / np.sqrt(b @ b)
            v = np.clip(((x - p0[:3]) @ b) / (b @ b) - beside * fall / np.sqrt(inner * (b @ b)), 0.0, 1.0)
            c = p0 + v[:, None] * (p1 - p0)
            nearest = np.minimum(nearest, np.abs(np.linalg.norm(x - c[:, :3], axis=1) - c[:, 3]))
            continue
        a = coefficients(exact, np.array([first]))[:, 0]
        for start in (0.0, 0.25, 0.5, 0.75, 1.0):
            v = np.full(len(x), start)
            for _newton in range(30):
                w = v[:, None]
                c, slope, bend = (
                    a[0] + w * (a[1] + w * (a[2] + w * a[3])),
                    a[1] + w * (2 * a[2] + 3 * w * a[3]),
                    2 * a[2] + 6 * w * a[3],
                )
                q = x - c[:, :3]
                stretch = (slope[:, :3] ** 2).sum(axis=1) - (q * bend[:, :3]).sum(axis=1)
                v = np.clip(
                    v + np.clip((q * slope[:, :3]).sum(axis=1) / np.where(stretch > 0, stretch, np.inf), -0.2, 0.2),
                    0.0,
                    1.0,
                )
            c = a[0] + v[:, None] * (a[1] + v[:, None] * (a[2] + v[:, None] * a[3]))
            nearest = np.minimum(nearest, np.abs(np.linalg.norm(x - c[:, :3], axis=1) - c[:, 3]))
    return nearest


@pytest.mark.parametrize("plugin", list(KINDS))
@pytest.mark.parametrize(
    ("radius", "curl", "count"),
    [(0.05, 0.03, 5_000), pytest.param(0.002, 0.08, 200_000, marks=pytest.mark.slow)],
)
def test_no_ray_passes_a_curve(plugin: str, radius: float, curl: float, count: int) -> None:
    rng = np.random.default_rng(3)
    points, starts = hair(rng, plugin, radius, curl)
    scene = load(plugin, points, starts)
    curves = scene.description.shapes[0].geometry
    x, n = (on_tubes if plugin == "bsplinecurve" else on_cones)(rng, points, curves.firsts, count)
    away = rng.standard_normal(x.shape)
    away *= np.where((away * n).sum(axis=1) < 0.0, -1.0, 1.0)[:, None] / np.linalg.norm(away, axis=1)[:, None]
    reach = np.exp(rng.uniform(np.log(0.3), np.log(20.0), (len(x), 1)))
    o = (x + reach * away).astype(np.float32)
    d = x - o
    expected = np.linalg.norm(d, axis=1)
    d = (d / expected[:, None]).astype(np.float32)
    given = [wp.array(a, dtype=wp.vec3, device=scene.device) for a in (o - scene.origin.astype(np.float32), d)]
    out = wp.zeros((len(x), 9), dtype=wp.float32, device=scene.device)
    wp.launch(make_trace(KINDS[plugin]), len(x), inputs=[scene.data(), *given], outputs=[out], device=scene.device)
    found = out.numpy().astype(np.float64)
    cosine = -(d * n).sum(axis=1)
    rounding = ROUNDING * (1.0 + np.abs(o).max(axis=1))
    # A ray that aims at a point where it grazes may pass by rounding.
    clear = radius * cosine**2 > 4.0 * rounding
    passed = clear & ((found[:, 0] < 0.0) | (found[:, 0] > expected + 3.0 * rounding / np.maximum(cosine, 0.01)))
    assert clear.mean() > 0.3
    assert passed.sum() == 0, (int(passed.sum()), len(x))
    hit = found[:, 0] >= 0.0
    place = found[hit, 1:4] + scene.origin
    along = o[hit] + found[hit, :1] * d[hit]
    facing = -(found[hit, 4:7] * d[hit]).sum(axis=1)
    assert (np.linalg.norm(place - along, axis=1) < 3.0 * rounding[hit] / np.maximum(facing, 0.01)).all()
    assert (facing > -0.01).all()
    some = rng.permutation(hit.sum())[:1000]
    assert distance_of(points, curves.firsts, plugin, place[some]).max() < ROUNDING
    assert found[hit, 7:].min() >= 0.0 and found[hit, 7:].max() <= 1.0


@pytest.mark.parametrize("plugin", list(KINDS))
def test_rays_start_in_the_boxes_of_many_pieces(plugin: str) -> None:
    """They enter all of these at the distance 0, more than come in one call (``curves_walk.BATCH``)."""
    rng = np.random.default_rng(8)
    # Thin fibres along a diagonal, whose boxes are thick.
    across = rng.uniform(-0.05, 0.05, (100, 1, 3))
    places = across + np.linspace(-1.5, 1.5, 4)[:, None] * np.ones(3)
    points = np.concatenate([places, np.full((100, 4, 1), 0.004)], axis=2).reshape(-1, 4).astype(np.float32)
    scene = load(plugin, points, list(range(0, 400, 4)))
    firsts = scene.description.shapes[0].geometry.firsts
    x, n = (on_tubes if plugin == "bsplinecurve" else on_cones)(rng, points, firsts, 4000)
    o = rng.uniform(-0.3, 0.3, x.shape).astype(np.float32)
    d = x - o
    expected = np.linalg.norm(d, axis=1)
    d /= expected[:, None]
    arrays = [wp.array(y, dtype=wp.vec3, device=scene.device) for y in (o - scene.origin, d)]
    out = wp.zeros((len(x), 9), dtype=wp.float32, device=scene.device)
    wp.launch(make_trace(KINDS[plugin]), len(x), inputs=[scene.data(), *arrays], outputs=[out], device=scene.device)
    found = out.numpy()[:, 0]
    enters = (d * n).sum(axis=1) < -0.05
    assert enters.sum() > 1000
    assert ((found > 0.0) & (found < expected + ROUNDING))[enters].all()


@pytest.mark.slow
def test_rays_beside_a_bend_pass() -> None:
    """What passes a tube of constant radius next to its silhouette meets nothing, however little it bends there."""
    rng = np.random.default_rng(4)
    k = np.linspace(0.0, 1.0, 8)
    points = np.column_stack([2.4 * k - 1.2, 0.4 * np.cos(7.0 * k), 0.4 * np.sin(7.0 * k), 0.0 * k + 0.16])
    scene = load("bsplinecurve", points, [0])
    a = coefficients(points, np.arange(5))
    v = np.linspace(0.0, 1.0, 200)[:, None, None]
    axis = (a[0] + v * (a[1] + v * (a[2] + v * a[3])))[..., :3].reshape(-1, 3)
    x, n = on_tubes(rng, points, np.arange(5), 250)
    d = np.cross(n, rng.standard_normal(x.shape))
    d /= np.linalg.norm(d, axis=1)[:, None]
    o, beside = x + 3e-4 * n - 0.4 * d, 1e-4
    t = np.linspace(0.0, 0.8, 400)[:, None]
    distance = np.array([np.linalg.norm((p + t * w)[:, None] - axis, axis=2).min() for p, w in zip(o, d, strict=True)])
    passes = distance > 0.16 + beside
    assert passes.sum() > 50
    arrays = [wp.array(y - s, dtype=wp.vec3, device=scene.device) for y, s in ((o, scene.origin), (d, 0.0))]
    out = wp.zeros((len(x), 9), dtype=wp.float32, device=scene.device)
    trace = make_trace(TUBES.number)
    wp.launch(trace, dim=len(x), inputs=[scene.data(), *arrays], outputs=[out], device=scene.device)
    met = out.numpy()[:, 0]
    assert ((met < 0.0) | (met > 0.8))[passes].all()


@pytest.mark.parametrize("plugin", list(KINDS))
def test_rays_follow_an_edit(plugin: str) -> None:
    rng = np.random.default_rng(7)
    points, starts = hair(rng, plugin, 0.05, 0.03)
    moved = hair(rng, plugin, 0.08, 0.05)[0]
    o = rng.uniform(-1.0, 1.0, (2000, 3)).astype(np.float32) * 3.0
    d = rng.uniform(-0.7, 0.7, (2000, 3)).astype(np.float32) - o
    found = []
    edited, fresh = load(plugin, points, starts), load(plugin, moved, starts)
    params = psdr.traverse(edited)
    params["body.control_points"] = moved.reshape(-1)
    params.update("body.control_points")
    for scene in (edited, fresh):
        given = [wp.array(a, dtype=wp.vec3, device=scene.device) for a in (o - scene.origin.astype(np.float32), d)]
        out = wp.zeros((len(o), 9), dtype=wp.float32, device=scene.device)
        wp.launch(make_trace(KINDS[plugin]), len(o), inputs=[scene.data(), *given], outputs=[out], device=scene.device)
        found.append(out.numpy()[:, 0])
    assert (found[0] > 0.0).mean() > 0.2
    # Rays that graze may differ by rounding about another origin.
    assert (np.abs(found[0] - found[1]) > ROUNDING).mean() < 2e-3

"""Rays on exact shapes against float64: none is missed, points are on the surface, what leaves stays away."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.cylinder import CYLINDER
from warp_psdr.kernels.primitive.disk import DISK
from warp_psdr.kernels.primitive.dispatch import make_hit, make_surface_at
from warp_psdr.kernels.primitive.sphere import SPHERE
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.structs import Scene

T = psdr.Transform
KINDS = (SPHERE.number, DISK.number, CYLINDER.number)
NAMES = ("sphere", "disk", "cylinder")
HIT = make_hit(KINDS)
SURFACE = make_surface_at(False, True, False, False, KINDS)
POSE = T.translate([0.1, -0.2, 0.3]).rotate([1, 2, 0], 30.0).scale([0.5, 0.35, 0.45])
#: Some roundings of float32, over the size of coordinates.
ROUNDINGS = 1.0e-6


@wp.kernel(module="unique", enable_backward=False)
def trace(
    scene: Scene,
    record: wp.int32,
    o: wp.array(dtype=wp.vec3),
    d: wp.array(dtype=wp.vec3),
    out: wp.array(dtype=wp.float32, ndim=2),
):
    i = wp.tid()
    tri = triangle_at(scene, record)
    hit = HIT(scene, tri, o[i], d[i], 1.0e30)
    out[i, 0] = wp.where(hit.face < 0, -1.0, hit.t)
    if hit.face >= 0:
        surface = SURFACE(scene, tri, hit.u, hit.v)
        step = step_off_primitive(scene, tri)
        for k in range(3):
            out[i, 1 + k] = surface.x[k]
            out[i, 4 + k] = surface.x[k] + step * surface.ng[k]
            out[i, 7 + k] = surface.ng[k]


@pytest.fixture(scope="module")
def scene() -> psdr.Scene:
    shapes = {name: {"type": name, "exact": True, "to_world": POSE} for name in NAMES}
    held = psdr.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}, **shapes})
    assert psdr.plan(held).config.surfaces.primitives == tuple(sorted(KINDS))
    return held


def traced(scene: psdr.Scene, kind: int, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    out = wp.zeros((len(o), 10), dtype=wp.float32, device=scene.device)
    rays = [wp.array(x, dtype=wp.vec3, device=scene.device) for x in (o, d)]
    wp.launch(trace, dim=len(o), inputs=[scene.data(), kind, *rays], outputs=[out], device=scene.device)
    return out.numpy().astype(np.float64)


def local(scene: psdr.Scene, kind: int, p: np.ndarray, w: float) -> np.ndarray:
    record = scene.triangles.numpy()[kind]
    linear = np.stack([record["p0"], record["p1"], record["p2"]], axis=1).astype(np.float64)
    return np.linalg.solve(linear, (p.astype(np.float64) - w * record["normal"]).T).T


def roots(kind: str, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return both distances (N, 2) along rays at which they meet the surface without its ends, how deep within its
    ends each is, (N, 2), and how deep a ray enters, (N,)."""
    if kind == "disk":
        t = np.repeat(-o[:, 2:] / d[:, 2:], 2, axis=1)
        p = o[:, None] + t[..., None] * d[:, None]
        return t, 1.0 - np.linalg.norm(p[..., :2], axis=2), np.abs(d[:, 2]) / np.linalg.norm(d, axis=1)
    axes = 2 if kind == "cylinder" else 3
    a, b = o[:, :axes], d[:, :axes]
    squared = (b * b).sum(axis=1)
    s = -(a * b).sum(axis=1) / squared
    deep = 1.0 - ((a + s[:, None] * b) ** 2).sum(axis=1)
    half = np.sqrt(np.maximum(deep, 0.0) / squared)
    t = np.stack([s - half, s + half], axis=1)
    z = o[:, 2:] + t * d[:, 2:]
    within = np.minimum(z, 1.0 - z) if kind == "cylinder" else np.full(t.shape, np.inf)
    return t, within, deep


@pytest.mark.parametrize("size", [1.0, 100.0, 1.0e4])
@pytest.mark.parametrize("kind", range(3), ids=NAMES)
def test_no_ray_is_missed(scene: psdr.Scene, kind: int, size: float) -> None:
    """10^5 rays from up to so many sizes away; those within the rounding of their origins of an end may do either."""
    random = np.random.default_rng(kind)
    count = 100_000
    away = random.standard_normal((count, 3))
    away *= (size * random.random(count) ** 2 / np.linalg.norm(away, axis=1))[:, None]
    towards = POSE.matrix[:3, 3] + 0.7 * random.standard_normal((count, 3))
    o = (POSE.matrix[:3, 3] + away).astype(np.float32)
    d = towards - o
    d = (d / np.linalg.norm(d, axis=1)[:, None]).astype(np.float32)
    found = traced(scene, kind, o, d)
    o_local, d_local = local(scene, kind, o, 1.0), local(scene, kind, d, 0.0)
    t, within, deep = roots(NAMES[kind], o_local, d_local)
    rounding = 10.0 * ROUNDINGS * (1.0 + np.linalg.norm(o_local, axis=1))
    # A depth eps moves a root by eps over the sine of its angle to the surface.
    slack = rounding / np.sqrt(np.maximum(deep, rounding)) if kind != 1 else rounding / np.maximum(deep, rounding)
    ahead = np.where(t > slack[:, None] / np.linalg.norm(d_local, axis=1)[:, None], t, np.inf)
    surely = (within > slack[:, None]) & (deep > rounding)[:, None]
    maybe = (within > -slack[:, None]) & (deep > -rounding)[:, None] & (t > -slack[:, None])
    first = np.where(surely, ahead, np.inf).min(axis=1)
    hit = found[:, 0] >= 0.0
    assert hit[np.isfinite(first)].all()
    assert not hit[~maybe.any(axis=1)].any()
    clear = np.isfinite(first) & (maybe == surely).all(axis=1)
    assert clear.mean() > 0.1
    x = o[clear] + first[clear, None] * d[clear].astype(np.float64)
    gap = np.linalg.norm(found[clear, 1:4] - x, axis=1)
    assert (gap < slack[clear]).all()
    q = local(scene, kind, found[hit, 1:4], 1.0)
    off = {0: np.linalg.norm(q, axis=1) - 1.0, 1: q[:, 2], 2: np.linalg.norm(q[:, :2], axis=1) - 1.0}[kind]
    assert (np.abs(off) < ROUNDINGS).all()
    # What leaves the side of the normal meets neither a sphere, nor a disk, nor the outside of a cylinder.
    leave = random.standard_normal((hit.sum(), 3))
    leave *= np.sign((leave * found[hit, 7:10]).sum(axis=1))[:, None]
    leave = (leave / np.linalg.norm(leave, axis=1)[:, None]).astype(np.float32)
    assert (traced(scene, kind, found[hit, 4:7].astype(np.float32), leave)[:, 0] < 0.0).all()


def test_rays_along_and_across_the_axis_of_a_cylinder(scene: psdr.Scene) -> None:
    """Along it and through its ends, and from within."""
    shape = POSE.matrix.astype(np.float32)

    def world(p, w):
        return (np.asarray(p, np.float32) @ shape[:3, :3].T + w * shape[:3, 3]).astype(np.float32)

    o = world([[0, 0, 3], [0.5, 0.2, 3], [0, 0, 0.5], [0, 0, 3], [0, -3, 0.5]], 1)
    d = world([[0, 0, -1], [0, 0, -1], [1, 0, 0], [0.45, 0, -1], [0, 1, 0]], 0)
    found = traced(scene, 2, o, d)
    assert (found[:, 0] < 0.0).tolist() == [True, True, False, False, False]
    expected = [[1, 0, 0.5], [1, 0, 3 - 1 / 0.45], [0, -1, 0.5]]
    np.testing.assert_allclose(local(scene, 2, found[2:, 1:4], 1.0), expected, atol=1e-6)

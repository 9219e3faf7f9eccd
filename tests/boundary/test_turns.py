"""How normals of shapes without triangles turn with the place, against differences of normals."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.networks import fitted, sphere
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.primitive.dispatch import make_normal_at, make_turn
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

from .scenes import T, camera, diffuse, sky
from .test_exact_sphere import POSE
from .test_sdfgrid import MATRIX, values
from .test_tubes import tube

COUNT, STEP = 400, 1.0e-3
#: Cosine from which on rays are not looked at that graze a curve.
GRAZING = 0.3
BSDF = {"bsdf": diffuse(0.5)}
SHAPES = {
    **{kind: {"type": kind, "exact": True, "to_world": POSE, **BSDF} for kind in ("sphere", "cylinder", "disk")},
    "linear": {"type": "sdfgrid", "grid": values(), "normals": "analytic", "to_world": T(MATRIX), **BSDF},
    "cubic": {"type": "sdfgrid", "grid": values(), "interpolation": "cubic", "to_world": T(MATRIX), **BSDF},
}


def make_turns_kernel(config: PathConfig) -> wp.Kernel:
    closest = visibility_of(config.rays, config.surfaces.primitives).closest
    surface = make_interaction(config.surfaces, config.lights).surface
    normal = make_normal_at(config.surfaces.primitives)
    turn = make_turn(config.surfaces.primitives)

    @wp.kernel(module="unique", enable_backward=False)
    def turns(
        scene: Scene,
        o: wp.array(dtype=wp.vec3),
        d: wp.array(dtype=wp.vec3),
        found: wp.array(dtype=wp.vec3),
        expected: wp.array(dtype=wp.vec3),
    ):
        n = wp.tid()
        hit = closest(scene, o[n], d[n], FAR)
        if hit.face < 0:
            return
        tri = scene.triangles[hit.face]
        s = surface(scene, hit.face, hit.u, hit.v)
        across = wp.normalize(wp.cross(s.ng, d[n] + wp.vec3(0.1, 0.2, 0.3)))
        found[n] = turn(scene, tri, hit.u, hit.v, across)
        high = wp.normalize(normal(scene, tri, s.x + STEP * across))
        low = wp.normalize(normal(scene, tri, s.x - STEP * across))
        side = wp.where(wp.dot(high, s.ng) < 0.0, -1.0, 1.0)
        expected[n] = (side / (2.0 * STEP)) * (high - low)

    return turns


@pytest.mark.slow_rows("cubic")
@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=[pytest.mark.slow] * (k != "cubic")) for k in (*SHAPES, "network")]
)
def test_turns_equal_differences_of_normals(kind: str) -> None:
    shape = SHAPES.get(kind) or fitted(sphere, (24, 24)).plugin(to_world=T(MATRIX), **BSDF)
    scene = psdr.load_dict({"type": "scene", "sensor": camera(), "sky": sky(), "shape": shape})
    random = np.random.default_rng(0)
    aims = scene.points.min(0) + random.random((COUNT, 3)) * np.ptp(scene.points, 0)
    o = np.float32(4.0 * random.normal(size=(COUNT, 3)))
    d = aims - o
    d = np.float32(d / np.linalg.norm(d, axis=1, keepdims=True))
    found, expected = (wp.zeros(COUNT, dtype=wp.vec3, device="cpu") for _ in range(2))
    kernel = make_turns_kernel(psdr.plan(scene).config)
    starts, ways = (wp.array(a, dtype=wp.vec3, device="cpu") for a in (o, d))
    wp.launch(kernel, dim=COUNT, inputs=[scene.data(), starts, ways, found, expected], device="cpu")
    a, b = found.numpy(), expected.numpy()
    met = np.abs(b).sum(1) > 0.0
    if kind == "disk":
        assert np.abs(a).max() == 0.0
        return
    assert met.sum() > 60
    off = np.linalg.norm(a - b, axis=1)[met] / np.linalg.norm(b[met], axis=1).mean()
    # Differences across the faces of voxels are those of other normals.
    assert np.quantile(off, 0.9 if kind == "linear" else 1.0) < 0.02, off


def make_curve_turns_kernel(config: PathConfig) -> wp.Kernel:
    closest = visibility_of(config.rays, config.surfaces.primitives).closest
    surface = make_interaction(config.surfaces, config.lights).surface
    turn = make_turn(config.surfaces.primitives)

    @wp.kernel(module="unique", enable_backward=False)
    def curve_turns(
        scene: Scene,
        o: wp.array(dtype=wp.vec3),
        d: wp.array(dtype=wp.vec3),
        kind: wp.array(dtype=wp.int32),
        found: wp.array(dtype=wp.vec3),
        expected: wp.array(dtype=wp.vec3),
    ):
        n = wp.tid()
        across = STEP * wp.normalize(wp.cross(d[n], wp.vec3(0.1, 0.2, 0.3)))
        hit = closest(scene, o[n], d[n], FAR)
        low = closest(scene, o[n] - across, d[n], FAR)
        high = closest(scene, o[n] + across, d[n], FAR)
        if hit.face < 0 or low.face != hit.face or high.face != hit.face:
            return
        s = surface(scene, hit.face, hit.u, hit.v)
        a = surface(scene, low.face, low.u, low.v)
        b = surface(scene, high.face, high.u, high.v)
        if wp.dot(s.ng, d[n]) > -GRAZING or wp.length(b.x - a.x) > 2.1 * STEP / GRAZING:
            return
        tri = scene.triangles[hit.face]
        kind[n] = tri.shape
        found[n] = turn(scene, tri, hit.u, hit.v, (0.5 / STEP) * (b.x - a.x))
        expected[n] = (0.5 / STEP) * (b.n - a.n)

    return curve_turns


def test_turns_on_curves_equal_differences_between_rays() -> None:
    """A tapered tube that bends, and cones with their spheres, on which the Hessian jumps where they touch."""
    shapes = {}
    for k, (plugin, kind) in enumerate((("bsplinecurve", "tapered"), ("linearcurve", "fat"))):
        points = tube(kind) + np.array([0.0, 0.0, 2.0 * k, 0.0])
        shapes[plugin] = {"type": plugin, "control_points": np.float32(points), **BSDF}
    scene = psdr.load_dict({"type": "scene", "sensor": camera(), "sky": sky(), **shapes})
    random = np.random.default_rng(0)
    aims = random.uniform([-1.2, -1.0, 0.0], [1.2, 0.5, 3.6], (10 * COUNT, 3))
    d = random.normal(size=aims.shape)
    d = np.float32(d / np.linalg.norm(d, axis=1, keepdims=True))
    starts, ways = (wp.array(a, dtype=wp.vec3, device="cpu") for a in (np.float32(aims - 4.0 * d), d))
    found, expected = (wp.zeros(len(d), dtype=wp.vec3, device="cpu") for _ in range(2))
    kinds = wp.full(len(d), -1, dtype=wp.int32, device="cpu")
    kernel = make_curve_turns_kernel(psdr.plan(scene).config)
    wp.launch(kernel, dim=len(d), inputs=[scene.data(), starts, ways, kinds, found, expected], device="cpu")
    a, b = found.numpy(), expected.numpy()
    for shape, share in ((0, 0.98), (1, 0.9)):
        met = kinds.numpy() == shape
        assert met.sum() > 100
        off = np.linalg.norm(a - b, axis=1)[met] / np.linalg.norm(b[met], axis=1).mean()
        assert np.quantile(off, share) < 0.02, np.sort(off)

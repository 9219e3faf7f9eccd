"""How normals of shapes without triangles turn with the place, against differences of normals."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.networks import fitted, sphere
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.primitive.dispatch import make_normal_at
from warp_psdr.kernels.primitive.turn import make_turn
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

from .scenes import T, camera, diffuse, sky
from .test_exact_sphere import POSE
from .test_sdfgrid import MATRIX, values

COUNT, STEP = 400, 1.0e-3
BSDF = {"bsdf": diffuse(0.5)}
SHAPES = {
    **{kind: {"type": kind, "exact": True, "to_world": POSE, **BSDF} for kind in ("sphere", "cylinder", "disk")},
    "linear": {"type": "sdfgrid", "grid": values(), "normals": "analytic", "to_world": T(MATRIX), **BSDF},
    "cubic": {"type": "sdfgrid", "grid": values(), "interpolation": "cubic", "to_world": T(MATRIX), **BSDF},
}


def make_turns_kernel(config: PathConfig) -> wp.Kernel:
    closest = visibility_of(config).closest
    surface = make_interaction(config).surface
    normal = make_normal_at(config.primitives)
    turn = make_turn(config.primitives)

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

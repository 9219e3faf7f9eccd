"""Samplers of what segments touch of exact shapes: chi-square tests against each other, and against float64."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr.kernels.boundary.silhouette.dispatch import make_silhouettes
from warp_psdr.kernels.boundary.silhouette.point import SilhouettePoint
from warp_psdr.kernels.boundary.silhouette.rim import make_rims
from warp_psdr.kernels.constants import FOUR_PI, TWO_PI
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.primitive.cylinder import CYLINDER
from warp_psdr.kernels.primitive.disk import DISK
from warp_psdr.kernels.primitive.sphere import SPHERE
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.sampling import square_to_sphere
from warp_psdr.kernels.structs import Scene

from .etendue import assert_shares_agree, bin_of

KINDS = (SPHERE.number, DISK.number, CYLINDER.number)
NAMES = ("sphere", "disk", "cylinder")
SILHOUETTES = make_silhouettes(KINDS)
RIMS = make_rims(KINDS)
POSE = psdr.Transform.rotate([1, 2, 0], 30.0).scale([0.9, 0.35, 0.45])
SAMPLES = 200_000
RIM, SURFACE, LIGHT = wp.constant(0), wp.constant(1), wp.constant(2)


@wp.kernel(module="unique", enable_backward=False)
def touch_outline(scene: Scene, record: wp.int32, how: wp.int32, seed: wp.int32, out: wp.array2d(dtype=wp.float32)):
    """One line that touches a shape, and its measure: of a rim, of a point of the surface, of what a direction sees."""
    t = wp.tid()
    state = wp.rand_init(seed, t)
    tri = triangle_at(scene, record)
    u = wp.vec2(wp.randf(state), wp.randf(state))
    w = square_to_sphere(wp.vec2(wp.randf(state), wp.randf(state)))
    point = SilhouettePoint()
    measure = wp.float32(0.0)
    if how == RIM:
        point = RIMS.seen(tri, record, u[0], w, True)
        measure = FOUR_PI * wp.length(wp.cross(RIMS.rate(tri, point.q), w))
    elif how == SURFACE:
        point = SILHOUETTES.place(tri, record, u)
        a = any_tangent(point.out)
        angle = TWO_PI * wp.randf(state)
        w = wp.cos(angle) * a + wp.sin(angle) * wp.cross(point.out, a)
        measure = TWO_PI * SILHOUETTES.curvature(tri, point.q, w) / SILHOUETTES.density(tri, point.q)
    else:
        point = SILHOUETTES.seen(tri, record, w, True, u[0])
        measure = FOUR_PI * wp.length(wp.cross(SILHOUETTES.rate(tri, w, True, point.q), w))
    if point.valid == 1:
        out[t, 0] = measure
        out[t, 1] = wp.float32(bin_of(point.x - tri.normal, w))


@pytest.fixture(scope="module")
def scene() -> psdr.Scene:
    shapes = {name: {"type": name, "exact": True, "to_world": POSE} for name in NAMES}
    return psdr.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}, **shapes})


def touched(scene: psdr.Scene, name: str, how: int) -> tuple[np.ndarray, np.ndarray]:
    out = wp.zeros((SAMPLES, 2), dtype=wp.float32, device=scene.device)
    inputs = [scene.data(), NAMES.index(name), how, 1 + how]
    wp.launch(touch_outline, SAMPLES, inputs=inputs, outputs=[out], device=scene.device)
    weights, bins = out.numpy().astype(np.float64).T
    return weights, bins


@pytest.mark.parametrize("name", ["sphere", "cylinder"])
def test_both_techniques_have_one_measure(scene: psdr.Scene, name: str) -> None:
    """kappa_n dA dtheta by points of the surface, and by what directions see."""
    assert_shares_agree([touched(scene, name, how) for how in (SURFACE, LIGHT)])


@pytest.mark.parametrize("name", ["disk", "cylinder"])
def test_rims_are_drawn_by_their_measure(scene: psdr.Scene, name: str) -> None:
    """|dx/du x w| du dsigma, against points of the ellipse that are uniform along it."""
    rng = np.random.default_rng(5)
    linear = POSE.matrix[:3, :3].astype(np.float64)
    angle = np.linspace(0.0, 2.0 * np.pi, 4097)
    rate = np.linalg.norm(np.stack([-np.sin(angle), np.cos(angle)], axis=1) @ linear[:, :2].T, axis=1)
    length = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(angle))])
    drawn = np.interp(length[-1] * rng.random(SAMPLES), length, angle)
    tangent = np.stack([-np.sin(drawn), np.cos(drawn)], axis=1) @ linear[:, :2].T
    w = rng.standard_normal((SAMPLES, 3))
    w /= np.linalg.norm(w, axis=1)[:, None]
    rims = 2 if name == "cylinder" else 1
    height = rng.integers(0, rims, SAMPLES)
    x = np.stack([np.cos(drawn), np.sin(drawn), height], axis=1) @ linear.T
    sine = np.linalg.norm(np.cross(tangent / np.linalg.norm(tangent, axis=1)[:, None], w), axis=1)
    axis = np.abs(w).argmax(axis=1)
    sign = w[np.arange(SAMPLES), axis] > 0.0
    bins = 6 * ((x > 0.0) @ [1, 2, 4]) + 2 * axis + sign
    assert_shares_agree([touched(scene, name, RIM), (rims * length[-1] * 4.0 * np.pi * sine, bins)])

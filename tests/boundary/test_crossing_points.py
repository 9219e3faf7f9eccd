"""The sampler of curves in which shapes run through each other, against ellipses: a chi-square test of its measure."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr.kernels.boundary.crossing.curve import CrossingCurves, make_crossing_point
from warp_psdr.kernels.primitive.cylinder import CYLINDER
from warp_psdr.kernels.primitive.sphere import SPHERE
from warp_psdr.kernels.structs import Scene
from warp_psdr.topology.crossings import crossings

from .etendue import BINS, assert_shares_agree

T = psdr.Transform
POINT = make_crossing_point((SPHERE.number, CYLINDER.number))
SAMPLES = 100_000
#: Both run through the plane z = 0; the cylinder by its side alone.
POSES = {
    "sphere": T.translate([0.1, 0.0, 0.2]).rotate([0, 1, 1], 35.0).scale([0.6, 0.45, 0.5]),
    "cylinder": T.translate([0.1, 0.2, -1.0]).rotate([1, -1, 0], 25.0).scale([0.4, 0.3, 2.5]),
}


@wp.kernel(module="unique", enable_backward=False)
def draw(scene: Scene, curves: CrossingCurves, u: wp.array(dtype=wp.float64), out: wp.array2d(dtype=wp.float64)):
    """One over the density of a point by length, and the point."""
    i = wp.tid()
    point = POINT(scene, curves, u[i])
    if point.valid == 1:
        out[i, 0] = wp.float64(wp.length(point.along) / point.density)
    for k in range(3):
        out[i, 1 + k] = wp.float64(point.x[k])


@pytest.mark.parametrize("kind", POSES)
def test_points_are_drawn_by_the_length_of_the_curve(kind: str) -> None:
    """In parts of the plane around a point within the ellipse, against points that are uniform along it."""
    shape = {"type": kind, "exact": True, "to_world": POSES[kind]}
    floor = {"type": "rectangle", "to_world": T.scale(3.0)}
    scene = psdr.load_dict(
        {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}, "floor": floor, "s": shape}
    )
    random = np.random.default_rng(4)
    u = wp.array(random.random(SAMPLES), dtype=wp.float64, device=scene.device)
    out = wp.zeros((SAMPLES, 4), dtype=wp.float64, device=scene.device)
    wp.launch(draw, SAMPLES, inputs=[scene.data(), crossings(scene, None), u], outputs=[out], device=scene.device)
    weights, x = out.numpy()[:, 0], out.numpy()[:, 1:] + scene.origin
    assert (weights > 0.0).all() and np.abs(x[:, 2]).max() < 1e-6

    # |q| = 1, of a cylinder |q_xy| = 1, on rays in the plane from a point within.
    axes = 3 if kind == "sphere" else 2
    to_local = np.linalg.inv(np.asarray(POSES[kind].matrix, np.float64))
    angle = np.linspace(-np.pi, np.pi, 20_001)
    inside = np.array([*x[:, :2].mean(axis=0), 0.0, 1.0])
    a = (to_local @ inside)[:axes]
    b = (np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1) @ to_local[:3, :3].T)[:, :axes]
    squared, along = (b * b).sum(axis=1), b @ a
    reach = (np.sqrt(along**2 - squared * (a @ a - 1.0)) - along) / squared
    curve = reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    place = np.interp(length[-1] * random.random(SAMPLES), length, angle)
    drawn = np.arctan2(x[:, 1] - inside[1], x[:, 0] - inside[0])
    assert weights.mean() == pytest.approx(length[-1], rel=2e-3)
    parts = [np.minimum((t / (2.0 * np.pi) + 0.5) * BINS, BINS - 1) for t in (drawn, place)]
    assert_shares_agree([(weights, parts[0]), (np.full(SAMPLES, length[-1]), parts[1])])

"""Meshes with interpolated normals beside grids, networks and curves: terminators and horizons with a far end there."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.networks import fitted, sphere
from warp_psdr.estimate.boundary import terms

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows, slope
from .scenes import T, ball, camera, diffuse, floor, load, panel, register
from .test_exact_sphere import entry, moved_light
from .test_sdfgrid import all_values, values
from .test_tubes import coordinate

BODY = T.translate([-1.0, -0.45, 0.05]).scale(0.95)
STRAND = np.array([[-0.62, 0.35 * k - 0.9, 0.55 + 0.05 * k * k, 0.2] for k in range(6)], np.float32)
PAINT = diffuse(0.9, 0.7, 0.5)
#: Kind -> its plugin, and a value of it that changes its surface.
BODIES = {
    "grid": (lambda: {"type": "sdfgrid", "grid": values(), "normals": "analytic", "to_world": BODY}, "grid"),
    "shaded grid": (lambda: {"type": "sdfgrid", "grid": values(9), "normals": "smooth", "to_world": BODY}, "grid"),
    "cubic grid": (lambda: {"type": "sdfgrid", "grid": values(), "interpolation": "cubic", "to_world": BODY}, "grid"),
    "network": (lambda: fitted(sphere, (24, 24)).plugin(to_world=BODY), "layer2.bias"),
    "tube": (lambda: {"type": "bsplinecurve", "control_points": STRAND}, "control_points"),
}


def beside(kind: str, **more):
    """A coarse ball with interpolated normals, so near that light goes from one to the other, and a lamp for both."""
    return lambda: {
        "sensor": camera((0.1, -2.6, 1.6), (0.0, 0.0, 0.45), fov=42.0),
        "floor": floor(half=2.0),
        "body": {**BODIES[kind][0](), "bsdf": PAINT},
        "ball": ball((0.42, 0.0, 0.55), 0.45, PAINT, 1, smooth=True),
        "light": panel((0.1, -1.0, 1.9), 0.4, 12.0),
        **more,
    }


def glowing(kind: str):
    """A icosahedron with interpolated normals, lit by nothing but what a lamp below sends to a body beside it."""
    lamp = panel((0.0, 0.0, 0.0), 0.3, 30.0)
    lamp["vertices"] = lamp["vertices"] @ np.float32([[0, 0, -1], [0, 1, 0], [1, 0, 0]]) + np.float32([0.15, -0.9, 0.5])
    return {
        "sensor": camera((-0.3, -2.2, 1.8), (0.4, 0.0, 0.55), fov=25.0),
        "body": {**BODIES[kind][0](), "bsdf": PAINT},
        "ball": ball((0.45, 0.0, 0.55), 0.45, PAINT, 0, smooth=True),
        "light": lamp,
    }


register(
    {
        **{f"bent ball, {kind}": beside(kind) for kind in BODIES},
        "bent ball, glowing grid": lambda: glowing("grid"),
        "bent mirror, grid": beside("grid", ball=ball((0.42, 0.0, 0.55), 0.45, {"type": "conductor"}, 2, smooth=True)),
    }
)

BALL, LAMP, POSE, CAMERA = "ball.vertex_positions", "light.vertex_positions", "body.to_world", "sensor.to_world"
GLOWING = "bent ball, glowing grid"


def shifted(values):
    return 0.0 * values + [1.0, 0.2, 0.1]


MOTIONS = {
    "its values": ("", lambda v: all_values(v), 0.003),
    "its pose": (POSE, entry(0, 3), 0.01),
    "the ball": (BALL, shifted, 0.01),
    "the lamp": (LAMP, moved_light, 0.01),
    "the camera": (CAMERA, entry(0, 3), 0.01),
}
CASES = [
    *(
        Case(GLOWING, POSE, entry(axis, 3), 0.01, what, 3, 1024, 2048, hidden=True) for axis, what in enumerate("xyz")
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["grid", "tube"])
def test_reverse_mode_is_the_transpose(kind: str) -> None:
    scene, params = load(f"bent ball, {kind}")
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 1}
    assert_transposes(scene, params, [f"body.{BODIES[kind][1]}", POSE, BALL, LAMP, CAMERA], options)


@pytest.mark.parametrize("depth", [2, 3, -1])
@pytest.mark.parametrize("kind", BODIES)
def test_the_plan_takes_what_moves_beside_vertex_normals(kind: str, depth: int) -> None:
    scene, _params = load(f"bent ball, {kind}")
    integrator = psdr.PathIntegrator(max_depth=depth)
    for name in (f"body.{BODIES[kind][1]}", POSE, BALL, LAMP, CAMERA):
        assert psdr.plan(scene, names=[name], integrator=integrator).boundary == psdr.boundary.PathSpace()

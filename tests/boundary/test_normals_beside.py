"""Meshes with interpolated normals beside grids, networks and curves: terminators and horizons with a far end there."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.networks import fitted, sphere
from warp_psdr.estimate.arguments import flat_tangents
from warp_psdr.estimate.boundary import terms
from warp_psdr.estimate.boundary.drivers import launch_forward
from warp_psdr.estimate.boundary.terms.request import Request
from warp_psdr.plan.motion import motion
from warp_psdr.plan.plan import decide

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import SIZE, T, ball, camera, diffuse, floor, load, panel, register
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


def beside(kind: str):
    """A coarse ball with interpolated normals, so near that light goes from one to the other."""
    return lambda: {
        "sensor": camera((0.1, -2.6, 1.6), (0.0, 0.0, 0.45), fov=42.0),
        "floor": floor(half=2.0),
        "body": {**BODIES[kind][0](), "bsdf": PAINT},
        "ball": ball((0.42, 0.0, 0.55), 0.45, PAINT, 1, smooth=True),
        "light": panel((0.1, -1.0, 1.9), 0.4, 12.0),
    }


def glowing(kind: str):
    """An icosahedron with interpolated normals beside a body that a lamp lights, which faces away from it."""
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
    }
)

BALL, LAMP, POSE, CAMERA = "ball.vertex_positions", "light.vertex_positions", "body.to_world", "sensor.to_world"
GLOWING = "bent ball, glowing grid"


def shifted(values):
    return 0.0 * values + [1.0, 0.2, 0.1]


CASES = [
    Case("bent ball, grid", BALL, shifted, 0.01, "the ball", 2, 512, 1024),
    Case("bent ball, grid", BALL, shifted, 0.01, "the ball", 3, 512, 1024),
    Case("bent ball, grid", BALL, shifted, 0.01, "the ball", 4, 1024, 1024),
    Case("bent ball, grid", "body.grid", all_values, 0.003, "all values", 3, 1024, 2048),
    Case("bent ball, grid", POSE, entry(0, 3), 0.01, "x", 3, 1024, 2048),
    Case("bent ball, grid", LAMP, moved_light, 0.01, "the lamp moves", 3, 1024, 2048),
    Case("bent ball, grid", CAMERA, entry(0, 3), 0.01, "the camera moves", 3, 512, 1024),
    Case("bent ball, cubic grid", BALL, shifted, 0.01, "the ball", 3, 512, 1024),
    Case("bent ball, cubic grid", POSE, entry(0, 3), 0.01, "x", 3, 1024, 2048),
    Case("bent ball, cubic grid", LAMP, moved_light, 0.01, "the lamp moves", 3, 1024, 2048),
    Case("bent ball, network", BALL, shifted, 0.01, "the ball", 3, 1024, 2048),
    Case("bent ball, tube", "body.control_points", coordinate(3), 0.004, "radii", 3, 1024, 2048),
    Case("bent ball, tube", BALL, shifted, 0.01, "the ball", 3, 1024, 2048),
]


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


@pytest.mark.slow
def test_a_horizon_rests_while_what_it_sees_slides() -> None:
    """A horizon moves with its triangle alone: what lies on the grid stays on the directions in which it is seen."""
    scene, params = load(GLOWING)
    found = {}
    for name in (POSE, BALL):
        plan = decide(scene, names=[name], integrator=psdr.PathIntegrator(max_depth=3))
        request = Request(scene, plan, motion(scene, [name]), "forward", 0, 256, 1)
        launched = terms.launches(terms.named("geometric_horizon"), request)
        # About a point of its own, so that triangles turn.
        values = params[name].numpy().astype(np.float64)
        tangent = entry(0, 3)(values) if name == POSE else values @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 0]])
        flat = flat_tangents(scene, params, {name: tangent.astype(np.float32)})
        found[name] = launch_forward(scene, launched, flat, (SIZE, SIZE)).numpy()
        assert launched
    assert not found[POSE].any() and np.abs(found[BALL]).max() > 0.0


@pytest.mark.parametrize("depth", [2, 3, -1])
@pytest.mark.parametrize("kind", BODIES)
def test_the_plan_takes_what_moves_beside_vertex_normals(kind: str, depth: int) -> None:
    scene, _params = load(f"bent ball, {kind}")
    integrator = psdr.PathIntegrator(max_depth=depth)
    for name in (f"body.{BODIES[kind][1]}", POSE, BALL, LAMP, CAMERA):
        assert psdr.plan(scene, names=[name], integrator=integrator).boundary == psdr.boundary.PathSpace()

"""Exact shapes, grids of signed distances and curves in one scene: derivatives by each, among the others."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import T, diffuse, floor, load, register
from .test_exact_sphere import LIGHTS, VIEW, entry, radius
from .test_sdfgrid import all_values, values
from .test_tubes import coordinate

BODY = T.translate([-0.95, -0.45, 0.15]).scale(0.9)


def hair(plugin: str) -> dict:
    """Above the others, so that its shadow falls on them."""
    k = np.linspace(0.0, 1.0, 8)
    points = np.column_stack([2.4 * k - 1.2, 0.15 * np.sin(5.0 * k), 1.3 + 0.1 * k, 0.08 + 0.03 * k])
    return {"type": plugin, "control_points": points, "bsdf": diffuse(0.3, 0.6, 0.8)}


def beside(light: str, interpolation: str, exact: dict, plugin: str):
    """A grid on the left, an exact shape on the right, a hair above both, and a floor."""
    normals = {"normals": "analytic"} if interpolation == "linear" else {}
    grid = {"type": "sdfgrid", "grid": values(), "interpolation": interpolation, "to_world": BODY, **normals}
    return lambda: {
        "sensor": VIEW,
        "floor": floor(half=2.0),
        "body": {**grid, "bsdf": diffuse(0.7, 0.5, 0.3)},
        "shape": {"exact": True, "bsdf": {"type": "twosided", "bsdf": diffuse(0.5, 0.7, 0.4)}, **exact},
        "hair": hair(plugin),
        **LIGHTS[light](),
    }


BALL = {"type": "sphere", "to_world": T.translate([0.45, 0.0, 0.5]).rotate([0, 1, 1], 35.0).scale([0.45, 0.35, 0.4])}
PIPE = {"type": "cylinder", "p0": [0.3, 0.3, 0.35], "p1": [0.75, -0.3, 0.75], "radius": 0.25}
register(
    {
        **{f"ball, grid and tube, {light}": beside(light, "linear", BALL, "bsplinecurve") for light in LIGHTS},
        **{f"pipe, cubic and cones, {light}": beside(light, "cubic", PIPE, "linearcurve") for light in LIGHTS},
    }
)
MOTIONS = (
    ("the grid", "body.grid", all_values, 0.003),
    ("the exact shape", "shape.to_world", radius, 0.01),
    ("the curve", "hair.control_points", coordinate(3), 0.004),
    ("the floor", "floor.to_world", entry(2, 3), 0.01),
)
SCENES = ("ball, grid and tube", "pipe, cubic and cones")
CASES = [
    *(
        Case(f"{scene}, {light}", name, tangent, step, what, depth, 512, 2048)
        for scene in SCENES
        for light, depth in (("lamp", 2), ("lamp", 3), ("point", 2), ("sky", 2))
        for what, name, tangent, step in MOTIONS
    ),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_reverse_mode_is_the_transpose(name: str) -> None:
    scene, params = load(f"{name}, lamp")
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 1}
    assert_transposes(scene, params, [name for _what, name, _tangent, _step in MOTIONS], options)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (
            {"shape": {"to_world": T.translate([-0.3, 0.0, 0.5]).scale(0.4)}},
            "'shape' runs through the surface of 'body'",
        ),
        ({"hair": {"to_world": T.translate([0.0, 0.0, -0.6])}}, "'shape' runs through the tubes of 'hair'"),
        ({"hair": {"to_world": T.translate([-1.1, 0.0, -0.6])}}, "'body' runs through the tubes of 'hair'"),
    ],
)
def test_what_runs_into_each_other_is_refused(change: dict, problem: str) -> None:
    whole = {"type": "scene", **beside("lamp", "linear", BALL, "bsplinecurve")()}
    for name, more in change.items():
        whole[name] |= more
    scene = psdr.load_dict(whole)
    with pytest.raises(ValueError, match=problem):
        psdr.plan(scene, names=["shape.to_world", "hair.to_world"], integrator=psdr.PathIntegrator(max_depth=2))
    psdr.plan(scene, names=["shape.to_world"], integrator=psdr.PathIntegrator(max_depth=2, boundary=None))

"""Derivatives of grids of signed distances that meshes run through, all terms together."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import T, diffuse, floor, load, register
from .test_crossing import VIEW
from .test_exact_sphere import LIGHTS, entry
from .test_sdfgrid import all_values, one_half, values

GRID, POSE, FLOOR = "body.grid", "body.to_world", "floor.to_world"
#: The centre is .17 above the floor, the radius about .43.
MATRIX = np.eye(4)
MATRIX[:3, :3] = 1.3 * np.array([[1.0, 0.2, 0.0], [-0.1, 0.9, 0.1], [0.0, 0.1, 1.0]])
MATRIX[:3, 3] = np.array([0.05, 0.0, 0.17]) - 0.5 * MATRIX[:3, :3].sum(axis=1)


def sunk(light: str, interpolation: str):
    normals = {"normals": "analytic"} if interpolation == "linear" else {}
    grid = {"type": "sdfgrid", "grid": values(), "interpolation": interpolation, "to_world": T(MATRIX), **normals}
    body = {**grid, "bsdf": diffuse(0.7, 0.5, 0.3)}
    return lambda: {"sensor": VIEW, "floor": floor(half=2.0), "body": body, **LIGHTS[light]()}


KINDS = ("linear",)
register({f"sunk {kind}, {light}": sunk(light, kind) for kind in KINDS for light in LIGHTS})
MOTIONS = (
    ("all values", GRID, all_values, 0.002),
    ("one half", GRID, one_half, 0.002),
    ("z", POSE, entry(2, 3), 0.005),
    ("the floor moves", FLOOR, entry(2, 3), 0.005),
)
CASES = [
    Case(f"sunk {kind}, {light}", name, tangent, step, what, depth, 1024, 4096)
    for kind in KINDS
    for light, depth in (("lamp", 2), ("lamp", 3), ("sky", 2), ("point", 2))
    for what, name, tangent, step in MOTIONS
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_reverse_mode_is_the_transpose(kind: str) -> None:
    scene, params = load(f"sunk {kind}, lamp")
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 1}
    assert_transposes(scene, params, [GRID, POSE, FLOOR], options)

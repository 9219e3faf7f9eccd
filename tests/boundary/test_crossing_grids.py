"""Derivatives of grids of signed distances that meshes run through, all terms together."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows, slope
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


KINDS = ("linear", "cubic")
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


@pytest.mark.slow
def test_the_floor_below_an_overhang() -> None:
    """What the floor receives has no slope next to the curve: with all segments that start there it counted twice."""
    scene, params = load("sunk cubic, lamp")
    integrator, step = psdr.PathIntegrator(max_depth=2), 0.004
    base = params[GRID].numpy().copy()
    given = {GRID: np.ones_like(base)}

    def front(image) -> float:
        return float(image.numpy()[9:12, 6:11].sum())

    def shown(shift: float, seed: int) -> float:
        params[GRID] = base + np.float32(shift)
        params.update()
        return front(psdr.render(scene, integrator=integrator, spp=2048, seed=seed))

    expected = np.array([(shown(step, s) - shown(-step, s)) / (2.0 * step) for s in range(8)])
    params[GRID] = base
    params.update()
    options = {"integrator": integrator, "spp": 512}
    found = np.array([front(psdr.render_forward(scene, params, given, seed=s, **options)) for s in range(8)])
    value, error = slope(found, expected)
    assert error < 0.02
    assert abs(value - 1.0) < 3.0 * error, (value, error)

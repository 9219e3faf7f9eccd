"""Derivatives of smooth grids of signed distances, all terms together, and of what moves around them."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.test_sdfgrid import nodes

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import T, diffuse, floor, load, register
from .test_exact_sphere import LIGHTS, ROTATION, SHEAR, VIEW, entry, moved_light
from .test_sdfgrid import MATRIX, all_values, ball_on_the_film, one_half, values

GRID, POSE, FLOOR, LAMP, WALL = (
    "body.grid",
    "body.to_world",
    "floor.to_world",
    "light.vertex_positions",
    "wall.to_world",
)
TILES = {"type": "bitmap", "bitmap": np.random.default_rng(0).random((6, 6, 3)).astype(np.float32), "raw": True}


def neck(count: int = 17) -> np.ndarray:
    """Two spheres, blended."""
    x, y, z = nodes(count)
    a = np.sqrt((x - 0.36) ** 2 + (y - 0.45) ** 2 + (z - 0.5) ** 2) - 0.22
    b = np.sqrt((x - 0.68) ** 2 + (y - 0.55) ** 2 + (z - 0.5) ** 2) - 0.17
    return (-0.05 * np.log(np.exp(-a / 0.05) + np.exp(-b / 0.05))).astype(np.float32)


def body(grid: np.ndarray) -> dict:
    return {
        "type": "sdfgrid",
        "grid": grid,
        "interpolation": "cubic",
        "to_world": T(MATRIX),
        "bsdf": diffuse(0.7, 0.5, 0.3),
    }


def room(light: str, grid: np.ndarray):
    return lambda: {"sensor": VIEW, "floor": floor(half=2.0), "body": body(grid), **LIGHTS[light]()}


def walled():
    """Light between a grid and a textured wall beside it."""
    wall = T.translate([-0.9, 0.1, 0.8]).rotate([0, 1, 0], 80.0).scale(0.6)
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": TILES}}
    return {**room("lamp", values())(), "wall": {"type": "rectangle", "to_world": wall, "bsdf": bsdf}}


register(
    {
        **{f"cubic, {light}": room(light, values()) for light in LIGHTS},
        "bumpy cubic, lamp": room("lamp", values(24, noise=0.05)),
        "neck, lamp": room("lamp", neck()),
        "cubic, wall": walled,
    }
)


def right_sphere(grid):
    """The other sphere of ``neck`` grows."""
    x, y, z = nodes(grid.shape[0])
    a = np.sqrt((x - 0.36) ** 2 + (y - 0.45) ** 2 + (z - 0.5) ** 2) - 0.22
    b = np.sqrt((x - 0.68) ** 2 + (y - 0.55) ** 2 + (z - 0.5) ** 2) - 0.17
    share = np.exp(-b / 0.05) / (np.exp(-a / 0.05) + np.exp(-b / 0.05))
    return -share.reshape(grid.shape)


STEP = 0.003
CASES = [
    Case("cubic, lamp", GRID, one_half, STEP, "one half", 2, 768, 2560),
    *(
        Case(f"cubic, {light}", GRID, tangent, STEP, what, 2, spp, 4 * spp)
        for light, spp in (("sky", 2048), ("lamp", 768), ("point", 512), ("sun", 512), ("spot", 512))
        for what, tangent in (("all values", all_values), ("one half", one_half))
        if (light, what) != ("lamp", "one half")
    ),
    *(
        Case(f"cubic, {light}", POSE, tangent, 0.01, what, 2, spp, 4 * spp)
        for light, spp in (("sky", 2048), ("lamp", 768), ("point", 512))
        for what, tangent in (("x", entry(0, 3)), ("z", entry(2, 3)))
    ),
    *(
        Case(f"cubic, {light}", POSE, tangent, 0.01, what, 2, 2048, 4096)
        for light in ("sky", "lamp")
        for what, tangent in (("rotation", ROTATION), ("shear", SHEAR))
    ),
    Case("cubic, lamp", FLOOR, entry(2, 3), 0.01, "the floor moves", 2, 1024, 3072),
    Case("cubic, lamp", LAMP, moved_light, 0.01, "the lamp moves", 2, 1024, 3072),
    Case("cubic, point", "light.position", moved_light, 0.01, "the lamp moves", 2, 512, 2048),
    Case("cubic, lamp", "sensor.to_world", entry(0, 3), 0.01, "the camera moves", 2, 1024, 3072),
    Case("bumpy cubic, lamp", GRID, all_values, 0.002, "all values", 2, 1024, 3072),
    Case("neck, lamp", GRID, all_values, STEP, "all values", 2, 2048, 4096),
    Case("neck, lamp", GRID, right_sphere, STEP, "one sphere", 2, 2048, 4096),
    Case("cubic, wall", GRID, all_values, STEP, "all values", 4, 1024, 4096),
    Case("cubic, wall", WALL, entry(0, 3), 0.01, "the wall moves", 4, 1024, 4096),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
def test_reverse_mode_is_the_transpose() -> None:
    scene, params = load("cubic, wall")
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 1}
    assert_transposes(scene, params, [GRID, POSE, WALL, LAMP], options)


@pytest.mark.slow
def test_the_limit_is_the_exact_sphere() -> None:
    """Derivatives of the area on the film by radius and distance, before a sky."""
    count, radius = 33, 0.4
    # Values whose spline has this radius.
    x, y, z = nodes(count)
    grid = np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - radius - 1.0 / (3.0 * radius * (count - 1) ** 2)
    np.testing.assert_allclose(ball_on_the_film(grid, interpolation="cubic"), [0.893609, -0.223402], rtol=0.005)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"grid": values() - 0.2}, "the surface of 'body' ends at its box"),
        ({"bsdf": {"type": "plastic"}}, "not followed through the 'plastic' of 'body'"),
    ],
)
def test_what_has_no_terms_is_refused(change: dict, problem: str) -> None:
    whole = {"type": "scene", **room("lamp", values())()}
    whole["body"] |= change
    scene = psdr.load_dict(whole)
    with pytest.raises(ValueError, match=problem):
        psdr.plan(scene, names=[GRID], integrator=psdr.PathIntegrator(max_depth=2))
    psdr.plan(scene, names=[GRID], integrator=psdr.PathIntegrator(max_depth=2, boundary=None))

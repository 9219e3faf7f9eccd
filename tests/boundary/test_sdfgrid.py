"""Derivatives of grids of signed distances, all terms together, and of what moves around them."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.path.test_sdfgrid import nodes
from warp_psdr.estimate.boundary import terms
from warp_psdr.estimate.boundary.drivers import launch_backward
from warp_psdr.estimate.boundary.terms import secondary_silhouettes
from warp_psdr.estimate.boundary.terms.request import Request
from warp_psdr.estimate.gradient_sums import GradientSums
from warp_psdr.plan.motion import motion
from warp_psdr.plan.plan import decide

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows, slope
from .scenes import T, camera, diffuse, floor, load, register, sky
from .test_exact_sphere import LIGHTS, ROTATION, SHEAR, VIEW, entry, moved_light

GRID, POSE, FLOOR, LAMP = "body.grid", "body.to_world", "floor.to_world", "light.vertex_positions"
MATRIX = np.eye(4)
MATRIX[:3, :3] = 1.4 * np.array([[1.0, 0.2, 0.0], [-0.1, 0.9, 0.1], [0.0, 0.1, 1.0]])
MATRIX[:3, 3] = np.array([0.05, 0.0, 0.75]) - 0.5 * MATRIX[:3, :3].sum(axis=1)


def values(count: int = 17, noise: float = 0.0, hole: float = 0.0) -> np.ndarray:
    """A sphere; with bumps, or with a hole through it."""
    x, y, z = nodes(count)
    ball = np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - 0.33
    ball = ball + noise * np.sin(9.0 * x) * np.sin(8.0 * y + 1.0) * np.sin(10.0 * z)
    if hole:
        ball = np.maximum(ball, hole - np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2))
    return ball.astype(np.float32)


def body(**grid) -> dict:
    return {
        "type": "sdfgrid",
        "grid": values(**grid),
        "normals": "analytic",
        "to_world": T(MATRIX),
        "bsdf": diffuse(0.7, 0.5, 0.3),
    }


def room(light: str, **grid):
    return lambda: {"sensor": VIEW, "floor": floor(half=2.0), "body": body(**grid), **LIGHTS[light]()}


def shaded(make, count: int):
    """The same with interpolated normals, on a coarse grid, where they differ most from the surface's own."""
    return lambda: {**make(), "body": {**body(count=count), "normals": "smooth"}}


def neighbours():
    """Two grids whose boxes around the surface overlap, though they keep apart."""
    beside = MATRIX.copy()
    beside[:3, 3] += MATRIX[:3, :3] @ np.array([0.61, 0.61, 0.0])
    return {**room("lamp")(), "other": {**body(), "to_world": T(beside)}}


def walled():
    """Light between a grid and a wall beside it."""
    wall = T.translate([-0.9, 0.1, 0.8]).rotate([0, 1, 0], 80.0).scale(0.6)
    bsdf = {"type": "twosided", "bsdf": diffuse(0.8, 0.6, 0.5)}
    return {**room("lamp")(), "wall": {"type": "rectangle", "to_world": wall, "bsdf": bsdf}}


def own_shadow():
    """A close view of the edge of a coarse grid's own shadow in a voxel, where the normal still faces the lamp."""
    return {
        "sensor": camera((0.3, -3.0, 2.0), (-0.16934556, -0.36376879, 0.5470385), fov=0.8),
        "body": {**body(count=6), "normals": "smooth"},
        "light": {"type": "point", "position": [-1.51648776, -1.25031681, 2.24498309], "intensity": 5.0},
    }


register(
    {
        "own shadow": own_shadow,
        **{f"grid, {light}": room(light) for light in LIGHTS},
        "bumpy grid, lamp": room("lamp", count=24, noise=0.05),
        "pierced grid, sky": room("sky", count=33, hole=0.12),
        "fine grid, sky": room("sky", count=33),
        "grid, wall": walled,
        "two grids, lamp": neighbours,
        **{f"shaded grid, {light}": shaded(room(light), 9) for light in ("sky", "lamp", "point")},
        "shaded grid, wall": shaded(walled, 9),
    }
)


def all_values(grid):
    return np.ones_like(grid)


def one_half(grid):
    r = np.zeros_like(grid)
    r[:, :, grid.shape[2] // 2 :] = 1.0
    return r


def lifted_light(place):
    return 0.0 * place + [0.0, 0.0, 1.0]


STEP = 0.003
CASES = [
    # Its outline, its shadow, and its values along the way.
    Case("grid, point", POSE, entry(2, 3), 0.01, "z", 2, 160, 512, slow=False),
    *(
        Case(f"grid, {light}", GRID, tangent, STEP, what, 2, spp, 4 * spp)
        for light, spp in (("sky", 1024), ("lamp", 512), ("point", 512), ("sun", 512), ("spot", 512))
        for what, tangent in (("all values", all_values), ("one half", one_half))
    ),
    *(
        Case(f"grid, {light}", POSE, tangent, 0.01, what, 2, spp, 4 * spp)
        for light, spp in (("sky", 1024), ("lamp", 512), ("point", 512))
        for what, tangent in (("x", entry(0, 3)), ("z", entry(2, 3)))
        if (light, what) != ("point", "z")
    ),
    *(
        Case(f"grid, {light}", POSE, tangent, 0.01, what, 2, 2048, 4096)
        for light in ("sky", "lamp")
        for what, tangent in (("rotation", ROTATION), ("shear", SHEAR))
    ),
    Case("grid, lamp", FLOOR, entry(2, 3), 0.01, "the floor moves", 2, 512, 2048),
    Case("grid, lamp", LAMP, moved_light, 0.01, "the lamp moves", 2, 512, 2048),
    Case("grid, point", "light.position", moved_light, 0.01, "the lamp moves", 2, 512, 2048),
    Case("grid, lamp", "sensor.to_world", entry(0, 3), 0.01, "the camera moves", 2, 512, 2048),
    Case("shaded grid, lamp", POSE, entry(0, 3), 0.01, "x", 2, 256, 1024),
    # Without its term the first slope is .07.
    Case("own shadow", "light.position", lifted_light, 0.001, "the lamp rises", 2, 128, 1024),
    Case("own shadow", POSE, entry(2, 3), 0.0003, "z", 2, 512, 2048),
    Case("own shadow", GRID, all_values, 0.0003, "all values", 2, 512, 2048),
    Case("two grids, lamp", POSE, entry(0, 3), 0.01, "x", 2, 512, 2048),
    *(
        Case(f"shaded grid, {light}", name, tangent, step, what, 2, spp, 4 * spp)
        for light, spp in (("sky", 1024), ("lamp", 512), ("point", 512))
        for name, tangent, step, what in (
            (POSE, entry(2, 3), 0.01, "z"),
            (GRID, all_values, STEP, "all values"),
            ("sensor.to_world", entry(0, 3), 0.01, "the camera moves"),
        )
    ),
    Case("shaded grid, lamp", LAMP, moved_light, 0.01, "the lamp moves", 2, 512, 2048),
    Case("shaded grid, wall", GRID, all_values, STEP, "all values", 4, 512, 1024),
    Case("shaded grid, wall", "wall.to_world", entry(0, 3), 0.01, "the wall moves", 4, 512, 1024),
    Case("bumpy grid, lamp", GRID, all_values, 0.002, "all values", 2, 512, 2048),
    Case("pierced grid, sky", GRID, all_values, 0.0015, "all values", 2, 3072, 8192),
    Case("fine grid, sky", GRID, all_values, 0.0015, "all values", 2, 2048, 8192),
    Case("grid, wall", GRID, all_values, STEP, "all values", 4, 1024, 4096),
    Case("grid, wall", "wall.to_world", entry(0, 3), 0.01, "the wall moves", 4, 1024, 4096),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
def test_the_table_can_tell_a_missing_terminator(monkeypatch) -> None:
    case = next(c for c in CASES if str(c) == "shaded grid, lamp, x, depth 2")
    rest = tuple(t for t in terms.TERMS[psdr.boundary.PathSpace] if t.name != "grid_terminator")
    monkeypatch.setitem(terms.TERMS, psdr.boundary.PathSpace, rest)
    value, error = slope(derivatives(case, "forward"), differences(case)[2])
    assert abs(value - 1.0) > 0.05 + 3.0 * error


@pytest.mark.slow
@pytest.mark.parametrize("name", ["grid, wall", "shaded grid, wall"])
def test_reverse_mode_is_the_transpose(name: str) -> None:
    scene, params = load(name)
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 1}
    assert_transposes(scene, params, [GRID, POSE, "wall.to_world", LAMP], options)


def ball_on_the_film(grid: np.ndarray, **kind: str) -> list[float]:
    """Derivatives of the area on the film by radius and distance, before a sky: of a ball of radius 0.4 in its box."""
    side = 0.5 / 0.4
    pose = np.eye(4)
    pose[:3, :3] *= side
    pose[:3, 3] = np.array([0.0, 0.0, 2.0]) - 0.5 * side
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    view = T.look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])
    ball = {"type": "sdfgrid", "grid": grid, "to_world": T(pose), "bsdf": diffuse(0.0, 0.0, 0.0), **kind}
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 60.0, "to_world": view, "film": film},
            "sky": {"type": "constant", "radiance": 1.0},
            "ball": ball,
        }
    )
    params = psdr.traverse(scene)
    params.requires_grad("ball.grid", "ball.to_world")
    integrator = psdr.PathIntegrator(max_depth=1)
    psdr.render_backward(scene, params, np.ones((32, 32, 3)) / 3.0, spp=1024, integrator=integrator)
    pixel = (2.0 * np.tan(np.radians(30.0)) / 32.0) ** 2
    by_radius = pixel * params["ball.grid"].grad.numpy().sum() / side
    by_distance = -pixel * params["ball.to_world"].grad.numpy().reshape(4, 4)[2, 3]
    return [by_radius, by_distance]


@pytest.mark.slow
def test_the_limit_is_the_exact_sphere() -> None:
    """Derivatives of the area on the film by radius and distance, before a sky: a grid of 65^3 nodes."""
    x, y, z = nodes(65)
    grid = (np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - 0.4).astype(np.float32)
    # A tri-linear sphere of 26 voxels across the radius, and the samples' error.
    np.testing.assert_allclose(ball_on_the_film(grid), [0.893609, -0.223402], rtol=0.01)


@pytest.mark.parametrize(
    ("change", "boundary", "problem"),
    [
        ({}, psdr.boundary.Projective(), "does not know 'body'"),
        ({"bsdf": {"type": "plastic"}}, "auto", "'plastic' of 'body'; give it a 'conductor' or a 'dielectric'"),
        ({"grid": values() - 0.2}, "auto", "the surface of 'body' ends at its box"),
    ],
)
def test_what_has_no_terms_is_refused(change: dict, boundary, problem: str) -> None:
    whole = {"type": "scene", **room("lamp")()}
    whole["body"] |= change
    scene = psdr.load_dict(whole)
    with pytest.raises(ValueError, match=problem):
        psdr.plan(scene, names=[GRID], integrator=psdr.PathIntegrator(max_depth=2, boundary=boundary))
    psdr.plan(scene, names=[GRID], integrator=psdr.PathIntegrator(max_depth=2, boundary=None))


def test_neighbours_that_have_no_terms_are_refused() -> None:
    apart = psdr.load_dict({"type": "scene", **neighbours()})
    psdr.plan(apart, names=["sensor.to_world"], integrator=psdr.PathIntegrator(max_depth=2))
    scene = psdr.load_dict({"type": "scene", **room("lamp")(), "other": body()})
    with pytest.raises(ValueError, match="'other' runs through the surface of 'body'"):
        psdr.plan(scene, names=["sensor.to_world"], integrator=psdr.PathIntegrator(max_depth=2))
    near = camera((0.3, -3.0, 2.0), (0.0, 0.0, 0.4), fov=45.0) | {"near_clip": 3.1}
    scene = psdr.load_dict({"type": "scene", "sensor": near, "sky": sky(), "body": body()})
    params = psdr.traverse(scene)
    params.requires_grad(GRID)
    with pytest.raises(ValueError, match="runs through the box around the surface of the grid 'body'"):
        psdr.render_backward(scene, params, np.ones((16, 16, 3)), spp=1, integrator=psdr.PathIntegrator(max_depth=1))


def test_both_techniques_of_smooth_silhouettes_have_one_measure(monkeypatch) -> None:
    """However many segments are drawn for the grid instead of for the lamp, the weights of the two add up to 1."""
    scene, _params = load("grid, lamp")
    adjoint = wp.full((scene.camera(0).crop_height, scene.camera(0).crop_width), wp.vec3(1.0), device="cpu")
    plan = decide(scene, names=[GRID], integrator=psdr.PathIntegrator(max_depth=2), sensor=0)
    p, found = scene.parameters[GRID], []
    for share in (0.1, 0.7):
        monkeypatch.setattr(Request, "own_share", property(lambda _request, share=share: share))
        totals = []
        for seed in range(8):
            # Without creases, whose densities are those of both techniques.
            request = Request(scene, plan, motion(scene, [GRID]), "reverse", 0, 2048, seed, creases=False)
            sums = GradientSums(scene, [GRID])
            launch_backward(scene, terms.launches(secondary_silhouettes.TERMS["grid"], request), adjoint, sums)
            totals.append(float(sums.result().numpy()[p.offset : p.offset + p.size].sum(dtype=np.float64)))
        found.append((np.mean(totals), np.std(totals, ddof=1) / np.sqrt(8.0)))
    (aimed, aimed_error), (own, own_error) = found
    # With the curve's density for the surface's, the second is 1.14 times the first.
    assert np.hypot(aimed_error, own_error) < 0.03 * abs(aimed)
    assert abs(own - aimed) < 4.0 * np.hypot(aimed_error, own_error), found

"""Derivatives of curves with a radius, all terms together, and of what moves around them."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import T, camera, diffuse, floor, load, panel, register, sky
from .test_exact_sphere import LIGHTS, TILES, VIEW, entry, moved_light

POINTS, POSE, FLOOR, LAMP = "body.control_points", "body.to_world", "floor.to_world", "light.vertex_positions"


def tube(kind: str) -> np.ndarray:
    """Control points (N, 4) above a floor."""
    k = np.linspace(0.0, 1.0, 8)
    x, zero = 2.4 * k - 1.2, 0.0 * k
    if kind == "straight":
        return np.column_stack([x, 0.3 * x, 0.7 + 0.1 * x, zero + 0.22])
    if kind == "helix":
        return np.column_stack([x, 0.4 * np.cos(7.0 * k), 0.8 + 0.4 * np.sin(7.0 * k), zero + 0.16])
    if kind == "tapered":
        return np.column_stack([x, 0.3 * np.sin(4.0 * k), 0.7 + 0.2 * np.cos(5.0 * k), 0.4 - 0.32 * k])
    if kind == "crossed":
        return np.concatenate([tube("straight"), tube("straight")[:, [1, 0, 2, 3]]])
    assert kind == "fat"
    return np.column_stack([1.4 * x, zero - 0.6, 1.0 + 0.15 * x**2, 0.55 + 0.1 * x])


def body(kind: str, plugin: str) -> dict:
    return {"type": plugin, "control_points": tube(kind), "bsdf": diffuse(0.7, 0.5, 0.3)}


def room(light: str, kind: str, plugin: str = "bsplinecurve"):
    return lambda: {"sensor": VIEW, "floor": floor(half=2.0), "body": body(kind, plugin), **LIGHTS[light]()}


def alone(kind: str, plugin: str = "bsplinecurve"):
    """Before a sky, the camera so near that a fat tube fills much of its view."""
    view = camera((0.3, -2.2, 1.6), (0.0, 0.0, 0.7), fov=60.0)
    return lambda: {"sensor": view, "sky": sky(), "body": body(kind, plugin)}


def walled(plugin: str):
    """Light between curves and a wall beside them, whose colours differ from place to place."""
    pose = T.translate([0.1, 0.75, 0.7]).rotate([1, 0, 0], 80.0).scale([1.3, 0.7, 1.0])
    texture = {"type": "bitmap", "bitmap": TILES, "raw": True}
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}}
    lamp = {"light": panel((0.5, -1.2, 2.2), 0.4)}
    return lambda: {
        **room("sky", "helix", plugin)(),
        **lamp,
        "wall": {"type": "rectangle", "to_world": pose, "bsdf": bsdf},
    }


KINDS = ("straight", "helix", "tapered", "fat")
register(
    {
        **{f"{kind} tube": alone(kind) for kind in KINDS},
        **{f"{kind} cones": alone(kind, "linearcurve") for kind in KINDS},
        **{f"{kind} tube, {light}": room(light, kind) for kind in ("helix", "tapered") for light in LIGHTS},
        "helix tube, wall": walled("bsplinecurve"),
        "helix cones, wall": walled("linearcurve"),
        **{f"helix cones, {light}": room(light, "helix", "linearcurve") for light in LIGHTS},
    }
)


def coordinate(axis: int, point: int | None = None):
    """All control points move along an axis, or one; axis 3 is the radius."""

    def tangent(values):
        r = 0.0 * values.reshape(-1, 4)
        r[slice(None) if point is None else point, axis] = 1.0
        return r.reshape(values.shape)

    return tangent


STEP = 0.004
MOVES = (
    ("x", coordinate(0), 1),
    ("z", coordinate(2), 1),
    ("one point", coordinate(2, 4), 6),
    ("radii", coordinate(3), 1),
)
CASES = [
    Case("tapered tube", POINTS, coordinate(3), STEP, "radii", 1, 256, 1024),
    *(
        Case(f"{kind} {what}", POINTS, tangent, STEP, move, 2, 512 * more, 2048 * more)
        for what in ("tube", "cones")
        for kind in KINDS
        for move, tangent, more in MOVES
    ),
    *(
        Case(f"{name}, {light}", POINTS, tangent, STEP, move, 2, 512 * more, 2048 * more)
        for name in ("tapered tube", "helix cones")
        for light in LIGHTS
        for move, tangent, more in MOVES[2:]
    ),
    *(
        Case(f"{name}, {light}", POSE, tangent, 0.01, what, 2, 1024, 4096)
        for name in ("helix tube", "helix cones")
        for light in ("sky", "lamp")
        for what, tangent in (("x", entry(0, 3)), ("z", entry(2, 3)), ("shear", entry(0, 2)))
    ),
    *(
        Case(f"{name}, {light}", parameter, tangent, 0.01, what, 2, 1024, 4096)
        for name in ("tapered tube", "helix cones")
        for light, parameter, tangent, what in (
            ("lamp", FLOOR, entry(2, 3), "the floor moves"),
            ("lamp", LAMP, moved_light, "the lamp moves"),
            ("point", "light.position", moved_light, "the lamp moves"),
            ("lamp", "sensor.to_world", entry(0, 3), "the camera moves"),
        )
    ),
    *(
        Case(f"helix {what}, wall", parameter, tangent, step, move, 4, 1024, 4096)
        for what in ("tube", "cones")
        for parameter, tangent, step, move in (
            (POINTS, coordinate(3), STEP, "radii"),
            (POINTS, coordinate(1), STEP, "y"),
            ("wall.to_world", entry(1, 3), 0.01, "the wall moves"),
        )
    ),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("what", ["tube", "cones"])
def test_reverse_mode_is_the_transpose(what: str) -> None:
    scene, params = load(f"helix {what}, wall")
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 1}
    assert_transposes(scene, params, [POINTS, POSE, "wall.to_world", LAMP], options)


@pytest.mark.parametrize(
    ("change", "boundary", "problem"),
    [
        ({}, psdr.boundary.Projective(), "does not know 'body'"),
        (
            {"bsdf": {"type": "dielectric"}},
            "auto",
            "'dielectric' of 'body'; give it a 'conductor', or make",
        ),
        ({"bsdf": {"type": "plastic"}, "type": "linearcurve"}, "auto", "'plastic' of 'body'; give it a 'conductor'"),
    ],
)
def test_what_has_no_terms_is_refused(change: dict, boundary, problem: str) -> None:
    whole = {"type": "scene", **room("lamp", "straight")()}
    whole["body"] |= change
    scene = psdr.load_dict(whole)
    with pytest.raises(ValueError, match=problem):
        psdr.plan(scene, names=[POINTS], integrator=psdr.PathIntegrator(max_depth=2, boundary=boundary))
    psdr.plan(scene, names=[POINTS], integrator=psdr.PathIntegrator(max_depth=2, boundary=None))


def test_what_cuts_them_is_refused() -> None:
    near = camera((0.3, -3.0, 2.0), (0.0, 0.0, 0.4), fov=45.0) | {"near_clip": 3.1}
    scene = psdr.load_dict({"type": "scene", "sensor": near, "sky": sky(), "body": body("straight", "bsplinecurve")})
    params = psdr.traverse(scene)
    params.requires_grad(POINTS)
    with pytest.raises(ValueError, match="cuts the curves 'body'"):
        psdr.render_backward(scene, params, np.ones((16, 16, 3)), spp=1, integrator=psdr.PathIntegrator(max_depth=1))

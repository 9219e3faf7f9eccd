"""Derivatives of networks of signed distances, all terms together, and of what moves around them."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.networks import fitted, neck, sphere

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import T, diffuse, floor, load, register
from .test_exact_sphere import LIGHTS, VIEW, entry, moved_light
from .test_sdfgrid import MATRIX
from .test_sdfgrid_cubic import TILES

FIRST, SECOND, SHIFT = "body.layer0.weight", "body.layer1.weight", "body.layer2.bias"
POSE, FLOOR, LAMP, WALL = "body.to_world", "floor.to_world", "light.vertex_positions", "wall.to_world"


def body(target=sphere, **more) -> dict:
    return fitted(target, (24, 24), **more).plugin(to_world=T(MATRIX), bsdf=diffuse(0.7, 0.5, 0.3))


def room(light: str, network: dict):
    return lambda: {"sensor": VIEW, "floor": floor(half=2.0), "body": network, **LIGHTS[light]()}


def walled():
    """Light between a network and a textured wall beside it."""
    wall = T.translate([-0.9, 0.1, 0.8]).rotate([0, 1, 0], 80.0).scale(0.6)
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": TILES}}
    return {**room("lamp", body())(), "wall": {"type": "rectangle", "to_world": wall, "bsdf": bsdf}}


register(
    {
        **{f"network, {light}": room(light, body()) for light in LIGHTS},
        "network neck, lamp": room("lamp", body(neck)),
        "network of sines, lamp": room("lamp", body(sine=True, scale=3.0, gain=1.5)),
        "network, wall": walled,
    }
)


def ones(value):
    return np.ones_like(value)


def at_random(value):
    return 0.3 * np.random.default_rng(5).standard_normal(value.shape)


STEP = 0.003
CASES = [
    Case("network, lamp", SECOND, at_random, STEP, "second weights", 2, 768, 1536),
    *(
        Case(f"network, {light}", name, tangent, STEP, what, 2, spp, 2 * spp)
        for light, spp in (("sky", 1024), ("lamp", 512), ("point", 512), ("sun", 512), ("spot", 512))
        for what, name, tangent in (
            ("shift", SHIFT, ones),
            ("first weights", FIRST, at_random),
            ("second weights", SECOND, at_random),
        )
        if (light, name) != ("lamp", SECOND)
    ),
    *(
        Case(f"network, {light}", POSE, entry(0, 3), 0.01, "x", 2, 512, 1024)
        for light in ("sky", "lamp", "point")
    ),
    Case("network, lamp", FLOOR, entry(2, 3), 0.01, "the floor moves", 2, 512, 1024),
    Case("network, lamp", LAMP, moved_light, 0.01, "the lamp moves", 2, 512, 1024),
    Case("network, lamp", "sensor.to_world", entry(0, 3), 0.01, "the camera moves", 2, 512, 1024),
    Case("network neck, lamp", SHIFT, ones, STEP, "shift", 2, 1024, 2048),
    Case("network of sines, lamp", SECOND, at_random, STEP, "second weights", 2, 1024, 2048),
    Case("network, wall", SHIFT, ones, STEP, "shift", 4, 512, 2048),
    Case("network, wall", WALL, entry(0, 3), 0.01, "the wall moves", 4, 512, 2048),
]  # fmt: skip


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
def test_reverse_mode_is_the_transpose() -> None:
    scene, params = load("network, wall")
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 1}
    assert_transposes(scene, params, [FIRST, SECOND, SHIFT, POSE, WALL, LAMP], options)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"bsdf": {"type": "plastic"}}, "not followed through the 'plastic' of 'body'"),
        ({"layer2.bias": body()["layer2.bias"] - 0.2}, "the surface of 'body' may end at its box"),
        ({"to_world": T(T.translate([0, 0, -0.4]).matrix @ MATRIX)}, "'floor' runs through the surface of 'body'"),
    ],
)
def test_what_has_no_terms_is_refused(change: dict, problem: str) -> None:
    whole = {"type": "scene", **room("lamp", body())()}
    whole["body"] = {**whole["body"], **change}
    scene = psdr.load_dict(whole)
    with pytest.raises(ValueError, match=problem):
        psdr.plan(scene, names=[SHIFT], integrator=psdr.PathIntegrator(max_depth=2))
    psdr.plan(scene, names=[SHIFT], integrator=psdr.PathIntegrator(max_depth=2, boundary=None))

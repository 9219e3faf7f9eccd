"""Tubes about B-splines, and cones between spheres, that are smooth mirrors: what moves, against differences."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .mirrors import ALONG, MIRROR, behind, lamp
from .scenes import camera, floor, load, register
from .test_exact_mirrors import soft_sky
from .test_exact_sphere import entry
from .test_tubes import coordinate

BODY, POINTS, LAMP = "body.to_world", "body.control_points", "lamp.vertex_positions"


def curve(plugin, size, center):
    """A mirror that bends and tapers."""
    k = np.linspace(0.0, 1.0, 7)
    points = np.column_stack([1.8 * k - 0.9, 0.1 * np.cos(4.0 * k), 0.15 * np.sin(5.0 * k), 0.3 - 0.1 * k])
    return {
        "type": plugin,
        "control_points": np.float32(size * points + np.array([*center, 0.0])),
        "bsdf": MIRROR,
    }


def close(plugin):
    """It is all that the camera sees, under a sky."""
    view = camera((0.3, -4.0, 0.6), (0.0, 0.0, 0.05), fov=4.0)
    return {"sensor": view, "sky": soft_sky(), "body": curve(plugin, 1.0, (0.0, 0.0, 0.0))}


def standing(plugin):
    """Over a floor, which it shows and lights, under a sky."""
    view = camera((0.3, -3.0, 1.2), (0.0, 0.0, 0.4), fov=30.0)
    return {"sensor": view, "sky": soft_sky(), "floor": floor(half=2.0), "body": curve(plugin, 1.0, (0.0, 0.0, 0.5))}


def lamps(plugin):
    """It shows a lamp and a post behind the camera: nothing but edges."""
    view = camera((0.3, -2.0, 0.6), (0.0, 1.2, 0.6), fov=9.0)
    body, light = curve(plugin, 2.4, (0.0, 1.5, 0.6)), lamp((-0.6, -4.0, 0.9), 1.2)
    return {"sensor": view, "post": behind()["post"], "body": body, "lamp": light}


KINDS = {"tube": "bsplinecurve", "cones": "linearcurve"}
for what, plugin in KINDS.items():
    register(
        {
            f"mirror {what}, close": lambda plugin=plugin: close(plugin),
            f"mirror {what}, floor": lambda plugin=plugin: standing(plugin),
            f"mirror {what}": lambda plugin=plugin: lamps(plugin),
        }
    )
X, RADIUS = entry(0, 3), coordinate(3, 3)
CASES = [
    Case("mirror tube, close", BODY, X, 0.004, "x", 3, 16, 64, slow=False),
    Case("mirror tube, close", POINTS, coordinate(2, 3), 0.004, "one point", 3, 64, 256),
    Case("mirror tube, close", POINTS, RADIUS, 0.004, "one radius", 3, 64, 256),
    Case("mirror tube, floor", BODY, X, 0.005, "x", 3, 1024, 4096),
    Case("mirror tube", BODY, X, 0.003, "x", 2, 1024, 4096),
    Case("mirror tube", POINTS, RADIUS, 0.003, "one radius", 2, 1024, 4096),
    Case("mirror tube", LAMP, ALONG, 0.02, "lamp moves", 2, 1536, 2048),
    Case("mirror cones, close", POINTS, coordinate(2, 3), 0.002, "one point", 3, 64, 512),
    Case("mirror cones, close", POINTS, RADIUS, 0.002, "one radius", 3, 64, 512),
    Case("mirror cones, floor", BODY, X, 0.005, "x", 3, 1024, 4096),
    Case("mirror cones", BODY, X, 0.003, "x", 2, 1024, 4096),
    Case("mirror cones", POINTS, RADIUS, 0.0015, "one radius", 2, 1024, 8192),
    Case("mirror cones", LAMP, ALONG, 0.02, "lamp moves", 2, 1024, 4096),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("what", KINDS)
def test_the_modes_are_transposes_of_each_other(what: str) -> None:
    scene, params = load(f"mirror {what}, floor")
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 3}
    assert_transposes(scene, params, [BODY, POINTS, "floor.to_world"], options)

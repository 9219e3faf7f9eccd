"""Grids of signed distances that are smooth mirrors or glass themselves: what moves, against differences."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.networks import neck, sphere
from tests.path.test_sdfgrid import nodes

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .mirrors import ALONG, GLASS, MIRROR, behind, glass, lamp
from .scenes import T, camera, floor, load, register
from .test_exact_mirrors import soft_sky
from .test_exact_sphere import entry
from .test_sdfgrid import all_values

BODY, GRID = "body.to_world", "body.grid"


CUBIC, LINEAR = {"interpolation": "cubic"}, {"interpolation": "linear", "normals": "analytic"}


def shape(size, center, bsdf, of=sphere, nodes_along=17, **more):
    """A grid of distances in a sheared box of a size around a place."""
    axes = size * np.array([[1.0, 0.1, 0.0], [-0.1, 0.9, 0.1], [0.0, 0.1, 1.0]])
    pose = np.eye(4)
    pose[:3, :3] = axes
    pose[:3, 3] = np.array(center) - 0.5 * axes.sum(axis=1)
    grid = of(np.stack(nodes(nodes_along), axis=-1)).astype(np.float32)
    return {"type": "sdfgrid", "grid": grid, "to_world": T(pose), "bsdf": bsdf, **(more or CUBIC)}


def close(of=neck, nodes_along=17, **more):
    """A mirror, which with a neck shows itself, under a sky; its outline is not on the film."""
    view = camera((0.3, -4.0, 0.6), (0.0, 0.0, 0.6), fov=5.0)
    body = shape(1.0, (0.0, 0.0, 0.6), MIRROR, of, nodes_along, **more)
    return {"sensor": view, "sky": soft_sky(), "body": body}


def standing(nodes_along=17, **more):
    """A mirror over a floor, which lights it, under a sky."""
    view = camera((0.3, -3.0, 1.2), (0.0, 0.0, 0.45), fov=24.0)
    body = shape(1.2, (0.0, 0.0, 0.5), MIRROR, sphere, nodes_along, **more)
    return {"sensor": view, "sky": soft_sky(), "floor": floor(half=2.0), "body": body}


def lamps(nodes_along=17, **more):
    """A mirror that shows a lamp and a post behind the camera: nothing but edges."""
    view = camera((0.3, -2.0, 0.6), (0.0, 1.2, 0.6), fov=9.0)
    body, light = shape(2.4, (0.0, 1.5, 0.6), MIRROR, sphere, nodes_along, **more), lamp((-0.6, -4.0, 0.9), 1.2)
    return {"sensor": view, "post": behind()["post"], "body": body, "lamp": light}


def lens(nodes_along=17, **more):
    """Two lamps behind a lens of glass."""
    view = camera((0.0, -4.0, 0.4), (0.0, 0.0, 0.0), fov=14.0)
    lights = {name: light for name, light in glass({}).items() if name in ("lamp", "other")}
    return {"sensor": view, "body": shape(2.2, (0.0, 0.0, 0.0), GLASS, sphere, nodes_along, **more), **lights}


register({"cubic mirror, close": close, "cubic mirror, floor": standing, "cubic mirror": lamps, "cubic glass": lens})
register(
    {
        "linear mirror, close": lambda: close(sphere, 9, **LINEAR),
        "linear mirror, floor": lambda: standing(9, **LINEAR),
        "linear mirror": lambda: lamps(9, **LINEAR),
        "linear glass": lambda: lens(9, **LINEAR),
    }
)
X = entry(0, 3)
CASES = [
    Case("cubic mirror, close", BODY, X, 0.004, "x", 3, 64, 256, slow=False),
    Case("cubic mirror, close", GRID, all_values, 0.002, "all values", 3, 64, 256),
    Case("cubic mirror, floor", BODY, X, 0.01, "x", 3, 576, 1536),
    Case("cubic mirror", BODY, X, 0.003, "x", 2, 256, 2048),
    Case("cubic mirror", GRID, all_values, 0.003, "all values", 2, 384, 2048),
    Case("cubic mirror", "lamp.vertex_positions", ALONG, 0.02, "lamp moves", 2, 128, 2048),
    Case("cubic glass", BODY, X, 0.003, "x", 4, 384, 2048),
    Case("cubic glass", "body.bsdf.eta", np.ones_like, 0.005, "index", 4, 384, 4096),
    # What a facet shows jumps at the next one, so that the remainder of a step is large.
    Case("linear mirror, close", BODY, X, 0.001, "x", 3, 192, 2048, slow=False),
    Case("linear mirror, close", GRID, all_values, 0.0007, "all values", 3, 192, 2048),
    Case("linear mirror, floor", BODY, X, 0.004, "x", 3, 384, 2048),
    Case("linear mirror", BODY, X, 0.003, "x", 2, 1024, 4096),
    Case("linear mirror", GRID, all_values, 0.003, "all values", 2, 1024, 4096),
    Case("linear glass", BODY, X, 0.003, "x", 4, 384, 2048),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "names", "depth"),
    [
        ("cubic mirror, floor", [BODY, GRID, "floor.to_world"], 3),
        ("linear mirror, floor", [BODY, GRID, "floor.to_world"], 3),
        ("cubic glass", [BODY, GRID, "body.bsdf.eta", "lamp.vertex_positions"], 4),
    ],
)
def test_the_modes_are_transposes_of_each_other(name, names, depth) -> None:
    scene, params = load(name)
    assert_transposes(scene, params, names, {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": 4, "seed": 3})

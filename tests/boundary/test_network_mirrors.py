"""Networks of signed distances that are smooth mirrors or glass themselves: what moves, against differences."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.networks import bowl

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .mirrors import GLASS, MIRROR
from .scenes import T, box, camera, diffuse, load, register, sky
from .test_exact_mirrors import soft_sky
from .test_exact_sphere import entry
from .test_neuralsdf import at_random

BODY, WEIGHTS, INDEX = "body.to_world", "body.layer0.weight", "body.bsdf.eta"


def ball(bsdf, size=2.0):
    """A network in a sheared box around the origin."""
    axes = size * np.array([[1.0, 0.1, 0.0], [-0.1, 0.9, 0.1], [0.0, 0.1, 1.0]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, -0.5 * axes.sum(axis=1)
    return bowl().plugin(to_world=T(pose), bsdf=bsdf)


def close(bsdf):
    """A part of it before a smooth sky: nothing jumps, and no ray inside meets it near the critical angle."""
    return {"sensor": camera((0.1, -4.0, 0.1), (0.0, 0.0, 0.0), fov=4.0), "sky": soft_sky(), "body": ball(bsdf)}


def posts(bsdf, half, *places):
    """Dark posts under a sky, of which it shows nothing but the edges."""
    dark = diffuse(0.1, 0.05, 0.02)
    shapes = {f"post{k}": box(place, half, dark, 0.4) for k, place in enumerate(places)}
    return {"sensor": camera((0.0, -4.0, 0.0), (0.0, 0.0, 0.0), fov=6.0), "sky": sky(0.5), "body": ball(bsdf), **shapes}


register(
    {
        "network mirror, close": lambda: close(MIRROR),
        "network glass, close": lambda: close(GLASS),
        "network mirror": lambda: posts(MIRROR, (0.5, 0.2, 0.6), (1.1, -3.0, 0.2), (-0.9, -2.5, -0.3)),
        "network glass": lambda: posts(GLASS, (0.25, 0.2, 0.3), (0.3, 1.6, 0.2)),
    }
)
X = entry(0, 3)
INTERIOR = [
    Case("network mirror, close", BODY, X, 0.004, "x", 3, 32, 256),
    Case("network mirror, close", WEIGHTS, at_random, 0.004, "weights", 3, 32, 256),
    Case("network glass, close", BODY, X, 0.02, "x", 3, 32, 1024),
    Case("network glass, close", INDEX, np.ones_like, 0.02, "index", 3, 32, 1024),
]
CASES = [
    Case("network mirror", BODY, X, 0.002, "x", 2, 128, 2048),
    Case("network mirror", WEIGHTS, at_random, 0.002, "weights", 2, 128, 2048),
    Case("network glass", BODY, X, 0.0007, "x", 4, 240, 2048),
]


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(INTERIOR))
def test_derivatives_of_what_does_not_jump_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode, boundary=None), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "depth"), [("network mirror", 3), ("network glass", 4)])
def test_the_modes_are_transposes_of_each_other(name: str, depth: int) -> None:
    scene, params = load(name)
    layers = ["body.layer0.weight", "body.layer0.bias", "body.layer1.weight", "body.layer1.bias"]
    options = {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": 4, "seed": 3}
    assert_transposes(scene, params, [BODY, *layers, "post0.vertex_positions"], options)

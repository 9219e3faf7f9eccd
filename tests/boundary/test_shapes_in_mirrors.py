"""Shapes without triangles that move in a flat mirror and behind a pane of glass, both of triangles."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.networks import bowl

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .mirrors import GLASS, MIRROR, point, wall
from .scenes import T, box, camera, diffuse, load, mesh, panel, register, sky
from .test_exact_sphere import entry, radius
from .test_neuralsdf import at_random
from .test_sdfgrid import all_values, values
from .test_sdfgrid_cubic import neck
from .test_tubes import coordinate

TILES = {"type": "bitmap", "bitmap": np.random.default_rng(0).random((6, 6, 3)).astype(np.float32), "raw": True}
PAPER = {"type": "diffuse", "reflectance": TILES}
PAINT = {"type": "twosided", "bsdf": diffuse(0.3, 0.5, 0.7)}
LEFT, MIDDLE, RIGHT = (-0.75, -0.3, 0.8), (0.0, 0.3, 0.5), (0.75, -0.2, 0.9)
POSES = {
    "sphere": T.translate(LEFT).rotate([0, 1, 1], 35.0).scale([0.4, 0.3, 0.35]),
    "cylinder": T.translate(MIDDLE).rotate([1, 0.4, 0], 25.0).scale([0.25, 0.25, 0.55]),
    "disk": T.translate(RIGHT).rotate([1, 1, 0], 50.0).scale(0.35),
}


def room(**shapes):
    """Shapes over a papered floor, the mirror that shows them, and a pane before them."""
    return {
        "sensor": camera((0.3, -2.6, 1.2), (0.0, 1.2, 0.6), fov=45.0),
        "mirror": wall(1.7),
        "floor": {"type": "rectangle", "to_world": T.scale(3.0), "bsdf": PAPER},
        "pane": box((0.1, -1.3, 0.95), (0.35, 0.05, 0.35), GLASS, 0.3),
        "lamp": panel((0.5, -0.8, 2.4), 0.5, 3.0),
        "light": point(3.0),
        "sky": sky(0.3),
        **shapes,
    }


def exact():
    return {k: {"type": k, "exact": True, "to_world": pose, "bsdf": PAINT} for k, pose in POSES.items()}


def behind(**shapes):
    """Shapes behind the camera, which sees a mirror, or the sky: all that moves is seen in the mirror."""
    floor = T.translate([0.0, -2.4, 0.0]).scale([2.0, 1.3, 1.0])
    return {
        "sensor": camera((0.0, -1.0, 1.2), (0.0, 1.2, 0.8), fov=45.0),
        "mirror": wall(0.8, 1.2, 1.4),
        "floor": {"type": "rectangle", "to_world": floor, "bsdf": PAPER},
        "lamp": panel((0.3, -2.5, 2.2), 0.5, 6.0),
        "sky": sky(0.3),
        **shapes,
    }


PLACE = (0.05, -2.6, 0.8)
BROWN = diffuse(0.7, 0.5, 0.3)


def boxed(**grid):
    """A grid of distances in a sheared box around the place."""
    axes = 0.9 * np.array([[1.0, 0.2, 0.0], [-0.1, 0.9, 0.1], [0.0, 0.1, 1.0]])
    pose = np.eye(4)
    pose[:3, :3] = axes
    pose[:3, 3] = np.array(PLACE) - 0.5 * axes.sum(axis=1)
    return {"type": "sdfgrid", **grid, "to_world": T(pose), "bsdf": BROWN}


def shown(body):
    """A shape over a papered floor, of which a mirror close to the camera shows what is behind the camera."""
    corners = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    under = T.translate([0.0, -2.9, 0.25]).scale([1.4, 1.4, 1.0])
    return {
        "sensor": camera((0.0, -1.0, 0.8), (0.0, 1.0, 0.8), fov=30.0),
        "mirror": mesh(0.17 * corners + np.array([0.0, -0.5, 0.8]), [[0, 1, 2], [0, 2, 3]], MIRROR),
        "floor": {"type": "rectangle", "to_world": under, "bsdf": PAPER},
        "lamp": panel((0.3, -2.6, 2.2), 0.5, 6.0),
        "sky": sky(0.5),
        "body": body,
    }


def plate():
    """A disk, whose outline is a rim alone."""
    pose = T.translate(list(PLACE)).rotate([1, 0.3, 0], 25.0).scale([0.4, 0.3, 1.0])
    return {"type": "disk", "exact": True, "to_world": pose, "bsdf": PAINT}


def tube(kind="bsplinecurve"):
    """A tapered curve."""
    k = np.linspace(0.0, 1.0, 7)
    along = np.column_stack([0.9 * k - 0.45, 0.25 * np.cos(6.0 * k), 0.3 * np.sin(6.0 * k), 0.15 - 0.06 * k])
    return {"type": kind, "control_points": np.float32(along + np.array([*PLACE, 0.0])), "bsdf": BROWN}


def network():
    """A dark ball under a sky: nothing but its outline moves."""
    pose = T.translate([x - 0.4 for x in PLACE]).scale(0.8)
    return {"sky": sky(0.5), "body": bowl().plugin(to_world=pose, bsdf=diffuse(0.1, 0.2, 0.3))}


def network_in_a_mirror():
    return {"sensor": camera((0.0, -1.0, 0.8), (0.0, 1.0, 0.8), fov=14.0), "mirror": wall(0.8, -0.5, 0.08), **network()}


def network_behind_glass():
    view = camera((0.0, -1.0, 0.8), (0.0, -2.6, 0.8), fov=14.0)
    return {"sensor": view, "pane": box((0.0, -1.7, 0.8), (0.4, 0.05, 0.4), GLASS, 0.3), **network()}


register(
    {
        "network in a mirror": network_in_a_mirror,
        "network behind glass": network_behind_glass,
        "tube in a mirror": lambda: shown(tube()),
        "cones in a mirror": lambda: shown(tube("linearcurve")),
        "disk in a mirror": lambda: shown(plate()),
        "linear grid in a mirror": lambda: shown(boxed(grid=values(), normals="analytic")),
        "cubic grid in a mirror": lambda: shown(boxed(grid=neck(), interpolation="cubic")),
        "exact shapes in a mirror": lambda: room(**exact()),
        "sunk sphere in a mirror": lambda: behind(
            ball={"type": "sphere", "exact": True, "to_world": T.translate([0, -2.2, 0.2]).scale(0.5), "bsdf": PAINT}
        ),
    }
)
EXACT = tuple(f"{kind}.to_world" for kind in POSES)
BODY = "body.to_world"
X, Z = entry(0, 3), entry(2, 3)
CASES = [
    Case("exact shapes in a mirror", EXACT, X, 0.01, "x", 4, 4096, 16384),
    Case("exact shapes in a mirror", EXACT, radius, 0.01, "size", 4, 4096, 16384),
    Case("exact shapes in a mirror", "mirror.vertex_positions", all_values, 0.01, "the mirror moves", 4, 4096, 16384),
    Case("sunk sphere in a mirror", "ball.to_world", Z, 0.01, "z", 4, 4096, 16384),
    # Differences lose 1.4 % to steps of 0.01.
    Case("tube in a mirror", "body.control_points", coordinate(2), 0.004, "z", 3, 3072, 32768),
    Case("cones in a mirror", "body.control_points", coordinate(2), 0.004, "z", 3, 3072, 32768),
    Case("disk in a mirror", BODY, X, 0.004, "x", 3, 4096, 32768),
    Case("linear grid in a mirror", BODY, X, 0.004, "x", 3, 1024, 32768),
    Case("cubic grid in a mirror", BODY, X, 0.004, "x", 3, 1024, 32768),
    Case("network in a mirror", BODY, Z, 0.004, "z", 3, 128, 512),
    Case("network in a mirror", "body.layer0.weight", at_random, 0.01, "weights", 3, 128, 512),
    Case("network behind glass", BODY, X, 0.004, "x", 4, 224, 2048),
]


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "before", "depth"), [("network in a mirror", "mirror", 3), ("network behind glass", "pane", 4)]
)
def test_the_modes_are_transposes_of_each_other(name: str, before: str, depth: int) -> None:
    scene, params = load(name)
    layers = ["body.layer0.weight", "body.layer0.bias", "body.layer1.weight", "body.layer1.bias"]
    options = {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": 4, "seed": 3}
    assert_transposes(scene, params, [BODY, *layers, f"{before}.vertex_positions"], options)

"""Faces that are parallel to light: neither lit nor dark, they hide it as a whole or not at all."""

import numpy as np
import pytest

from .measure import MODES, Case, assert_agrees, derivatives, differences, rows
from .scenes import box, camera, diffuse, floor, mesh, register
from .test_cameras import parallel
from .test_table import moved

OCCLUDER, LIGHT = "occluder.vertex_positions", "light.position"
SUN = {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": [3.0, 3.0, 3.0]}}


def under_sun(occluder, **options):
    return {"sensor": camera(**options), "floor": floor(), "occluder": occluder, "light": SUN}


def sheet():
    """Upright: it casts no shadow."""
    corners = np.array([[-0.4, 0, 0.3], [0.4, 0, 0.3], [0.4, 0, 0.9], [-0.4, 0, 0.9]])
    material = {"type": "twosided", "bsdf": diffuse(0.3)}
    occluder = mesh(corners, [[0, 1, 2], [0, 2, 3]], material, face_normals=True)
    return under_sun(occluder, origin=(0.0, -1.0, 4.0), target=(0.0, 0.0, 0.0))


def beside_lamp():
    """A lamp in the plane of a side of a box."""
    lamp = {"type": "point", "position": [0.5, 0.1, 3.0], "intensity": {"type": "rgb", "value": [20.0, 20.0, 20.0]}}
    return under_sun(box((0.1, 0.1, 0.9), (0.4, 0.3, 0.2), diffuse(0.3))) | {"light": lamp}


def seen(**view):
    """A parallel camera in the planes of sides of a box, which the light is not in."""
    lamp = {"type": "point", "position": [0.9, -0.6, 3.0], "intensity": {"type": "rgb", "value": [20.0, 20.0, 20.0]}}
    return beside_lamp() | {"sensor": parallel(**view), "light": lamp}


register({
    "box under the sun": lambda: under_sun(box((0.1, 0.1, 0.9), (0.4, 0.3, 0.2), diffuse(0.3))),
    "turned box under the sun": lambda: under_sun(box((0.1, 0.1, 0.9), (0.4, 0.3, 0.2), diffuse(0.3), 0.4)),
    "box on the floor under the sun": lambda: under_sun(box((0.1, 0.1, 0.2), (0.4, 0.3, 0.2), diffuse(0.3))),
    "sheet under the sun": sheet,
    "box beside a lamp": beside_lamp,
    "box seen along its sides": lambda: seen(origin=(0.1, -3.0, 2.5), target=(0.1, 0.0, 0.3), up=(0.3, 0.0, 1.0)),
    "box seen from above": lambda: seen(origin=(0.0, 0.0, 4.0), target=(0.0, 0.0, 0.0), up=(0.3, 1.0, 0.0)),
})  # fmt: skip
ALONG = moved(0.0, 1.0, 0.0)


def turned_sun():
    """A box and the sun along its sides, turned together: what is parallel is so up to roundings."""
    axis = np.array([0.3, -0.7, 0.64])
    axis /= np.linalg.norm(axis)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + np.sin(0.5) * k + (1.0 - np.cos(0.5)) * k @ k
    center = np.array([0.1, 0.1, 0.9])
    occluder = box((0.0, 0.0, 0.0), (0.4, 0.3, 0.2), diffuse(0.3))
    occluder["vertices"] = np.float32(np.float64(occluder["vertices"]) @ turn.T + center)
    return under_sun(occluder) | {"light": SUN | {"direction": (turn @ [0.0, 0.0, -1.0]).tolist()}}


register({"box and sun, turned": turned_sun})
CASES = [
    Case("box under the sun", OCCLUDER, ALONG, 0.02, "along y"),
    Case("box under the sun", OCCLUDER, moved(1.0, 0.0, 0.0), 0.02, "along x"),
    Case("turned box under the sun", OCCLUDER, moved(1.0, 0.4, 0.0), 0.02, "slides"),
    Case("box and sun, turned", OCCLUDER, moved(1.0, 0.4, 0.0), 0.02, "slides"),
    Case("box on the floor under the sun", OCCLUDER, moved(1.0, 0.4, 0.0), 0.005, "slides", difference_spp=4096),
    Case("sheet under the sun", OCCLUDER, ALONG, 0.005, "slides", difference_spp=4096),
    Case("box beside a lamp", OCCLUDER, moved(0.0, 0.0, 1.0), 0.01, "rises"),
    Case("box beside a lamp", (OCCLUDER, LIGHT), moved(1.0, 0.0, 0.0), 0.02, "both slide"),
    Case("box seen along its sides", OCCLUDER, moved(1.0, 0.4, 0.0), 0.005, "slides", difference_spp=4096),
    Case("box seen from above", OCCLUDER, moved(1.0, 0.4, 0.0), 0.005, "slides", difference_spp=4096),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_agree_with_differences(case, mode) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])

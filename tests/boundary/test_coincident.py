"""Silhouettes one behind the other: as a light of no area or an orthographic camera sees them, they coincide."""

import numpy as np
import pytest

from .measure import MODES, Case, assert_agrees, derivatives, differences, rows
from .scenes import SIZE, T, ball, box, camera, diffuse, floor, mesh, panel, register
from .test_table import moved

FACES = [[0, 1, 2], [0, 2, 3]]
RED, BLUE = diffuse(0.8, 0.3, 0.2), diffuse(0.2, 0.4, 0.8)
EYE = (0.3, -3.0, 2.5)
VIEW, LOW_VIEW = camera(EYE, (0.0, 0.2, 0.2)), camera((0.3, -3.0, 1.6), (0.0, 0.0, 0.3))


def sun(direction=(0, 0, -1)):
    return {"type": "directional", "direction": list(direction), "irradiance": {"type": "rgb", "value": [3.0] * 3}}


def flash():
    return {"type": "point", "position": list(EYE), "intensity": {"type": "rgb", "value": [20.0] * 3}}


def above(origin=(0.0, 0.0, 4.0)):
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE}
    pose = T.look_at(list(origin), [0, 0, 0], [0, 1, 0]) @ T.scale([1.5, 1.5, 1])
    return {"type": "orthographic", "to_world": pose, "film": film}


def sheet(z, bsdf, scale=1.0, slide=(0.0, 0.0)):
    corners = scale * np.array([[-0.5, -0.4], [0.6, -0.4], [0.6, 0.5], [-0.5, 0.5]]) + slide
    return mesh(np.insert(corners, 2, z, axis=1), FACES, bsdf)


def sheets(sensor, light):
    """Three equal sheets one above the other."""
    shapes = {"first": sheet(0.4, RED), "second": sheet(0.65, BLUE), "third": sheet(0.9, RED)}
    return {"sensor": sensor, "floor": floor(), "light": light, **shapes}


def aslant():
    """Equal sheets whose edges lie behind each other in slanting light."""
    shapes = {f"sheet{k}": sheet(z, RED, slide=(0.4 * z, 0.2 * z)) for k, z in enumerate((0.4, 0.8))}
    return {"sensor": LOW_VIEW, "floor": floor(), "light": sun((-0.4, -0.2, -1.0)), **shapes}


def below_a_lamp():
    """Sheets as large as each other as a point light sees them."""
    light = {"type": "point", "position": [0.0, 0.0, 3.0], "intensity": {"type": "rgb", "value": [20.0] * 3}}
    shapes = {"first": sheet(0.4, RED), "second": sheet(0.8, BLUE, 2.2 / 2.6)}
    return {"sensor": LOW_VIEW, "floor": floor(), "light": light, **shapes}


def room():
    """A floor and a sheet above it, in one mesh, and an equal sheet."""
    lower = sheet(0.4, RED)
    ground = [[-3.0, -3.0, 0.0], [3.0, -3.0, 0.0], [3.0, 3.0, 0.0], [-3.0, 3.0, 0.0]]
    faces = [*FACES, *(4 + np.array(FACES)).tolist()]
    one = mesh([*ground, *lower["vertices"]], faces, diffuse(0.7, 0.6, 0.5))
    return {"sensor": LOW_VIEW, "first": one, "second": sheet(0.8, BLUE), "light": sun()}


def boxes():
    """Two equal boxes one above the other under a vertical sun."""
    half = (0.6, 0.5, 0.05)
    shapes = {"first": box((0.1, 0.05, 0.4), half, RED), "second": box((0.1, 0.05, 0.9), half, BLUE)}
    return {"sensor": LOW_VIEW, "floor": floor(), "light": sun(), **shapes}


def table(sensor, light):
    """The boxes in one mesh, and in one paint, as they come from a modelling program."""
    half = (0.6, 0.5, 0.05)
    parts = [box((0.1, 0.05, z), half, RED) for z in (0.4, 0.9)]
    faces = np.concatenate([parts[0]["faces"], parts[1]["faces"] + len(parts[0]["vertices"])])
    one = mesh(np.concatenate([p["vertices"] for p in parts]), faces, RED, face_normals=True)
    return over(one, sensor, light)


def lamp_by_the_camera():
    """Beside each silhouette a shadow is seen, ten times as wide as rays pass edges."""
    position = [EYE[0] + 5.0e-4, *EYE[1:]]
    return over(turned(), VIEW, {**flash(), "position": position})


def over(shape, sensor, light):
    return {"sensor": sensor, "floor": floor(), "first": shape, "light": light}


def turned():
    return box((0.1, 0.05, 0.8), (0.5, 0.4, 0.2), RED, 0.3)


register(
    {
        "sheets in the sun": lambda: sheets(LOW_VIEW, sun()),
        "sheets from above": lambda: sheets(above(), panel((0.8, -0.6, 3.5), 0.5)),
        "boxes in the sun": boxes,
        "table in the sun": lambda: table(LOW_VIEW, sun()),
        "table from above": lambda: table(above(), panel((0.8, -0.6, 3.5), 0.5)),
        "sheets aslant": aslant,
        "sheets below a lamp": below_a_lamp,
        "sheet in a room": room,
        "flash": lambda: over(turned(), VIEW, flash()),
        "lamp by the camera": lamp_by_the_camera,
        "flash on a ball": lambda: over(ball((0.1, 0.05, 0.8), 0.5, RED, 3), VIEW, flash()),
        "sun from behind": lambda: over(turned(), above((0.5, -1.0, 4.0)), sun((-0.5, 1.0, -4.0))),
    }
)
ONE = "first.vertex_positions"
TWO = (ONE, "second.vertex_positions")
ALL = (*TWO, "third.vertex_positions")
SLIDE, MOVE = moved(1.0, 0.3, 0.0), moved(1.0, 0.3, 0.2)


def slide_all(values):
    """Positions of vertices, or of a light."""
    return np.broadcast_to((1.0, 0.3, 0.0), values.shape)


def all_but_the_floor(positions):
    """The last four vertices slide."""
    tangent = np.zeros_like(positions)
    tangent[-4:] = (1.0, 0.3, 0.0)
    return tangent


CASES = [
    Case("sheets in the sun", ALL, SLIDE, 0.01, "all slide", 2, 512, 1024, slow=False),
    Case("sheets in the sun", ALL, SLIDE, 0.01, "all slide", 3, 512, 1024),
    Case("sheets from above", ALL, SLIDE, 0.01, "all slide", 2, 1024, 2048),
    Case("boxes in the sun", TWO, SLIDE, 0.01, "both slide", 2, 512, 1024),
    Case("table in the sun", ONE, SLIDE, 0.01, "slides", 2, 512, 1024),
    Case("table from above", ONE, SLIDE, 0.01, "slides", 2, 1024, 2048),
    Case("sheets aslant", ("sheet0.vertex_positions", "sheet1.vertex_positions"), SLIDE, 0.01, "slide", 2, 512, 1024),
    Case("sheets below a lamp", (*TWO, "light.position"), slide_all, 0.01, "all slide", 2, 512, 1024),
    Case("sheet in a room", TWO, all_but_the_floor, 0.01, "sheets slide", 2, 512, 1024),
    Case("flash", ONE, MOVE, 0.01, "moves", 2, 512, 1024),
    Case("flash", ONE, MOVE, 0.01, "moves", 3, 2048, 4096),
    Case("lamp by the camera", ONE, MOVE, 0.01, "moves", 2, 512, 1024),
    Case("flash on a ball", ONE, MOVE, 0.01, "moves", 2, 512, 1024),
    Case("sun from behind", ONE, MOVE, 0.01, "moves", 2, 512, 1024),
]


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_agree_with_differences(case, mode) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])

"""Interior derivatives by what moves curves, and beside them, against finite differences where all is seen."""

import numpy as np
import pytest

import warp_psdr as psdr

from .test_sdfgrid import assert_slope, entry

T = psdr.Transform
#: Along x: texture coordinates count angles from z, and jump between segments that do not lie in a plane across it.
POINTS = np.array([[0.4 * (k - 3.0), 0.25 * (k - 3.0) ** 2 / 9.0, 0.0, 0.5 - 0.03 * k] for k in range(7)])


def room(plugin: str) -> psdr.Scene:
    """A lit tube in a closed room, which bulges towards the camera and fills its film."""
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    view = T.look_at([0.1, -1.6, 0.1], [0.0, 0.0, 0.05], [0, 0, 1])
    stripes = np.random.default_rng(2).uniform(0.2, 0.9, (8, 4, 3))
    texture = {"type": "bitmap", "bitmap": stripes.astype(np.float32), "raw": True, "filter_type": "bilinear"}
    tube = {"type": plugin, "control_points": POINTS, "bsdf": {"type": "diffuse", "reflectance": texture}}
    return psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 18.0, "near_clip": 0.01, "to_world": view, "film": film},
            "light": {"type": "point", "position": [0.2, -1.7, 0.3], "intensity": 4.0},
            "room": {"type": "cube", "to_world": T.scale(2.0), "flip_normals": True, "bsdf": {"type": "diffuse"}},
            "tube": tube,
        }
    )


def swell() -> np.ndarray:
    """Each control point moves in its way, and its radius changes."""
    k = np.arange(len(POINTS))[:, None]
    return np.hstack([0.2 * np.sin(3.0 * k), 0.4 * np.cos(2.0 * k), 0.0 * k + 0.5, 0.3 * np.cos(k)]).ravel()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plugin", "name", "tangent", "step"),
    [
        pytest.param("bsplinecurve", "tube.control_points", swell(), 0.004, marks=pytest.mark.slow),
        pytest.param("bsplinecurve", "tube.to_world", entry(1, 0) + entry(2, 1), 0.01, marks=pytest.mark.slow),
        pytest.param("bsplinecurve", "tube.to_world", entry(1, 3), 0.01, marks=pytest.mark.slow),
        pytest.param("bsplinecurve", "room.to_world", entry(1, 3), 0.01, marks=pytest.mark.slow),
        pytest.param("bsplinecurve", "light.position", np.array([1.0, 1.0, 0.0]), 0.01, marks=pytest.mark.slow),
        pytest.param("bsplinecurve", "sensor.to_world", entry(0, 3), 0.005, marks=pytest.mark.slow),
        pytest.param("linearcurve", "tube.control_points", swell(), 0.004, marks=pytest.mark.slow),
        pytest.param("linearcurve", "tube.to_world", entry(1, 3), 0.01, marks=pytest.mark.slow),
    ],
)
def test_slope_of_what_moves(plugin: str, name: str, tangent: np.ndarray, step: float) -> None:
    assert_slope(room(plugin), name, tangent, step)

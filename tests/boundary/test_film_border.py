"""Shapes, shadows and mirrors that cross the border of the film, under filters that it cuts: rows of the table."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .mirrors import LAMP, WALL, behind
from .scenes import camera, load, panel, register, silhouette, under
from .test_table import ALONG, OCCLUDER, SHAPE, moved, scaled, turned

POSE = "sensor.to_world"


def near(border, **view):
    """A camera whose filter, three pixels in each direction, reaches beyond the film from most of its pixels."""
    sensor = camera(**view)
    window = {"width": 12, "height": 10, "crop_offset_x": 2, "crop_offset_y": 1, "crop_width": 9, "crop_height": 8}
    film = {**window, "rfilter": {"type": "gaussian", "stddev": 0.75}, "sample_border": border}
    return {**sensor, "film": sensor["film"] | film}


SIDE = {"origin": (0, -4, 0.5), "target": (0.4, 0, 0.4), "fov": 17.0}
ABOVE = {"target": (0.3, 0.2, 0.5), "fov": 14.0}
MIRRORED = {"origin": (0.3, -2.0, 0.6), "target": (0.0, 1.2, 0.8), "fov": 22.0}
register(
    {
        "border": lambda: silhouette("tent") | {"sensor": near(False, **SIDE)},
        "sampled border": lambda: silhouette("tent") | {"sensor": near(True, **SIDE)},
        "border, smooth": lambda: silhouette("tent", smooth=True) | {"sensor": near(False, **SIDE)},
        "border, soft": lambda: under(panel((0.5, -0.3, 2.2), 0.35)) | {"sensor": near(False, **ABOVE)},
        "border, mirror": lambda: behind() | {"sensor": near(False, **MIRRORED)},
        "sampled border, mirror": lambda: behind() | {"sensor": near(True, **MIRRORED)},
    }
)

CASES = [
    Case("border", SHAPE, ALONG, 0.005, "moves"),
    Case("border", "sensor.x_fov", np.ones_like, 0.1, "camera zooms", spp=1024, difference_spp=8192),
    Case("sampled border", SHAPE, ALONG, 0.005, "moves", spp=1024, difference_spp=4096),
    Case("border, smooth", SHAPE, scaled, 0.01, "scales", spp=2048, difference_spp=4096),
    Case("border, soft", OCCLUDER, ALONG, 0.005, "occluder moves", difference_spp=2048),
    Case("border, soft", POSE, moved(1.0, 0.3, 0.4), 0.005, "camera moves", difference_spp=2048),
    Case("border, mirror", LAMP, ALONG, 0.01, "lamp moves", spp=2048, difference_spp=8192),
    Case("border, mirror", WALL, turned(2), 0.001, "mirror turns", spp=1024, difference_spp=4096),
    Case("sampled border, mirror", LAMP, ALONG, 0.01, "lamp moves", spp=2048, difference_spp=8192),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [psdr.boundary.EdgeSampling(), psdr.boundary.Projective()], ids=["edges", "projective"]
)
def test_other_methods_end_filters_there_too(method) -> None:
    case = next(c for c in CASES if str(c).startswith("border, soft, occluder"))
    assert_agrees(derivatives(case, "forward", method), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "names"), [("border, soft", [OCCLUDER, POSE]), ("border, mirror", [LAMP, WALL, POSE])]
)
def test_the_modes_are_transposes_of_each_other(name, names) -> None:
    scene, params = load(name)
    assert_transposes(scene, params, names, {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 16, "seed": 3})

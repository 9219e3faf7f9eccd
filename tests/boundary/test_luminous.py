"""Surfaces that touch lights, and rooms whose walls all glow: what a light scatters, beside what it emits."""

from dataclasses import replace

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import Case, assert_agrees, derivatives, differences, rows, slope
from .scenes import box, camera, diffuse, mesh, register
from .test_table import moved

ALBEDO = 0.9


def shining(value):
    return {"type": "area", "radiance": {"type": "rgb", "value": [value, 0.9 * value, 0.8 * value]}}


def table():
    """A box that stands on a luminous table; the camera sees what the two throw on a ceiling."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    return {
        "sensor": camera((0.0, -3.5, -0.6), (0.0, 0.0, 1.2)),
        "table": mesh(square, [[0, 1, 2], [0, 2, 3]], diffuse(0.5), emitter=shining(1.0)),
        "ceiling": mesh(square + np.float32([0, 0, 1.2]), [[0, 2, 1], [0, 3, 2]], diffuse(0.8)),
        "box": box((0.3, 0.0, 0.25), (0.3, 0.25, 0.25), diffuse(0.2), 0.3),
    }


def furnace():
    """A black box in a room whose walls all glow and reflect."""
    room = box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), diffuse(ALBEDO))
    room["faces"] = room["faces"][:, ::-1].copy()
    return {
        "sensor": camera((0.0, -0.95, 0.0), (0.0, 1.0, -0.2), fov=70.0),
        "room": room | {"emitter": shining(1.0)},
        "box": box((0.1, 0.1, 0.0), (0.3, 0.25, 0.25), diffuse(0.0), 0.3),
    }


register({"luminous table": table, "furnace": furnace})
BOX = "box.vertex_positions"


def growing(values):
    return values - values.mean(axis=0)


SLIDES = Case("luminous table", BOX, moved(1.0, 0.4, 0.0), 0.02, "a box on it slides", 3, 4096, 16384)
CASES = [
    SLIDES,
    replace(SLIDES, depth=-1, spp=8192),
    Case("furnace", BOX, growing, 0.02, "a black box grows", -1, 1024, 4096),
]
METHODS = {
    "KdTree": psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree()),
    "Projective": psdr.boundary.Projective(),
    "EdgeSampling": psdr.boundary.EdgeSampling(),
}


@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_agree_with_differences(case, mode) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
@pytest.mark.parametrize("case", CASES, ids=str)
def test_all_methods_agree_with_differences(case, method) -> None:
    assert_agrees(derivatives(case, "forward", method), differences(case)[2])


def test_what_a_light_throws_past_an_edge_that_touches_it_counts() -> None:
    """The same in a tenth of the time: without what the light itself sends past the contact, the slope is -0.2."""
    case = replace(SLIDES, spp=256, difference_spp=1024)
    value, error = slope(derivatives(case, "reverse"), differences(case)[2])
    assert error < 0.05
    assert abs(value - 1.0) < 4.0 * error

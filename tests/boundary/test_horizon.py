"""Interpolated normals on coarse meshes: a vertex's own triangle hides light that its normal would let in."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.estimate.boundary import terms

from .measure import MODES, Case, assert_agrees, derivatives, differences, rows, slope
from .mirrors import wall
from .scenes import ball, camera, diffuse, floor, mesh, register
from .test_table import moved, turned

PAINT = diffuse(0.9, 0.8, 0.7)


def beside(subdivisions, half, bsdf=None, center=(2.0, 0.5, 0.2), **more):
    """A coarse smooth ball, lit from the side by a square that stands beyond the horizon of many triangles."""
    corners = half * np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]], float) + center
    light = mesh(
        corners,
        [[0, 2, 1], [0, 3, 2]],
        diffuse(0.0),
        emitter={"type": "area", "radiance": {"type": "rgb", "value": [10.0, 9.0, 8.0]}},
    )
    return {
        "sensor": camera((0.0, -4.0, 0.5), (0.0, 0.0, 0.0), fov=25.0),
        "shape": ball((0.0, 0.0, 0.0), 0.7, bsdf or PAINT, subdivisions, smooth=True),
        "light": light,
        **more,
    }


def mirrored(subdivisions, half, center):
    """The same, before a camera that looks into a mirror."""
    found = beside(subdivisions, half, center=center)
    found["shape"] = ball((-1.0, -0.6, -0.2), 0.8, PAINT, subdivisions, smooth=True)
    return {**found, "mirror": wall(0.0, 2.0, 1.5), "sensor": camera((0.6, 0.9, 0.3), (-0.2, 2.0, 0.0), fov=45.0)}


register(
    {
        "coarse ball in a mirror": lambda: mirrored(1, 1.0, (0.9, 0.0, 0.2)),
        "icosahedron in a mirror": lambda: mirrored(0, 0.5, (1.0, 0.0, 0.2)),
        "icosahedron": lambda: beside(0, 0.5, center=(2.5, 0.3, 0.2)),
        "coarse ball": lambda: beside(1, 1.0),
        "coarse metal": lambda: beside(1, 1.0, {"type": "roughconductor", "alpha": 0.4}),
        "two-sided ball": lambda: beside(1, 1.0, {"type": "twosided", "bsdf": PAINT}),
        "ball and floor": lambda: beside(1, 1.0, floor=floor(-0.7)),
    }
)

SHAPE, LIGHT = "shape.vertex_positions", "light.vertex_positions"
ALONG_Y = moved(0.0, 1.0, 0.0)
MANY = {"spp": 1024, "difference_spp": 4096}
CASES = [
    # The light alone moves: horizons do, creases rest.
    Case("coarse ball", LIGHT, ALONG_Y, 0.01, "light moves", spp=1024, difference_spp=2048),
    Case("coarse metal", LIGHT, ALONG_Y, 0.01, "light moves", spp=2048, difference_spp=16384),
    Case("two-sided ball", LIGHT, ALONG_Y, 0.01, "light moves", **MANY),
    Case("ball and floor", LIGHT, ALONG_Y, 0.01, "light moves", depth=3, **MANY),
    # Creases move over the film.
    Case("icosahedron", SHAPE, turned(2), 0.006, "turns", spp=512, difference_spp=3072, slow=False),
    Case("icosahedron", "sensor.to_world", moved(1.0, 0.3, 0.2), 0.01, "camera moves", **MANY),
    # Both as a mirror shows them.
    Case("coarse ball in a mirror", LIGHT, ALONG_Y, 0.01, "light moves", 3, 1024, 2048),
    Case("icosahedron in a mirror", SHAPE, turned(2), 0.012, "turns", 3, 8192, 12288),
]


@pytest.mark.slow_rows("icosahedron, turns, depth 2-forward")
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "left_out"),
    [(CASES[0], "geometric_horizon"), (CASES[4], "creases")],
    ids=["geometric_horizon", "creases"],
)
def test_the_table_can_tell_a_missing_term(case: Case, left_out, monkeypatch) -> None:
    rest = tuple(t for t in terms.TERMS[psdr.boundary.PathSpace] if t.name != left_out)
    monkeypatch.setitem(terms.TERMS, psdr.boundary.PathSpace, rest)
    value, error = slope(derivatives(case, "forward"), differences(case)[2])
    assert abs(value - 1.0) > 0.04 + 3.0 * error

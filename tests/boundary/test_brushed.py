"""Brushed surfaces: where dp/du turns from one triangle to the next, so does the highlight."""

import numpy as np
import pytest

from .measure import MODES, Case, assert_agrees, derivatives, differences, move, rows
from .scenes import camera, load, mesh, panel, register
from .test_table import moved

NAME = "sheet.vertex_positions"
BRUSHED = {"type": "roughconductor", "alpha_u": 0.4, "alpha_v": 0.1, "eta": 0.5, "k": 3.0}
FACES = [[0, 1, 2], [0, 2, 3]]


def lit(sheet):
    view = camera((0.0, -2.5, 3.0), (0.0, 0.0, 0.0), fov=45.0)
    return {"sensor": view, "sheet": sheet, "light": panel((0.8, 0.6, 1.5), 0.5)}


def plain():
    """Without texture coordinates dp/du is the first side of a triangle."""
    return lit(mesh([[-1.5, -1.5, 0], [1.5, -1.5, 0], [1.5, 1.5, 0], [-1.5, 1.5, 0]], FACES, BRUSHED))


def mapped():
    """Texture coordinates that are not an affine function of position."""
    corners = [[-1.5, -1.5, 0], [1.5, -1.0, 0], [1.2, 1.5, 0], [-1.5, 0.3, 0]]
    texcoords = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    return lit(mesh(corners, FACES, BRUSHED, texcoords=texcoords))


register({"brushed": plain, "brushed with texture coordinates": mapped})
SLIDES = moved(1.0, 0.3, 0.0)


def pans(values):
    tangent = np.zeros_like(values)
    tangent[:3, 3] = (1.0, 0.3, 0.0)
    return tangent


CASES = [
    Case("brushed", NAME, SLIDES, 0.02, "slides", spp=1024, difference_spp=2048),
    Case("brushed with texture coordinates", NAME, SLIDES, 0.02, "slides", spp=2048, difference_spp=4096),
    Case("brushed with texture coordinates", "sensor.to_world", pans, 0.02, "seen in passing", spp=1024,
         difference_spp=2048),
]  # fmt: skip


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_agree_with_differences(case, mode) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


def test_seams_follow_edits_of_texture_coordinates() -> None:
    from warp_psdr.topology.film_edges import film_edges

    scene, params = load("brushed with texture coordinates")
    name = "sheet.vertex_texcoords"
    base = params[name].numpy().copy()

    def count() -> int:
        return len(film_edges(scene, 0, {0, 1}, camera_moves=True).others.keep)

    seams = count()
    try:
        flat = params[NAME].numpy()[:, :2].copy()  # an affine function of position
        move(params, {name: flat})
        assert count() == seams - 1
    finally:
        move(params, {name: base})
    assert count() == seams

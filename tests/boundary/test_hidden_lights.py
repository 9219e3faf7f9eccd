"""Lights that the camera does not see: it looks through them, everything else does not."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import ball, camera, diffuse, floor, load, mesh, occluder, panel, register
from .test_table import ALONG, OCCLUDER, PANEL, moved

LAMP = "lamp.vertex_positions"
#: A sheet, and the light that shares an edge with it.
SHEET = ("veil.vertex_positions", "glow.vertex_positions")


def shine(radiance):
    return {"type": "area", "radiance": {"type": "rgb", "value": [radiance, 0.8 * radiance, 0.6 * radiance]}}


def hidden(rfilter="tent", lamp=0.01):
    """A light in front of half of the film, one sunk into the floor, and one that shares an edge with a sheet.

    The last two hardly shine (``lamp``: radiance), for contacts are noisy: they hide the light above from the floor.
    """
    sheet = [[-0.9, 0.3, 0.2], [-0.2, 0.5, 0.3], [-0.3, 0.6, 1.0], [-1.0, 0.4, 0.9]]
    beside = [sheet[3], sheet[2], [-0.3, 0.2, 1.3], [-1.0, 0.0, 1.2]]
    two = [[0, 1, 2], [0, 2, 3]]
    return {
        "sensor": camera(rfilter=rfilter),
        "floor": floor(),
        "occluder": occluder(),
        "light": panel((0.5, -0.3, 2.2), 0.35),
        "curtain": mesh([[0, -2, 1], [2, -2, 1], [2, -1.6, 2.4], [0, -1.6, 2.4]], two, diffuse(0.2), emitter=shine(1)),
        "lamp": ball((0.75, -0.25, -0.05), 0.3, diffuse(0.3), emitter=shine(lamp)),
        "veil": mesh(sheet, two, {"type": "twosided", "bsdf": diffuse(0.5, 0.3, 0.2)}),
        "glow": mesh(beside, two, diffuse(0.0), emitter=shine(lamp)),
    }


register({"unseen": hidden, "unseen box": lambda: hidden("box"), "unseen bright": lambda: hidden(lamp=1.0)})

CASES = [
    Case("unseen", OCCLUDER, ALONG, 0.02, "occluder moves", spp=512, difference_spp=6144, hidden=True),
    Case("unseen box", SHEET, moved(0.6, 0.3, 0.2), 0.03, "sheet moves", spp=512, difference_spp=65536, hidden=True),
    # The floor is dark inside of the lamp.
    Case("unseen", LAMP, moved(0.5, -0.5, 0.3), 0.01, "lamp moves", spp=2048, difference_spp=49152, hidden=True),
    Case("unseen", PANEL, moved(0.5, 0.5, 0.3), 0.02, "light moves", spp=512, difference_spp=8192, hidden=True),
    Case("unseen", "sensor.to_world", ALONG, 0.01, "camera moves", spp=512, difference_spp=8192, hidden=True),
    Case("unseen", OCCLUDER, ALONG, 0.01, "occluder moves", 3, spp=1024, difference_spp=16384, hidden=True),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["EdgeSampling", "Projective"])
def test_other_methods(method: str) -> None:
    case = CASES[0]
    assert_agrees(derivatives(case, "forward", getattr(psdr.boundary, method)()), differences(case)[2])


@pytest.mark.slow
def test_the_modes_are_transposes_of_each_other() -> None:
    """Also where the contact of a light with the floor is seen, through the light."""
    scene, params = load("unseen bright")
    names = [OCCLUDER, LAMP]
    options = {"integrator": CASES[0].integrator(), "spp": 16, "seed": 3}
    assert_transposes(scene, params, names, options)


@pytest.mark.slow
def test_they_have_no_silhouettes() -> None:
    """Of a light that shines on nothing, in front of a black sheet, nothing is seen to move."""
    light = panel((0.0, 0.0, 0.5), 0.4, 2.0)
    light["faces"] = light["faces"][:, ::-1]  # it faces up, towards the camera
    scene = psdr.load_dict({"type": "scene", "sensor": camera(), "floor": floor(bsdf=diffuse(0.0)), "light": light})
    params = psdr.traverse(scene)
    for shown in (True, False):
        integrator = psdr.PathIntegrator(max_depth=2, hide_emitters=not shown)
        image = psdr.render_forward(scene, params, {PANEL: 1.0}, integrator=integrator, spp=16).numpy()
        assert np.any(image) == shown

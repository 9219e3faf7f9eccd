"""Gradient cases beside surfaces that let light pass in smooth lobes: slope of the whole derivative on differences."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import ball, box, camera, diffuse, floor, load, mesh, panel, register, sky
from .test_table import ALONG, moved, scaled

VIEW = camera((0.0, -3.0, 1.6), (0.0, 0.0, 0.5), fov=40.0)
GLASS = {"type": "roughdielectric", "alpha": 0.4, "int_ior": 1.5, "ext_ior": 1.0}
MIRROR = {"type": "conductor", "specular_reflectance": {"type": "rgb", "value": [0.8, 0.8, 0.9]}}
GOLDEN = {"type": "rgb", "value": [0.8, 0.6, 0.4]}
TINTED = {"type": "principled", "base_color": GOLDEN, "roughness": 0.6, "spec_trans": 0.7}
SHEET = {"type": "principledthin", "base_color": GOLDEN, "roughness": 0.6, "spec_trans": 0.5, "diff_trans": 0.8}


def scene(bsdf, light, smooth=False) -> dict:
    behind = box((0.3, 1.0, 0.5), (0.2, 0.2, 0.5), diffuse(0.8, 0.3, 0.2), 0.4)
    glass = ball((0.0, 0.0, 0.6), 0.5, bsdf, smooth=smooth)
    return {"sensor": VIEW, "floor": floor(), "shape": glass, "occluder": behind, **light}


def blade(bsdf) -> dict:
    """A prism, sharp along three edges."""
    outline = np.array([(-0.8, -0.2), (0.8, -0.2), (0.1, 0.4)])
    ends = np.concatenate([np.insert(outline, 1, y, axis=1) for y in (-0.5, 0.5)])
    vertices = ends + np.array([0.0, 0.0, 0.8])
    sides = [(0, 3, 1), (1, 3, 4), (1, 4, 2), (2, 4, 5), (2, 5, 0), (0, 5, 3)]
    return mesh(vertices, [(0, 1, 2), (5, 4, 3), *sides], bsdf, face_normals=True)


DIFFUSE_SHEET = {**SHEET, "roughness": 1.0, "spec_trans": 0.0, "diff_trans": 1.2}
LAMP = {"light": panel((0.8, 0.4, 2.5), 1.5, 2.0)}
register(
    {
        "rough glass, sky": lambda: scene(GLASS, {"sky": sky()}),
        "rough glass, lamp": lambda: scene(GLASS, LAMP),
        "smooth rough glass, lamp": lambda: scene(GLASS, LAMP, smooth=True),
        "smooth rough glass, sky": lambda: scene(GLASS, {"sky": sky()}, smooth=True),
        "rough glass, mirror": lambda: scene(GLASS, {"sky": sky(), "floor": floor(bsdf=MIRROR)}),
        "tinted, lamp": lambda: scene(TINTED, LAMP),
        "sheet, lamp": lambda: scene(SHEET, LAMP),
        "blade, sky": lambda: {"sensor": VIEW, "shape": blade(DIFFUSE_SHEET), "sky": sky()},
    }
)
SHAPE, OCCLUDER, PANEL = "shape.vertex_positions", "occluder.vertex_positions", "light.vertex_positions"
#: Deeper, rare paths through the glass carry much of the variance, and rows tell 2 % in five minutes no more.
DEEP = {"depth": 3, "spp": 1024, "difference_spp": 8192}
CASES = [
    Case("rough glass, lamp", SHAPE, scaled, 0.02, "scales", depth=3, spp=512, difference_spp=4096),
    Case("blade, sky", SHAPE, scaled, 0.02, "grows, next to whose edges light is met behind", difference_spp=8192),
    Case("rough glass, sky", SHAPE, ALONG, 0.01, "moves", **DEEP),
    Case("rough glass, sky", OCCLUDER, ALONG, 0.01, "what is seen through it moves", **DEEP),
    Case("rough glass, lamp", SHAPE, ALONG, 0.01, "moves", **DEEP),
    Case("rough glass, lamp", PANEL, ALONG, 0.02, "light moves", **DEEP),
    Case("rough glass, lamp", "floor.to_world", moved(0.0, 0.0, 1.0), 0.02, "floor rises", **DEEP),
    Case("tinted, lamp", SHAPE, ALONG, 0.01, "moves", **DEEP),
    Case("sheet, lamp", SHAPE, ALONG, 0.01, "moves", **DEEP),
    Case("smooth rough glass, sky", SHAPE, ALONG, 0.01, "moves", **DEEP),
    Case("smooth rough glass, lamp", SHAPE, scaled, 0.02, "scales", **DEEP),
    Case("rough glass, mirror", SHAPE, ALONG, 0.01, "moves over a mirror", **DEEP),
]


@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case) -> None:
    assert_agrees(derivatives(case, "forward"), differences(case)[2])


@pytest.mark.slow
def test_the_modes_are_transposes() -> None:
    scene, params = load("smooth rough glass, lamp")
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 32, "seed": 1}
    assert_transposes(scene, params, [SHAPE, PANEL], options)

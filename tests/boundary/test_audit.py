"""Edges of lights, seams of materials and textures: rows of the table for single cases."""

import numpy as np
import pytest

from .measure import Case, assert_agrees, derivatives, differences, rows
from .scenes import box, camera, diffuse, floor, mesh, panel, register, sky
from .test_table import moved, scaled

QUAD = [[0, 1, 2], [0, 2, 3]]


def corners(half, z=0.0):
    return np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]], np.float32)


def bitmap(**more):
    """Two by two colours, far from each other."""
    values = np.array([[[1.0, 0.2, 0.1], [0.1, 0.9, 0.2]], [[0.2, 0.1, 1.0], [0.9, 0.8, 0.1]]], np.float32)
    return {"type": "bitmap", "bitmap": values, "wrap_mode": "clamp", "raw": True, **more}


def textured_light():
    """A textured light that faces the camera, above a floor that it lights; it hides a part of another light's sky."""
    light = mesh(
        corners(0.6) @ np.array([[1, 0, 0], [0, 0.5, 0.8], [0, 0, 1]], np.float32) + [0.1, 0.3, 1.0], QUAD, diffuse(0.1)
    )
    light |= {
        "texcoords": np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32),
        "emitter": {"type": "area", "radiance": bitmap()},
        "faces": np.array([[0, 2, 1], [0, 3, 2]], np.int32),
    }
    return {"sensor": camera(), "floor": floor(), "light": light, "sky": sky(0.3)}


def one_sided():
    """A light seen from its dark side, and from below by the floor."""
    return {"sensor": camera((0, -2.5, 3.5), (0, 0, 0.2)), "floor": floor(), "light": panel((0.1, 0.1, 0.8), 0.5, 4.0)}


def seams():
    """A box with face colours."""
    shape = box((0.1, 0.0, 0.1), (0.6, 0.5, 0.4), None, 0.4)
    colors = np.random.default_rng(4).uniform(0.05, 0.95, (12, 3)).astype(np.float32)
    shape |= {
        "face_color": colors,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "face_color"}},
    }
    return {"sensor": camera((0, -4, 1.5), (0, 0, 0)), "sky": sky(), "shape": shape}


def uv_seam():
    """A smooth tent whose two halves show the two ends of a bitmap where they meet."""
    x = np.array([-0.8, 0.0, 0.0, 0.8])
    vertices = np.concatenate([np.stack([x, np.full(4, y), 0.4 - np.abs(x)], axis=1) for y in (-0.8, 0.8)])
    normals = np.tile([[-0.5, 0, 1], [0, 0, 1], [0, 0, 1], [0.5, 0, 1]], (2, 1))
    uv = np.array([[u, v] for v in (0.2, 0.8) for u in (0.5, 1.0, 0.0, 0.5)], np.float32)
    shape = mesh(vertices, [[0, 1, 5], [0, 5, 4], [2, 3, 7], [2, 7, 6]], {"type": "diffuse", "reflectance": bitmap()})
    shape |= {"normals": normals.astype(np.float32), "texcoords": uv}
    return {"sensor": camera(), "sky": sky(), "shape": shape}


register(
    {
        "textured light": textured_light,
        "one-sided light": one_sided,
        "seams": seams,
        "uv seam": uv_seam,
    }
)
LIGHT, SHAPE = "light.vertex_positions", "shape.vertex_positions"
ALONG = moved(1.0, 0.3, 0.4)
CASES = [
    Case("textured light", LIGHT, ALONG, 0.01, "moves", spp=512, difference_spp=4096),
    Case("textured light", LIGHT, scaled, 0.01, "scales", spp=512, difference_spp=4096),
    Case("one-sided light", LIGHT, ALONG, 0.01, "moves", difference_spp=2048),
    Case("seams", SHAPE, ALONG, 0.01, "moves", difference_spp=2048),
    Case("uv seam", SHAPE, ALONG, 0.01, "moves", difference_spp=2048),
]


@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])

"""Interpolated normals in less common places: on mirrors and glass, and turned over."""

import pytest

import warp_psdr as psdr

from .measure import MODES, Case, assert_agrees, derivatives, differences, rows
from .scenes import T, ball, camera, diffuse, floor, panel, register, sky
from .test_table import moved

VIEW = camera((0.2, -3.2, 2.0), (-0.1, 0.0, 0.4), fov=35.0)
GRAY = {"type": "conductor", "material": "none", "specular_reflectance": {"type": "rgb", "value": [0.5] * 3}}
TWO_SIDED = {"type": "twosided", "bsdf": diffuse(0.8, 0.5, 0.3)}
CENTER, RADIUS = (-0.2, 0.1, 0.6), 0.4


def mirror_ball():
    return {"sensor": VIEW, "sky": sky(), "ball": ball(CENTER, RADIUS, GRAY, 1, smooth=True)}


def mirror_sphere(resolution, **more):
    shape = {"type": "sphere", "center": list(CENTER), "radius": RADIUS, "bsdf": GRAY, "resolution": resolution}
    return {"sensor": VIEW, "sky": sky(), "ball": shape, **more}


def flipped():
    turned = ball(CENTER, RADIUS, TWO_SIDED, 1, smooth=True, flip_normals=True)
    return {"sensor": VIEW, "floor": floor(), "ball": turned, "light": panel((0.3, -0.5, 2.6), 0.4)}


def mirrored():
    pose = T.translate(list(CENTER)) @ T.scale([-RADIUS, RADIUS, RADIUS])
    shape = {"type": "sphere", "to_world": pose, "bsdf": TWO_SIDED, "resolution": 16}
    return {"sensor": VIEW, "floor": floor(), "ball": shape, "light": panel((0.3, -0.5, 2.6), 0.4)}


register(
    {
        "gray ball": mirror_ball,
        "gray sphere": lambda: mirror_sphere(24, floor=floor(half=0.8)),
        "fine gray sphere": lambda: mirror_sphere(256),
        "gray sphere with faces seen edge-on": lambda: mirror_sphere(128),
        "flipped ball": flipped,
        "mirrored sphere": mirrored,
    }
)
VERTICES, POSE = "ball.vertex_positions", "ball.to_world"


def slides(pose):
    """Along the world's axes."""
    r = 0.0 * pose
    r[:3, 3] = (1.0, 0.3, 0.4)
    return r


MOVES = moved(1.0, 0.3, 0.4)
CASES = [
    Case("gray ball", VERTICES, MOVES, 0.004, "moves", 2, 1024, 4096),
    Case("gray ball", "sensor.to_world", slides, 0.004, "camera moves", 2, 1024, 4096),
    Case("gray sphere", POSE, slides, 0.004, "moves", 2, 2048, 8192),
    Case("gray sphere", POSE, slides, 0.004, "moves", 4, 2048, 8192),
    Case("fine gray sphere", POSE, slides, 0.004, "moves", 2, 2048, 4096),
    Case("gray sphere with faces seen edge-on", POSE, slides, 0.002, "moves", 2, 2048, 8192),
    Case("flipped ball", VERTICES, MOVES, 0.005, "moves", 2, 512, 1024),
    Case("flipped ball", VERTICES, MOVES, 0.005, "moves", 3, 1024, 2048),
    Case("mirrored sphere", POSE, slides, 0.005, "moves", 2, 1024, 2048),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_agree_with_differences(case, mode) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
def test_edge_sampling_of_what_is_turned_over() -> None:
    case = next(c for c in CASES if c.scene == "flipped ball")
    assert_agrees(derivatives(case, "reverse", psdr.boundary.EdgeSampling()), differences(case)[2])

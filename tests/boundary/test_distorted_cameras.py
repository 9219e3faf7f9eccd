"""The boundary term seen through lenses with distortion: edges are curves on the film, and move with coefficients."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import (
    MODES,
    Case,
    assert_agrees,
    assert_needs_boundary,
    assert_transposes,
    derivatives,
    differences,
    rows,
)
from .mirrors import ETA, GLASSES, LAMP, WALL, behind, glass, slab
from .scenes import camera, load, panel, register, room, silhouette, sky, under
from .test_cameras import ACROSS, FILM, FRONT, LIGHT, MIRRORED, POSE, RADIUS, THROUGH, lens
from .test_table import ALONG, BOX, FLOOR, OCCLUDER, RECEIVER, SHAPE, moved, scaled, turned

OPENCV = {"k1": -0.08, "k2": 0.05, "p1": 0.02, "p2": -0.015, "k3": 0.01, "k4": 0.02, "k5": 0.01, "k6": -0.01}
FISHEYE = {"distortion": "fisheye", "k1": 0.1, "k2": -0.03, "k3": 0.01, "k4": 0.004}
NEAR = {"origin": (0, -1.6, 0.4), "target": (0.15, 0, 0.05)}


def bent(sensor, model=OPENCV, fov=70.0):
    """The camera with a lens whose film is sheared, stretched, wider than high and cropped."""
    more = {"fov": fov, "principal_point_offset_x": 0.04, "pixel_aspect": 1.15, "skew": 0.06, **model}
    return {**sensor, "film": sensor["film"] | FILM, **more}


def panned(pose):
    """The camera turns where it is. About the origin it would turn facets of the ball away, within the step."""
    tangent = turned(2)(pose)
    tangent[:3, 3] = 0.0
    return tangent


def exact_ball():
    scene = silhouette("tent")
    bsdf = scene["shape"]["bsdf"]
    return {**scene, "shape": {"type": "sphere", "exact": True, "center": [0.1, 0, 0.1], "radius": 0.8, "bsdf": bsdf}}


register(
    {
        "bent": lambda: under(panel(*LIGHT)) | {"sensor": bent(camera((0.0, -2.2, 2.0)))},
        "bent silhouette": lambda: silhouette("tent") | {"sensor": bent(camera(**NEAR))},
        "bent smooth": lambda: silhouette("tent", smooth=True) | {"sensor": bent(camera(**NEAR))},
        "bent exact": lambda: exact_ball() | {"sensor": bent(camera(**NEAR))},
        "bent lens": lambda: silhouette("tent") | {"sensor": bent(lens(0.3, 2.5, **NEAR))},
        "fisheye": lambda: silhouette("tent") | {"sensor": bent(camera(**NEAR), FISHEYE)},
        "fisheye lens": lambda: silhouette("tent") | {"sensor": bent(lens(0.3, 2.5, **NEAR), FISHEYE)},
        "bent room": lambda: room(0.1) | {"sensor": bent(camera(**FRONT), fov=50.0)},
        "bent mirror": lambda: behind() | {"sensor": bent(camera(**MIRRORED), fov=60.0)},
        "bent glass": lambda: glass(slab()) | {"sensor": bent(camera(**THROUGH), fov=50.0)},
        "bent sky": lambda: {"sensor": bent(camera(**NEAR)), "sky": sky()},
    }
)

#: Steps of the differences: a twentieth of a pixel where the ball's outline is.
STEPS = {"k1": 0.03, "k2": 0.06, "p1": 0.01, "p2": 0.01, "k3": 0.1, "k4": 0.03, "k5": 0.05, "k6": 0.1}
STEPS |= {"pixel_aspect": 0.01, "skew": 0.01, "x_fov": 0.3}
STEPS |= {"principal_point_offset_x": 3e-3, "principal_point_offset_y": 3e-3}
#: Coefficients of high order, which move the outline little.
SMALL = ("k3", "k5", "k6")
OF_FISHEYE = {n: step for n, step in STEPS.items() if n not in ("p1", "p2", "k4", "k5", "k6")}


def numbers(scene: str, steps, spp=512, fast=()) -> list[Case]:
    """A row for each number of the lens; ``steps``: name -> step."""
    return [
        Case(
            scene,
            f"sensor.{name}",
            np.ones_like,
            step,
            f"{name} changes",
            spp=4 * spp if name in SMALL else spp,
            difference_spp=2048 if name in fast else (32 if name in SMALL else 8) * spp,
            slow=name not in fast,
        )
        for name, step in steps.items()
    ]


def some(*names: str) -> dict[str, float]:
    return {name: STEPS[name] for name in names}


CASES = [
    *numbers("bent silhouette", STEPS, fast=("k1", "p2")),
    *numbers("bent lens", {name: STEPS[name] for name in STEPS if name not in SMALL}, spp=4096),
    *numbers("fisheye", OF_FISHEYE, spp=2048),
    Case("fisheye", "sensor.k4", np.ones_like, 0.1, "k4 changes", spp=2048, difference_spp=32768),
    *numbers("fisheye lens", some("k1", "skew"), spp=4096),
    *numbers("bent smooth", some("k1", "pixel_aspect"), spp=1024),
    *numbers("bent exact", some("k1", "p1")),
    *numbers("bent", some("k1", "p1"), spp=4096),
    Case("bent silhouette", SHAPE, ALONG, 0.01, "moves", spp=512, difference_spp=4096),
    Case("bent silhouette", POSE, panned, 0.004, "camera turns", spp=256, difference_spp=1024),
    Case("bent smooth", SHAPE, scaled, 0.01, "scales", spp=2048, difference_spp=4096),
    Case("bent exact", "shape.to_world", ALONG, 0.01, "moves", spp=512, difference_spp=4096),
    Case("bent lens", SHAPE, ALONG, 0.01, "moves out of focus", spp=512, difference_spp=4096),
    Case("bent lens", RADIUS, np.ones_like, 0.03, "aperture opens", spp=1024, difference_spp=8192),
    Case("fisheye", SHAPE, ALONG, 0.01, "moves", spp=512, difference_spp=4096),
    Case("fisheye", POSE, panned, 0.004, "camera turns", spp=256, difference_spp=1024),
    Case("bent", OCCLUDER, ALONG, 0.01, "occluder moves", spp=512, difference_spp=4096),
    Case("bent", FLOOR, moved(0.0, 0.0, 1.0), 0.02, RECEIVER, spp=2048, difference_spp=4096),
    Case("bent", POSE, ALONG, 0.01, "camera moves", spp=512, difference_spp=4096),
    Case("bent room", BOX, ACROSS, 0.005, "a box moves", depth=3, spp=1024, difference_spp=4096),
    Case("bent mirror", LAMP, ALONG, 0.01, "lamp moves", spp=2048, difference_spp=16384),
    Case("bent mirror", WALL, turned(2), 0.002, "mirror turns", spp=1024, difference_spp=8192),
    Case("bent mirror", "sensor.k1", np.ones_like, 0.1, "k1 changes", spp=8192, difference_spp=32768),
    Case("bent glass", GLASSES, turned(2), 0.01, "slab turns", depth=4, spp=2048, difference_spp=16384),
    Case("bent glass", ETA, np.ones_like, 0.02, "index changes", depth=4, spp=1024, difference_spp=8192),
    Case("bent glass", "sensor.k1", np.ones_like, 0.03, "k1 changes", depth=4, spp=1024, difference_spp=8192),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_edge_sampling_takes_these_cameras(mode: str) -> None:
    case = next(c for c in CASES if str(c).startswith("bent, k1 changes"))
    assert_agrees(derivatives(case, mode, psdr.boundary.EdgeSampling(tree=False)), differences(case)[2])


@pytest.mark.parametrize("case", [c for c in CASES if not c.slow], ids=str)
def test_the_rows_can_tell_a_missing_boundary_term(case: Case) -> None:
    assert_needs_boundary(case)


@pytest.mark.parametrize(
    ("name", "names"),
    [
        pytest.param("bent silhouette", [SHAPE, POSE, *(f"sensor.{n}" for n in STEPS)], marks=pytest.mark.slow),
        pytest.param("bent", [OCCLUDER, FLOOR, POSE, "sensor.k1", "sensor.skew"], marks=pytest.mark.slow),
        pytest.param("bent lens", [SHAPE, POSE, RADIUS, *(f"sensor.{n}" for n in STEPS)], marks=pytest.mark.slow),
        pytest.param("bent mirror", [LAMP, WALL, POSE, "sensor.k1", "sensor.p2"], marks=pytest.mark.slow),
        pytest.param("fisheye", [SHAPE, POSE, "sensor.k1", "sensor.k4"], marks=pytest.mark.slow),
    ],
)
def test_the_modes_are_transposes_of_each_other(name, names) -> None:
    scene, params = load(name)
    assert_transposes(scene, params, names, {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 16, "seed": 3})


@pytest.mark.slow
def test_a_coefficient_moves_nothing_where_all_is_alike() -> None:
    scene, params = load("bent sky")
    image = psdr.render_forward(scene, params, {"sensor.k1": 1.0}, spp=16, seed=0).numpy()
    assert np.abs(image).max() == 0.0

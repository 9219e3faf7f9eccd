"""The boundary term seen by an orthographic camera and through a thin lens: the table's rows of these cameras."""

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
from .scenes import T, ball, camera, diffuse, load, panel, register, room, silhouette, sky, under
from .test_table import ALONG, BOX, FLOOR, OCCLUDER, RECEIVER, SHAPE, moved, scaled, turned

POSE, FOCUS, RADIUS = "sensor.to_world", "sensor.focus_distance", "sensor.aperture_radius"
#: Wider than high and cropped, so that nothing can be mistaken for the other axis.
FILM = {"width": 20, "height": 16, "crop_width": 15, "crop_height": 14, "crop_offset_x": 3, "crop_offset_y": 1}


def parallel(scale=(1.6, 1.3, 2.0), **pose):
    """An orthographic camera; ``scale`` stretches its film."""
    sensor = camera(**pose)
    film = sensor["film"] | FILM
    return {"type": "orthographic", "to_world": sensor["to_world"] @ T.scale(list(scale)), "film": film}


def lens(aperture_radius, focus_distance, **pose):
    sensor = camera(**pose)
    more = {"aperture_radius": aperture_radius, "focus_distance": focus_distance, "principal_point_offset_y": 0.03}
    return {**sensor, **more, "type": "thinlens", "film": sensor["film"] | FILM}


SIDE = {"origin": (0, -4, 0.5), "target": (0, 0, 0)}
FRONT = {"origin": (0, -4.0, 1.0), "target": (0, 0, 1.0)}
ACROSS = moved(1.0, -0.5, 0.0)
LIGHT = (0.5, -0.3, 2.2), 0.35
MIRRORED = {"origin": (0.3, -2.0, 0.6), "target": (0.0, 1.2, 0.6)}
THROUGH = {"origin": (0.0, -4.0, 0.4), "target": (0.0, 0.0, 0.0)}
register(
    {
        "parallel": lambda: under(panel(*LIGHT)) | {"sensor": parallel()},
        "parallel silhouette": lambda: silhouette("tent") | {"sensor": parallel((1.2, 1.3, 2.0), **SIDE)},
        "parallel smooth": lambda: silhouette("tent", smooth=True) | {"sensor": parallel((1.2, 1.3, 2.0), **SIDE)},
        # The occluder is some 3.6 away and the floor behind it.
        "lens": lambda: under(panel(*LIGHT)) | {"sensor": lens(0.3, 2.4)},
        "lens silhouette": lambda: silhouette("tent") | {"sensor": lens(0.4, 2.5, **SIDE)},
        "lens smooth": lambda: silhouette("tent", smooth=True) | {"sensor": lens(0.4, 2.5, **SIDE)},
        "parallel room": lambda: room(0.1) | {"sensor": parallel((1.1, 1.2, 1.0), **FRONT)},
        "lens room": lambda: room(0.1) | {"sensor": lens(0.2, 2.5, fov=32.0, **FRONT)},
        # What mirrors and glass show.
        "parallel mirror": lambda: behind() | {"sensor": parallel((1.1, 1.2, 1.0), **MIRRORED)},
        "lens mirror": lambda: behind() | {"sensor": lens(0.2, 5.0, **MIRRORED)},
        "parallel glass": lambda: glass(slab()) | {"sensor": parallel((1.0, 1.1, 1.0), **THROUGH)},
        "lens glass": lambda: glass(slab()) | {"sensor": lens(0.3, 3.0, fov=30.0, **THROUGH)},
        "lens, two depths": lambda: {
            "sensor": lens(0.3, 3.6, origin=(0, -4, 0.5), target=(0, 0, 0)),
            "sky": sky(),
            "shape": ball((-0.3, 1.0, 0.1), 0.6, diffuse(0.3, 0.5, 0.7)),
            "near": ball((0.4, -1.2, 0.1), 0.4, diffuse(0.7, 0.2, 0.1)),
        },
    }
)


def stretched(values):
    """The pose's axes change their lengths and shear."""
    t = np.zeros((4, 4))
    t[:3, :3] = values[:3, :3] @ np.array([[0.3, 0.1, 0.0], [0.0, -0.2, 0.1], [0.1, 0.0, 0.2]])
    return t


CASES = [
    Case("parallel silhouette", SHAPE, ALONG, 0.01, "moves"),
    Case("parallel", OCCLUDER, ALONG, 0.01, "occluder moves", difference_spp=2048),
    Case("parallel", FLOOR, moved(0.0, 0.0, 1.0), 0.02, RECEIVER, spp=2048, difference_spp=4096),
    Case("parallel", POSE, ALONG, 0.01, "camera moves", difference_spp=2048),
    Case("parallel", POSE, turned(0), 0.003, "camera turns", difference_spp=4096),
    Case("parallel", POSE, stretched, 0.03, "camera stretches", spp=1024, difference_spp=4096),
    Case("parallel smooth", SHAPE, scaled, 0.01, "scales", spp=2048, difference_spp=4096),
    Case("parallel smooth", POSE, ALONG, 0.01, "camera moves", spp=1024, difference_spp=4096),
    Case("lens silhouette", SHAPE, ALONG, 0.01, "moves out of focus", spp=512, difference_spp=2048),
    Case("lens", OCCLUDER, ALONG, 0.01, "occluder moves out of focus", spp=512, difference_spp=4096),
    Case("lens", POSE, ALONG, 0.01, "camera moves", difference_spp=4096),
    Case("lens", FOCUS, np.ones_like, 0.1, "focus moves", spp=1024, difference_spp=8192),
    Case("lens", RADIUS, np.ones_like, 0.03, "aperture opens", spp=1024, difference_spp=8192),
    Case("lens silhouette", FOCUS, np.ones_like, 0.1, "focus moves", spp=512, difference_spp=4096),
    Case("lens silhouette", RADIUS, np.ones_like, 0.03, "aperture opens", spp=512, difference_spp=4096),
    Case("lens silhouette", "sensor.x_fov", np.ones_like, 0.2, "camera zooms", difference_spp=4096),
    Case("lens, two depths", SHAPE, ALONG, 0.01, "moves behind what is out of focus", spp=512, difference_spp=8192),
    Case("lens, two depths", POSE, turned(2), 0.004, "camera turns", spp=1024, difference_spp=16384),
    Case("lens smooth", SHAPE, scaled, 0.01, "scales", spp=2048, difference_spp=8192),
    Case("lens smooth", FOCUS, np.ones_like, 0.1, "focus moves", spp=2048, difference_spp=8192),
    Case("parallel mirror", LAMP, ALONG, 0.01, "lamp moves", spp=512, difference_spp=2048),
    Case("parallel mirror", WALL, turned(2), 0.001, "mirror turns", spp=512, difference_spp=2048),
    Case("parallel mirror", POSE, turned(2), 0.001, "camera turns", spp=512, difference_spp=2048),
    Case("lens mirror", LAMP, ALONG, 0.02, "lamp moves", spp=1024, difference_spp=8192),
    Case("lens mirror", WALL, turned(2), 0.002, "mirror turns", spp=1024, difference_spp=8192),
    Case("lens mirror", POSE, turned(2), 0.003, "camera turns", spp=1024, difference_spp=8192),
    Case("lens mirror", FOCUS, np.ones_like, 0.2, "focus moves", spp=4096, difference_spp=32768),
    Case("parallel glass", GLASSES, turned(2), 0.004, "slab turns", depth=4, spp=1024, difference_spp=8192),
    Case("lens glass", GLASSES, turned(2), 0.01, "slab turns", depth=4, spp=4096, difference_spp=32768),
    Case("lens glass", ETA, np.ones_like, 0.02, "index changes", depth=4, spp=1024, difference_spp=8192),
    Case("parallel room", BOX, ACROSS, 0.005, "a box moves", depth=3, spp=1024, difference_spp=4096),
    Case("lens room", BOX, ACROSS, 0.005, "a box moves", depth=3, spp=2048, difference_spp=4096),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("name", ["parallel", "lens"])
def test_edge_sampling_takes_these_cameras(name: str, mode: str) -> None:
    case = next(c for c in CASES if str(c).startswith(f"{name}, camera moves"))
    assert_agrees(derivatives(case, mode, psdr.boundary.EdgeSampling(tree=False)), differences(case)[2])


@pytest.mark.parametrize("case", [c for c in CASES if not c.slow], ids=str)
def test_the_rows_can_tell_a_missing_boundary_term(case: Case) -> None:
    assert_needs_boundary(case)


@pytest.mark.parametrize(
    ("name", "names"),
    [
        pytest.param("parallel", [OCCLUDER, FLOOR, POSE], marks=pytest.mark.slow),
        pytest.param("lens", [OCCLUDER, FLOOR, POSE, FOCUS, RADIUS, "sensor.x_fov"], marks=pytest.mark.slow),
        pytest.param("parallel mirror", [LAMP, WALL, POSE], marks=pytest.mark.slow),
        pytest.param("lens mirror", [LAMP, WALL, POSE, FOCUS, RADIUS, "sensor.x_fov"], marks=pytest.mark.slow),
        pytest.param("lens smooth", [SHAPE, POSE, FOCUS, RADIUS], marks=pytest.mark.slow),
    ],
)
def test_the_modes_are_transposes_of_each_other(name, names) -> None:
    scene, params = load(name)
    assert_transposes(scene, params, names, {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 16, "seed": 3})


@pytest.mark.slow
def test_a_closed_lens_is_a_pinhole() -> None:
    """With an aperture of radius zero every derivative that a pinhole has is the same, bit for bit or nearly so."""
    images = []
    for kind in ("perspective", "thinlens"):
        sensor = camera() | {"type": kind} | ({"aperture_radius": 0.0} if kind == "thinlens" else {})
        scene = psdr.load_dict({"type": "scene", **under(panel(*LIGHT)), "sensor": sensor})
        options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 16, "seed": 3}
        tangents = {OCCLUDER: 1.0, "sensor.x_fov": 1.0}
        images.append(psdr.render_forward(scene, psdr.traverse(scene), tangents, **options).numpy())
    np.testing.assert_allclose(images[1], images[0], rtol=1e-3, atol=1e-3 * np.abs(images[0]).max())

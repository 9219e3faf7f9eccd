"""guiding.Grid and the photon and importon maps that fill it."""

import math
from dataclasses import replace

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr import guiding
from warp_psdr.boundary import PathSpace, Projective
from warp_psdr.estimate.guiding import store
from warp_psdr.estimate.guiding.photons import PhotonMap, importon_map, photon_map
from warp_psdr.plan.plan import plan

from .measure import MODES, Case, assert_agrees, derivatives, differences, rows
from .scenes import T, ball, camera, diffuse, floor, load, panel, sky, spot
from .test_projective import drawn, request
from .test_table import ALONG, BOX, FLOOR, OCCLUDER, RECEIVER, moved

GRID = guiding.Grid(shape=(128, 8, 8))
WHITE = {"type": "twosided", "bsdf": diffuse(1.0)}
#: Relative error of a flux: noise of some thousand light paths, of which a fraction meets the scene.
NOISE = 0.05


def loaded(**objects):
    scene = psdr.load_dict({"type": "scene", "sensor": camera(), **objects})
    config = replace(plan(scene, integrator=psdr.PathIntegrator(max_depth=3)).config, sampler="independent")
    return scene, config


def direction(*d):
    return T.look_at(list(d), [0, 0, 0], [0, 1, 0])


FLUX = {
    "point": ({"type": "point", "position": [0.3, 0, 0], "intensity": {"type": "rgb", "value": 2.0}}, 3 * 8 * math.pi),
    "panel": (panel((0, 0, 0.5), 0.3, 4.0), (1.0 + 0.9 + 0.8) * 4.0 * 0.36 * math.pi),
}


@pytest.mark.slow_rows("point")
@pytest.mark.parametrize("name", FLUX)
def test_photons_carry_the_flux_of_a_light(name) -> None:
    """Inside of a white sphere every light path ends on it and scatters all of its flux."""
    light, flux = FLUX[name]
    scene, config = loaded(shell=ball((0, 0, 0), 2.0, WHITE, 3), light=light)
    found = photon_map(scene, config, 1000, 1, 3)
    assert len(found.points) == 1000
    assert found.weights.sum() == pytest.approx(flux, rel=1e-4)  # absorbs float32
    assert np.abs(np.linalg.norm(found.points, axis=1) - 2.0).max() < 0.05  # a faceted sphere


@pytest.mark.slow
def test_photons_of_a_spot_stay_in_its_cone() -> None:
    light = spot()
    scene, config = loaded(shell=ball((0, 0, 0), 4.0, WHITE, 3), light=light)
    found = photon_map(scene, config, 4000, 1, 3)
    origin = np.array([0.6, -0.4, 3.0])
    axis = np.array([0.1, 0.1, 0.0]) - origin
    cosine = (found.points - origin) @ axis / np.linalg.norm(found.points - origin, axis=1) / np.linalg.norm(axis)
    assert len(found.points) > 100 and cosine.min() > math.cos(math.radians(35.0)) - 1e-3


@pytest.mark.slow_rows("sun")
@pytest.mark.parametrize("name", ["sun", "sky"])
def test_photons_of_light_at_infinity_lie_where_it_falls(name) -> None:
    sun = {"type": "directional", "to_world": direction(0.6, -0.4, 2.0), "irradiance": {"type": "rgb", "value": 3.0}}
    light, irradiance, sides = {
        "sun": (sun, 3.0 * 2.0 / math.sqrt(4.0 + 0.36 + 0.16), 1),
        "sky": (sky(2.0), 2.0 * math.pi, 2),
    }[name]
    scene, config = loaded(floor=floor(0.0, 1.0, WHITE), light=light)
    found = photon_map(scene, config, 40000, 1, 3)
    assert found.weights.sum() == pytest.approx(3 * irradiance * 4.0 * sides, rel=NOISE)
    leaving = found.leaving(np.zeros((1, 3)), 500)
    # Both sides of a thin floor count: it only guides.
    assert leaving[0] == pytest.approx(sides * 3 * irradiance / math.pi, rel=3 * NOISE)


def test_importons_carry_the_throughput_of_pixels() -> None:
    scene, config = loaded(shell=ball((0, 0, 0), 9.0, WHITE, 3), light=sky())
    found = importon_map(scene, scene.camera(0), config, 1000, 1, 3)
    assert len(found.points) == 1000 and found.weights.sum() == pytest.approx(16 * 16, rel=1e-4)
    deeper = importon_map(scene, scene.camera(0), config, 1000, 3, 3)
    assert deeper.weights.sum() == pytest.approx(3 * 16 * 16, rel=1e-4)


def test_a_map_without_points_has_no_density() -> None:
    nothing = PhotonMap(np.zeros((0, 3)), np.zeros(0))
    assert not nothing.leaving(np.zeros((4, 3)), 20).any()
    one = PhotonMap(np.array([[1.0, 0.0, 0.0]]), np.array([2.0]))
    assert one.leaving(np.zeros((1, 3)), 20) == pytest.approx(2.0 / math.pi**2)


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 3, 2), (7, 1, 4)])
def test_cells_are_those_of_a_regular_grid(shape) -> None:
    scene, _params = load("soft")
    r = request(scene, OCCLUDER, PathSpace(guiding=GRID))
    guiding.reset(scene)
    grid = replace(GRID, shape=shape)
    store.guide(r, grid)
    (built,) = guiding.structures(scene)
    leaves = built.leaves["light"]
    assert len(leaves.low) == math.prod(shape)
    # Absorbs boundaries at multiples of 2^-24.
    np.testing.assert_allclose(
        leaves.high - leaves.low, np.broadcast_to(1.0 / np.array(shape), leaves.low.shape), atol=1e-6
    )
    points = np.random.default_rng(0).random((100, 3))
    found = leaves.find(points)
    assert (points >= leaves.low[found]).all() and (points < leaves.high[found]).all()


@pytest.mark.parametrize(("name", "parameter", "depth", "technique", "factor"), [
    ("soft", OCCLUDER, 2, "light", 3.0),
    pytest.param("floating", BOX, 3, "wedge", 1.5, marks=pytest.mark.slow),
    pytest.param("point", OCCLUDER, 2, "light", 3.0, marks=pytest.mark.slow),
])  # fmt: skip
def test_guided_samples_find_silhouettes(name, parameter, depth, technique, factor) -> None:
    scene, _params = load(name)
    r = request(scene, parameter, PathSpace(guiding=GRID), depth)
    guiding.reset(scene)
    store.guide(r, GRID)
    (built,) = guiding.structures(scene)
    assert built.evaluations == 0  # no path is traced for a cell
    guided, uniform = drawn(scene, r, built, technique, 8192)
    assert uniform > 0.0 and guided > factor * uniform


def test_its_memory_is_that_of_its_cells() -> None:
    scene, _params = load("soft")
    r = request(scene, OCCLUDER, PathSpace(guiding=GRID))
    guiding.reset(scene)
    store.guide(r, GRID)
    (built,) = guiding.structures(scene)
    cells = 128 * 8 * 8
    # A node has 12 bytes, a leaf three corners' worth of 12 and a probability; the wedge is one leaf here.
    assert built.memory == 12 * (2 * cells - 1) + cells * 36 + 4 * (cells + 1) + 12 + 36 + 8


CASES = [
    Case("soft", OCCLUDER, ALONG, 0.01, "occluder moves", difference_spp=2048, slow=False),
    Case("soft", FLOOR, moved(0.0, 0.0, 1.0), 0.02, RECEIVER, spp=1024, difference_spp=4096),
    Case("floating", BOX, moved(1.0, -0.5, 0.0), 0.005, "a box moves", depth=3, spp=1024, difference_spp=4096),
]


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    guiding.reset(load(case.scene)[0])
    assert_agrees(derivatives(case, mode, PathSpace(guiding=GRID)), differences(case)[2])


@pytest.mark.slow
def test_projective_sampling_takes_a_grid() -> None:
    scene, params = load("soft")
    integrator = psdr.PathIntegrator(max_depth=2, boundary=Projective(guiding=GRID, paths=1024))
    assert psdr.render_forward(scene, params, {OCCLUDER: 1.0}, integrator=integrator, spp=1).numpy().any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"shape": (8, 8)}, "shape"),
        ({"shape": [8, 8, 8]}, "shape"),
        ({"shape": (8, 0, 8)}, "shape"),
        ({"shape": (4096, 32, 32)}, "shape"),
        ({"photons": 0}, "photons"),
        ({"importons": 1.5}, "importons"),
        ({"neighbours": True}, "neighbours"),
        ({"floor": 0.0}, "floor"),
    ],
)
def test_wrong_options_are_refused(options, message) -> None:
    with pytest.raises(ValueError, match=message):
        guiding.Grid(**options)

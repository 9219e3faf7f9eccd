"""Media against formulas: slabs, light scattered once in an infinite medium, furnaces (docs/theory/media.md)."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.media.scenes import (
    BLACK,
    T,
    camera,
    cube,
    integrator,
    medium,
    point,
    points,
    rgb,
    sky,
    square,
    whole,
)
from tests.path.helpers import assert_mean, batches

#: Absorbs the width of the camera and the step by which rays leave surfaces, relative.
WIDTH = 1e-3
#: L of a point light of intensity 1 at the distance D, seen at the angle gamma to the ray, in an infinite medium:
#: sigma_t, sigma_s, D, gamma (degrees), g, L.
AIRLIGHT = [
    (0.5, 0.4, 2.0, 30.0, None, 0.01647667),
    (1.0, 1.0, 1.0, 90.0, None, 0.01538272),
    (0.1, 0.1, 3.0, 60.0, None, 0.00304581),
    (0.5, 0.4, 2.0, 30.0, 0.6, 0.01568030),
    (0.5, 0.4, 2.0, 30.0, -0.4, 0.01252924),
]


def slab(sigma_t, albedo=0.0):
    """A cube of side 2 before a sky of radiance 1, seen along its axis."""
    return whole(
        sensor=camera([0, 0, 5], [0, 0, 0], up=(0, 1, 0)),
        slab=cube(medium(sigma_t, albedo)),
        sky=sky(1.0, 1.0, 1.0),
    )


@pytest.fixture(scope="module")
def grey_slab():
    return psdr.load_dict(slab(0.5))


@pytest.mark.parametrize("sigma_t", [0.0, 1e-3, 0.5, 1.0, 50.0, 1e6])
def test_a_slab_lets_exp_minus_tau_pass(grey_slab, sigma_t):
    """T is exact where nothing is scattered, and surfaces that are not there are passed at depth 1."""
    params = psdr.traverse(grey_slab)
    params["slab.interior_medium.sigma_t.value.value"] = sigma_t
    params.update()
    image = psdr.render(grey_slab, integrator={"type": "volpath", "max_depth": 1}, spp=4).numpy()
    np.testing.assert_allclose(image, np.exp(-2.0 * sigma_t), rtol=1e-3 * max(sigma_t, 1e-2), atol=1e-30)
    if sigma_t < 10.0:
        images = batches(grey_slab, spp=256, max_depth=-1)
        assert_mean(points(images), np.exp(-2.0 * sigma_t), f"sigma {sigma_t}", WIDTH)


@pytest.mark.slow
def test_one_channel_is_drawn_and_all_weigh():
    """By channel, the hero's weights alone have a standard deviation of 31 here."""
    sigma = (0.1, 0.8, 4.0)
    scene = psdr.load_dict(slab(sigma))
    samples = points(batches(scene, count=8, spp=1, max_depth=-1))
    images = points(batches(scene, spp=1024, max_depth=-1))
    assert_mean(images, np.exp(-2.0 * np.array(sigma)), "by channel", WIDTH)
    assert samples.std() < 2.0


@pytest.fixture(scope="module")
def airlight():
    """A point light at the origin; the ray passes it. A black square stands far behind the camera."""
    found = {}

    def make(sigma_t, sigma_s, distance, angle, g):
        if (g is None) not in found:
            parts = {
                "sensor": camera([0, 0, 0], [0, 0, 1], 0.05, up=(0, 1, 0), near_clip=1e-5, medium=medium(1.0, 1.0, g)),
                "behind": square(-4.0, 0.5, BLACK),
                "light": point([0.0, 0.0, 1.0]),
            }
            found[g is None] = psdr.load_dict(whole(**parts))
        scene = found[g is None]
        params = psdr.traverse(scene)
        gamma = np.radians(angle)
        params["light.position"] = distance * np.array([np.sin(gamma), 0.0, np.cos(gamma)])
        params["sensor.medium.sigma_t.value.value"] = sigma_t
        params["sensor.medium.albedo.value.value"] = sigma_s / sigma_t
        if g is not None:
            params["sensor.medium.phase_function.g"] = g
        params.update()
        return scene

    return make


@pytest.mark.slow_rows("case3", "case4")  # of an anisotropic phase: its derivatives stay in test_gradient_forms.py
@pytest.mark.parametrize("case", AIRLIGHT)
def test_light_scattered_once(airlight, case):
    *parameters, expected = case
    images = batches(airlight(*parameters), spp=1024, max_depth=2)
    assert_mean(points(images), expected, str(parameters), WIDTH)


@pytest.mark.slow
@pytest.mark.parametrize("g", [None, 0.7])
def test_a_furnace(g):
    """Nothing absorbs: every pixel has the sky's radiance, whatever the density and the phase function."""
    parts = {
        "sensor": camera([3.5, 2.5, 2.0], [0, 0, 0], 40.0, 8),
        "block": cube(medium((0.5, 2.0, 8.0), 1.0, g), turn=15.0),
        "white": {
            "type": "cube",
            "to_world": T.rotate([1, 0, 0], 30.0) @ T.scale(0.4),
            "bsdf": {"type": "diffuse", "reflectance": 1.0},
        },
        "sky": sky(1.0, 1.0, 1.0),
    }
    images = batches(psdr.load_dict(whole(**parts)), spp=64, max_depth=-1)
    assert_mean(images.mean(axis=(1, 2)), 1.0, "furnace", WIDTH)


def single_scattering(tau, mu, mu0, albedo):
    """L = a mu0 / (4 pi (mu + mu0)) (1 - exp(-tau (1 / mu + 1 / mu0)))."""
    return albedo * mu0 / (4.0 * np.pi * (mu + mu0)) * -np.expm1(-tau * (1.0 / mu + 1.0 / mu0))


@pytest.fixture(scope="module")
def slab_in_the_sun():
    mu, mu0 = 0.8, 0.5
    away = np.array([np.sqrt(1.0 - mu**2), 0.0, mu])
    parts = {
        "sensor": camera(3.0 * away + [0, 0, 0.5], [0, 0, 0.5], up=(0, 1, 0)),
        "slab": {
            "type": "cube",
            "to_world": T.scale([20.0, 20.0, 0.5]),
            "bsdf": {"type": "null"},
            "interior": medium(1.0, 0.9),
        },
        "sun": {
            "type": "directional",
            "direction": [0.0, np.sqrt(1.0 - mu0**2), -mu0],
            "irradiance": rgb(1.0, 1.0, 1.0),
        },
    }
    return psdr.load_dict(whole(**parts))


@pytest.mark.filterwarnings("ignore:samples that were not finite")  # points that round to before the slab
@pytest.mark.parametrize("tau", [1e-3, 1.0, 1e3, 1e4])
def test_a_slab_in_the_sun(slab_in_the_sun, tau):
    """Light scattered once, also where its depth is a millionth of the scene's extent."""
    params = psdr.traverse(slab_in_the_sun)
    params["slab.interior_medium.sigma_t.value.value"] = tau
    params.update()
    images = batches(slab_in_the_sun, spp=1024, max_depth=2)
    assert_mean(points(images), single_scattering(tau, 0.8, 0.5, 0.9), f"tau {tau}", WIDTH)
    assert psdr.invalid_samples(slab_in_the_sun)["image"] < 1e-3 * images.size / 3 * 1024


@pytest.mark.slow
def test_lights_mirrors_and_depth():
    """A light seen through two cubes at depth 1, and the last vertex of a path collides with nothing."""
    parts = {
        "sensor": camera([0, 0, 6], [0, 0, 0], up=(0, 1, 0)),
        "outer": cube(medium(0.2, 0.9), scale=1.5),
        "inner": cube(medium(0.7, 0.9), scale=0.5, exterior=medium(0.2, 0.9)),
        "light": square(-3.0, 1.0, BLACK, emitter={"type": "area", "radiance": rgb(1.0, 2.0, 3.0)}),
    }
    parts["outer"]["interior"]["id"] = "thin"
    parts["inner"]["exterior"] = {"type": "ref", "id": "thin"}
    scene = psdr.load_dict(whole(integrator=integrator(1), **parts))
    expected = np.array([1.0, 2.0, 3.0]) * np.exp(-2.0 * 0.2 - 0.7)
    np.testing.assert_allclose(points(psdr.render(scene, spp=4).numpy()), np.tile(expected, (16, 1)), rtol=1e-4)
    assert psdr.invalid_samples(scene)["image"] == 0

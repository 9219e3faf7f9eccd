"""The clear sky and its sun: Mitsuba's values and images, what follows edits, what cannot be."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.helpers import assert_same_mean, batches, blocks
from tests.peer import for_mitsuba
from warp_psdr.scene import describe_dict
from warp_psdr.scene.lights import sky_model

T = psdr.Transform
SIZE = 12
#: The sun's radiance here is a mean over the tables' disk; Mitsuba has a table of irradiances in half precision.
SUN = 6e-3
#: A map of 128 x 256 texels, and Mitsuba's film.
MAP = 4e-3
PARAMETERS = {"turbidity": 3.6, "albedo": {"type": "rgb", "value": [0.2, 0.3, 0.5]}, "sun_direction": [0.4, -0.3, 0.6]}


def scene(**sky):
    camera = {
        "type": "perspective",
        "fov": 60.0,
        "to_world": T.look_at((0, -4, 2), (0, 0, 0.5), (0, 0, 1)),
        "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
    }
    floor = {"type": "rectangle", "to_world": T.scale(3), "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    cube = {"type": "cube", "to_world": T.translate([0, 0, 0.5]) @ T.scale(0.5)}
    light = {"type": "sunsky", "to_world": T.rotate([0.3, 0.1, 1.0], 30), **PARAMETERS, **sky}
    path = {"type": "path", "max_depth": 3}
    return {"type": "scene", "integrator": path, "sensor": camera, "floor": floor, "cube": cube, "sky": light}


def loaded(**sky):
    with pytest.warns(psdr.SceneWarning, match="'directional' light here, which has no disk"):
        return psdr.load_dict(scene(**sky))


def test_sky_and_sun_are_mitsubas():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    rng, at = np.random.default_rng(0), mi.SurfaceInteraction3f()
    for _ in range(6):
        sun, turbidity, albedo = rng.normal(size=3), rng.uniform(1.0, 10.0), rng.uniform(0.0, 1.0, 3)
        sun = np.array([*sun[:2], abs(sun[2])]) / np.linalg.norm(sun)
        common = {"type": "sunsky", "sun_direction": sun.tolist(), "turbidity": turbidity}
        common["albedo"] = {"type": "rgb", "value": albedo.tolist()}
        sky = mi.load_dict({**common, "sun_scale": 0.0})
        for direction in rng.normal(size=(4, 3)):
            direction = np.array([*direction[:2], abs(direction[2])]) / np.linalg.norm(direction)
            at.wi = mi.Vector3f(*(-direction))
            found = sky_model.sky_radiance(direction, sun, turbidity, albedo)
            np.testing.assert_allclose(found, np.array(sky.eval(at)), rtol=2e-4)
        sun = np.array([*sun[:2], sun[2] + 0.3]) / np.linalg.norm([*sun[:2], sun[2] + 0.3])  # no part of it sets
        disk = mi.load_dict({**common, "sun_direction": sun.tolist(), "sky_scale": 0.0})
        at.wi = mi.Vector3f(*(-sun))
        found = sky_model.sun_irradiance(sun, turbidity)
        np.testing.assert_allclose(found, sky_model.SOLID_ANGLE * np.array(disk.eval(at)), rtol=SUN)


def test_the_sun_of_a_time_and_a_place_is_mitsubas():
    """Up to Mitsuba's dates in single precision."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    heidelberg = {"latitude": 49.4, "longitude": 8.7, "timezone": 1.0, "year": 2024, "month": 3, "day": 5, "hour": 10.5}
    south = {"latitude": -30.0, "longitude": -70.0, "timezone": -4.0, "month": 12, "day": 24, "minute": 20.0}
    for given in ({}, heidelberg, south, {**south, "to_world": T.rotate([1, 0, 0], 20)}):
        sky = {"type": "sunsky", "sun_scale": 0.0, **given}
        (light,) = describe_dict({"type": "scene", "sky": sky}).emitters
        theirs = np.array(mi.traverse(mi.load_dict(for_mitsuba(mi, sky)))["sun_direction"])
        np.testing.assert_allclose(light.sky.sun_direction, theirs, atol=2e-3)


@pytest.mark.parametrize("sun", [pytest.param(0.0, id="sky"), pytest.param(1.0, id="sun", marks=pytest.mark.slow)])
def test_images_equal_mitsubas(sun):
    """All pixels before the sky alone; with the sun, those of the floor, away from the half shadow of a disk."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    parts = scene(sun_scale=sun)
    ours = batches(loaded() if sun else psdr.load_dict(parts), spp=64)
    theirs = mi.load_dict(for_mitsuba(mi, parts))
    theirs = np.stack([np.array(mi.render(theirs, spp=64, seed=i)) for i in range(16)]).astype(np.float64)
    rows = slice(8, 12) if sun else slice(0, 12)
    assert_same_mean(blocks(ours[:, rows], 2), blocks(theirs[:, rows], 2), "sunsky", SUN + MAP)


@pytest.mark.slow
def test_what_follows_its_parameters_is_that_of_a_new_scene():
    old, changed = loaded(), {"turbidity": 5.2, "sun_direction": [0.1, 0.5, 0.7], "sun_scale": 0.5, "sky_scale": 2.0}
    params = psdr.traverse(old)
    names = ["sky.sky_scale", "sky.to_world", "sky.turbidity", "sky.albedo.value", "sky.sun_direction", "sky.sun_scale"]
    assert [name for name in params if name.startswith("sky")] == names
    for name, value in changed.items():
        params[f"sky.{name}"] = value
    params.update()
    new = loaded(**changed)
    np.testing.assert_allclose(psdr.render(old, spp=4).numpy(), psdr.render(new, spp=4).numpy(), rtol=1e-4, atol=1e-6)
    for name, value, words in (
        ("turbidity", 11.0, "from 1 to 10"),
        ("albedo.value", -0.5, "from 0 to 1"),
        ("sun_direction", 0.0, "no length"),
    ):
        state = params[f"sky.{name}"].numpy().copy()
        params[f"sky.{name}"].fill_(value)
        with pytest.raises(ValueError, match=rf"sky\.{name}.*{words}"):
            params.update()
        params[f"sky.{name}"] = state
        params.update()


@pytest.mark.slow
def test_the_suns_shadow_moves_with_its_direction():
    """Derivatives of the image of a cube's shadow, boundary term included, against differences."""
    lit, name = loaded(sky_scale=1e-4), "sky.sun_direction"
    params, weights = psdr.traverse(lit), np.random.default_rng(1).random((SIZE, SIZE, 3)).astype(np.float32)
    params.requires_grad_only(name)
    integrator, tangent, step = psdr.PathIntegrator(max_depth=2), np.array([0.3, 0.8, 0.0]), 0.02
    found = []
    for seed in range(8):
        params.zero_grad()
        psdr.render_backward(lit, params, weights, integrator=integrator, spp=256, seed=seed)
        found.append(params[name].grad.numpy() @ tangent)
    held, sums = params[name].numpy().copy(), []
    for sign in (1.0, -1.0):
        params[name] = held + sign * step * tangent
        params.update()
        images = [psdr.render(lit, integrator=integrator, spp=1024, seed=100 + i).numpy() for i in range(8)]
        sums.append([float((image.astype(np.float64) * weights).sum()) for image in images])
    differences = (np.array(sums[0]) - np.array(sums[1])) / (2.0 * step)
    noise = np.hypot(np.std(found) / 8**0.5, np.std(differences) / 8**0.5)
    assert noise < 0.02 * abs(differences.mean())
    assert abs(np.mean(found) - differences.mean()) < 4.0 * noise + 0.02 * abs(differences.mean())


@pytest.mark.parametrize(
    ("sky", "words"),
    [
        ({"latitude": 50.0}, "got both 'sun_direction' and 'latitude'"),
        ({"sun_direction": None, "month": 13}, "no such time.*of the calendar"),
        ({"sun_direction": [0, 0, 0]}, "no length"),
        ({"complex_sun": True}, "limb.*leave it out"),
        ({"turbidity": 12.0}, "turbidity.*1.*10"),
        ({"albedo": {"type": "checkerboard"}}, "checkerboard.*give a colour"),
        ({"to_world": T.scale([1, 1, 0])}, "inver"),
    ],
)
def test_what_cannot_be_is_named(sky, words):
    given = scene(**sky)
    given["sky"] = {name: value for name, value in given["sky"].items() if value is not None}
    with pytest.raises(ValueError, match=words):
        describe_dict(given)


def test_a_sun_below_the_horizon_is_noted():
    given = scene(sun_direction=[0.0, 1.0, -0.9], sun_scale=0.0)
    with pytest.warns(psdr.SceneWarning, match="below the horizon"):
        image = psdr.render(psdr.load_dict(given), spp=1).numpy()
    assert not image.any()

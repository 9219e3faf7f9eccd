"""Meters, sensors of one pixel: closed forms, Mitsuba's numbers, derivatives, and what is refused."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.helpers import assert_same_mean, batches
from tests.peer import MITSUBA_ROUNDING, for_mitsuba

T = psdr.Transform
FILM = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
DOWN = T.translate([0.2, 0.1, 1.0]) @ T.rotate([1.0, 0.0, 0.0], 180.0) @ T.scale(0.5)
RADIANCE = {"type": "radiancemeter", "origin": [0.3, 0.1, 2.0], "direction": [0.1, 0.0, -2.0], "film": FILM}


def scene_of(sensor="radiance", **objects):
    """Return a floor and a lamp, measured by one ray, or by a rectangle that faces the floor."""
    wave = np.sin(np.arange(6) * 1.1)[:, None, None] * np.cos(np.arange(7) * 0.9)[None, :, None]
    texture = {"type": "bitmap", "bitmap": (0.5 + 0.3 * wave * np.ones(3)).astype(np.float32), "raw": True}
    meter = {"type": "rectangle", "to_world": DOWN, "sensor": {"type": "irradiancemeter", "film": FILM}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "floor": {
            "type": "rectangle",
            "to_world": T.scale(2.0),
            "bsdf": {"type": "diffuse", "reflectance": texture},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": T.translate([-1.0, 0.4, 1.5]) @ T.rotate([0.0, 1.0, 0.0], 120.0) @ T.scale(0.4),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [8.0, 6.0, 4.0]}},
        },
        "meter": RADIANCE if sensor == "radiance" else meter,
        **objects,
    }


def test_meters_have_closed_forms():
    """Under an even sky of radiance L a surface receives pi L, and a diffuse floor sends rho L."""
    common = {"type": "scene", "sky": {"type": "constant", "radiance": 2.0}}
    ball = {"type": "sphere", "sensor": {"type": "irradiancemeter", "film": FILM}}
    found = psdr.render(psdr.load_dict({**common, "ball": ball}), spp=16).numpy()
    np.testing.assert_allclose(found, 2.0 * np.pi, rtol=1e-5)
    floor = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    found = psdr.render(psdr.load_dict({**common, "floor": floor, "meter": RADIANCE}), spp=256).numpy()
    np.testing.assert_allclose(found, 1.0, rtol=2e-2)
    seen = psdr.render(psdr.load_dict({**common, "floor": floor, "meter": {**RADIANCE, "direction": [0, 0, 1]}}), spp=1)
    np.testing.assert_allclose(seen.numpy(), 2.0, rtol=1e-6)


@pytest.mark.slow_rows("irradiance", "radiance")
@pytest.mark.parametrize("sensor", ["radiance", "irradiance"])
def test_numbers_equal_mitsubas(sensor):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    described = scene_of(sensor)
    theirs = mi.load_dict(for_mitsuba(mi, described))
    ours = batches(psdr.load_dict(described), count=8, spp=2048)
    images = np.stack([np.array(mi.render(theirs, spp=2048, seed=i)) for i in range(len(ours))]).astype(np.float64)
    assert images.min() > 0.05
    assert_same_mean(ours, images, sensor, MITSUBA_ROUNDING)


def test_parameters_have_mitsubas_names():
    assert "meter.to_world" in psdr.traverse(psdr.load_dict(scene_of()))
    scene = psdr.load_dict(scene_of("irradiance"))
    assert scene.description.sensors[0].path == "meter.sensor"
    assert not any(name.startswith("meter.sensor") for name in psdr.traverse(scene))


def lit(**objects):
    """A card between the lamp and where the ray ends."""
    pose = T.translate([-0.15, 0.25, 0.9]) @ T.scale(0.3)
    black = {"type": "diffuse", "reflectance": 0.0}
    return scene_of(card={"type": "rectangle", "to_world": pose, "bsdf": black}, **objects)


def along(values):
    d = np.zeros_like(values)
    d[0, 3], d[1, 3] = 1.0, -0.5
    return d


SHIFT = np.array([[0, 0, 0, 0.3], [0, 0, 0, -0.5], [0, 0, 0, 0.4], [0, 0, 0, 0]], np.float32)
#: Scene, parameter, tangent, step, samples: what has no edge in front of it, and a shadow's edge at the ray's end.
CASES = {
    "radiance, texels": (scene_of, "floor.bsdf.reflectance.data", 1.0, 0.05, 1024),
    "radiance, lamp": (scene_of, "lamp.emitter.radiance.value", 1.0, 0.5, 1024),
    "radiance, the meter moves": (scene_of, "meter.to_world", SHIFT, 0.02, 4096),
    "radiance, a shadow moves": (lit, "card.to_world", along, 0.02, 1 << 15),
    "irradiance, texels": (lambda: scene_of("irradiance"), "floor.bsdf.reflectance.data", 1.0, 0.05, 4096),
    "irradiance, lamp": (lambda: scene_of("irradiance"), "lamp.emitter.radiance.value", 1.0, 0.5, 4096),
}
#: Error of a slope, as the project promises.
SLOPE = 0.02


FAST = "irradiance, texels"


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n != FAST)) for n in CASES])
def test_derivatives_equal_differences_in_both_modes(name):
    make, parameter, tangent, step, spp = CASES[name]
    scene = psdr.load_dict(make())
    params = psdr.traverse(scene)
    params.requires_grad(parameter)
    start = params[parameter].numpy().copy()
    direction = tangent(start) if callable(tangent) else np.broadcast_to(np.float32(tangent), start.shape)
    direction = np.array(direction, np.float32)
    options = {"integrator": psdr.PathIntegrator(max_depth=2, rr_depth=99), "spp": spp}
    weights = np.array([[[1.0, 0.5, -0.3]]], np.float32)
    forward, reverse, differences = [], [], []
    for seed in range(8):
        image = psdr.render_forward(scene, params, {parameter: direction}, seed=seed, **options).numpy()
        forward.append(float((image * weights).sum()))
        params.zero_grad()
        psdr.render_backward(scene, params, weights, seed=seed, **options)
        reverse.append(float((params[parameter].grad.numpy().astype(np.float64) * direction).sum()))
        ends = []
        for h in (step, -step):
            params[parameter] = start + h * direction
            params.update()
            found = psdr.render(scene, seed=100 + seed, integrator=options["integrator"], spp=4 * spp).numpy()
            ends.append(float((found.astype(np.float64) * weights).sum()))
        params[parameter] = start
        params.update()
        differences.append((ends[0] - ends[1]) / (2.0 * step))
    assert forward == pytest.approx(reverse, rel=1e-3)
    mean, error = np.mean(differences), np.std(differences, ddof=1) / np.sqrt(8)
    noise = np.std(forward, ddof=1) / np.sqrt(8)
    assert abs(mean) > 10.0 * np.hypot(error, noise)
    assert abs(np.mean(forward) / mean - 1.0) < SLOPE + 3.0 * np.hypot(error, noise) / abs(mean)


def test_boundary_terms_that_meters_lack_are_refused_by_name():
    scene = psdr.load_dict(lit(sun={"type": "point", "position": [1.0, 0.0, 2.0]}))
    assert psdr.plan(scene, names=["card.to_world"], integrator=psdr.PathIntegrator(max_depth=2)).boundary is not None
    for depth, method, words in [
        (3, "auto", "hard shadows are not covered beyond max_depth=2"),
        (2, psdr.boundary.PathSpace(), r"the one ray of a 'radiancemeter'; use boundary\.EdgeSampling\(\)"),
    ]:
        with pytest.raises(ValueError, match=words):
            integrator = psdr.PathIntegrator(max_depth=depth, boundary=method)
            psdr.plan(scene, names=["card.to_world"], integrator=integrator)
    scene = psdr.load_dict(scene_of("irradiance"))
    with pytest.raises(ValueError, match=r"does not know an .irradiancemeter."):
        psdr.plan(scene, names=["lamp.to_world"], integrator=psdr.PathIntegrator(max_depth=2))
    for name in ("meter.to_world", "meter.vertex_positions"):
        with pytest.raises(ValueError, match=rf"{name} moves the shape of the irradiancemeter 'meter\.sensor'"):
            psdr.plan(scene, names=[name], integrator=psdr.PathIntegrator(max_depth=2, boundary=None))


SQUARE = {"type": "rectangle"}


@pytest.mark.parametrize(
    ("objects", "words"),
    [
        ({"meter": {**RADIANCE, "film": {"type": "hdrfilm"}}}, "a film of 768x576 pixels.*a width and a height of 1"),
        ({"meter": {**RADIANCE, "to_world": T.scale(1.0)}}, "both 'origin' and 'to_world'"),
        ({"meter": {k: v for k, v in RADIANCE.items() if k != "origin"}}, "got 'direction' alone"),
        ({"meter": {**RADIANCE, "direction": [0, 0, 0]}}, "no length.*non-zero"),
        ({"meter": {**RADIANCE, "fov": 40.0}}, "no parameter 'fov'"),
        ({"meter": {"type": "irradiancemeter", "film": FILM}}, "outside of a shape.*nest it"),
        ({"meter": {**SQUARE, "sensor": {"type": "perspective"}}}, "a 'perspective' inside a shape"),
    ],
)
def test_bad_input_is_refused_with_a_remedy(objects, words):
    with pytest.raises(ValueError, match=words) as caught:
        psdr.load_dict(scene_of(**objects))
    assert "problems" not in str(caught.value)


def test_wide_pixel_filters_are_replaced_and_told():
    film = {**FILM, "rfilter": {"type": "gaussian"}}
    with pytest.warns(psdr.SceneWarning, match="'box' replaces 'gaussian'"):
        scene = psdr.load_dict(scene_of(meter={**RADIANCE, "film": film}))
    assert scene.description.sensors[0].film.filter == "box"

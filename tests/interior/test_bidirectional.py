"""Bidirectional paths against the path tracer and finite differences, images and derivatives, and what is refused."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.interior.test_light_tracing import MODES, ROOMS, SLOPE, corner, reverse, weights
from tests.path.helpers import assert_mean, assert_same_mean, blocks
from tests.path.test_light_tracing import (
    BATCHES,
    BLOCK,
    ball,
    camera_of,
    lamp,
    pixel_means,
    refracted_radiance,
    under_water,
)
from tests.path.test_light_tracing import ROOMS as IMAGES

BIDIRECTIONAL = psdr.interior.Bidirectional()
CONNECTED = psdr.interior.Bidirectional(connections="all")
BOTH = pytest.mark.parametrize("method", [BIDIRECTIONAL, CONNECTED], ids=["light", "all"])
T = psdr.Transform


@pytest.mark.parametrize(
    "method", [BIDIRECTIONAL, pytest.param(CONNECTED, marks=pytest.mark.slow)], ids=["light", "all"]
)
def test_one_scene_image_slopes_modes_and_workers(method):
    """The image is the path tracer's; by a reflectance and a radiance slopes are 1, in both modes, with equal bits."""
    scene = psdr.load_dict(corner(lamp=lamp()))
    params = psdr.traverse(scene)
    integrator = psdr.PathIntegrator(max_depth=4, interior=method)
    images = [
        np.array([psdr.render(scene, integrator=chosen, spp=512, seed=i).numpy() for i in range(BATCHES)], np.float64)
        for chosen in (integrator, psdr.PathIntegrator(max_depth=4))
    ]
    assert_same_mean(*(blocks(image, 2) for image in images), "corner")
    np.testing.assert_allclose(images[0].mean(), images[1].mean(), rtol=0.005)
    options = {"integrator": integrator, "spp": 1024, "seed": 3}
    adjoint = weights(8)
    steps = {"floor.bsdf.reflectance.value": 0.02, "lamp.emitter.radiance.value": 0.2}
    backward = reverse(scene, params, adjoint, list(steps), **options)
    try:
        psdr.set_workers(3)
        params.zero_grad()
        for one, other in zip(backward, reverse(scene, params, adjoint, list(steps), **options), strict=True):
            np.testing.assert_array_equal(other, one)
        again = psdr.render(scene, integrator=integrator, spp=512, seed=0).numpy()
        np.testing.assert_array_equal(again, images[0][0].astype(np.float32))
    finally:
        psdr.set_workers(None)
    for (name, step), gradient in zip(steps.items(), backward, strict=True):
        tangents = {other: np.full(3, float(other == name), np.float32) for other in steps}
        forward = psdr.render_forward(scene, params, tangents, **options).numpy().astype(np.float64)
        total = (forward * adjoint).sum()
        assert gradient.sum() == pytest.approx(total, rel=MODES)
        values, ends = params[name].numpy().copy(), []
        for sign in (1.0, -1.0):
            params[name] = values + np.float32(sign * step)
            params.update()
            ends.append((psdr.render(scene, **options).numpy().astype(np.float64) * adjoint).sum())
        params[name] = values
        params.update()
        assert total / ((ends[0] - ends[1]) / (2.0 * step)) == pytest.approx(1.0, abs=SLOPE), name


def integrators(scene, method):
    depth = scene.description.integrator["max_depth"]
    return [psdr.PathIntegrator(max_depth=depth, interior=m) for m in (method, psdr.interior.Replay())]


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize("name", IMAGES)
def test_the_image_is_that_of_the_path_tracer(name, method):
    described = IMAGES[name]()
    described["integrator"].pop("hide_emitters", None)
    scene = psdr.load_dict(described)
    found = []
    for integrator in integrators(scene, method):
        images = [psdr.render(scene, integrator=integrator, spp=256, seed=i).numpy() for i in range(2 * BATCHES)]
        found.append(blocks(np.array(images, np.float64), BLOCK))
    assert_same_mean(*found, name)
    np.testing.assert_allclose(found[0].mean(), found[1].mean(), rtol=0.01)


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize("name", ROOMS)
def test_derivative_images_are_those_of_path_replay(name, method):
    scene = psdr.load_dict(ROOMS[name]())
    params = psdr.traverse(scene)
    values = params[name].numpy()
    tangent = np.random.default_rng(4).uniform(0.5, 1.0, values.shape).astype(np.float32)
    if name.endswith("to_world"):
        tangent = np.zeros((4, 4), np.float32)
        tangent[:3, 2] = [0.3, -0.2, 0.1]
    found = []
    for integrator in integrators(scene, method)[::-1]:
        options = {"integrator": integrator, "spp": 128}
        images = [psdr.render_forward(scene, params, {name: tangent}, seed=i, **options) for i in range(BATCHES)]
        found.append(blocks(np.array([image.numpy() for image in images], np.float64), 8))
    assert np.abs(found[0].mean(axis=0)).max() > 0.0
    assert_same_mean(found[1], found[0], name)
    adjoint = weights(24)
    (gradient,) = reverse(scene, params, adjoint, [name], seed=0, **options)
    forward = psdr.render_forward(scene, params, {name: tangent}, seed=0, **options).numpy().astype(np.float64)
    assert abs((gradient * tangent).sum() - (forward * adjoint).sum()) < MODES * np.abs(forward * adjoint).sum()


@pytest.mark.slow
@BOTH
def test_a_point_light_behind_glass_is_what_a_quadrature_says(method):
    """Light paths alone find it, and count in full."""
    scene = psdr.load_dict(under_water())
    params = psdr.traverse(scene)
    options = {"integrator": psdr.PathIntegrator(max_depth=3, interior=method), "spp": 4096}
    expected = pixel_means(refracted_radiance)
    found = np.array([psdr.render(scene, seed=i, **options).numpy()[..., 0] for i in range(BATCHES)], np.float64)
    assert_mean(found, expected, "under water")
    np.testing.assert_allclose(found.mean(axis=0), expected, rtol=0.02)
    name = "floor.bsdf.reflectance.value"
    found = [psdr.render_forward(scene, params, {name: 1.0}, seed=i, **options).numpy()[..., 0] for i in range(BATCHES)]
    assert_mean(np.array(found, np.float64), 2.0 * expected, name)


def caustic():
    """A small lamp above a ball of glass, and a mirror-like ball that shows it."""
    center = [0.5, 0.2, 2.2]
    lamp = {"type": "sphere", "center": center, "radius": 0.05, "emitter": {"type": "area", "radiance": 500.0}}
    ball = {"type": "sphere", "radius": 0.4, "bsdf": {"type": "dielectric"}}
    gold = {"type": "roughconductor", "alpha": 0.03}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 5},
        "camera": camera_of("box"),
        "floor": {"type": "rectangle", "to_world": T.scale(3.0), "bsdf": {"type": "diffuse", "reflectance": 0.5}},
        "ball": {**ball, "center": [-0.4, 0.0, 0.5]},
        "gold": {"type": "sphere", "radius": 0.4, "center": [0.6, 0.0, 0.4], "bsdf": gold},
        "lamp": lamp,
    }


@pytest.mark.slow
@BOTH
def test_the_slope_by_a_roughness_is_one(method):
    """Of a highlight on metal, weighted with the derivative itself, so that its two signs do not cancel."""
    metal = ball([0.0, 0.0, 0.5], type="roughconductor", alpha=0.3)
    above = T.translate([0.0, -1.0, 3.0]) @ T.rotate([1.0, 0.0, 0.0], 180.0) @ T.scale(0.5)
    wide = {"type": "rectangle", "to_world": above, "emitter": {"type": "area", "radiance": 2.0}}
    camera = camera_of("box", size=8)
    scene = psdr.load_dict({"type": "scene", "camera": camera, "ball": {**metal, "radius": 1.0}, "lamp": wide})
    params = psdr.traverse(scene)
    name, step = "ball.bsdf.alpha.value", 0.02
    options = {"integrator": psdr.PathIntegrator(max_depth=3, interior=method), "spp": 2048}

    def derivatives(seeds):
        images = [psdr.render_forward(scene, params, {name: 1.0}, seed=i, **options).numpy() for i in seeds]
        return np.array(images, np.float64)

    adjoint = derivatives(range(100, 104)).mean(axis=0)
    exact = (derivatives(range(32)) * adjoint).sum(axis=(1, 2, 3))
    value, ends = params[name].numpy().copy(), []
    for sign in (1.0, -1.0):
        params[name] = value + np.float32(sign * step)
        params.update()
        images = np.array([psdr.render(scene, seed=i, **options).numpy() for i in range(32)], np.float64)
        ends.append((images * adjoint).sum(axis=(1, 2, 3)))
    finite = (ends[0] - ends[1]) / (2.0 * step)
    errors = [x.std(ddof=1) / np.sqrt(len(x)) / x.mean() for x in (exact, finite)]
    # Samples move with the roughness, so the difference has an error of its own.
    assert max(errors) < 0.01
    assert exact.mean() / finite.mean() == pytest.approx(1.0, abs=SLOPE + 2.0 * max(errors))


@pytest.mark.slow
def test_a_caustic_beside_glossy_metal_has_less_noise_than_by_either_kind_of_path():
    scene = psdr.load_dict(caustic())
    noise = []
    for method in (BIDIRECTIONAL, psdr.interior.Replay(), psdr.interior.LightTracing()):
        integrator = psdr.PathIntegrator(max_depth=5, interior=method)
        images = np.array([psdr.render(scene, integrator=integrator, spp=128, seed=i).numpy() for i in range(16)])
        noise.append(np.sqrt(images.astype(np.float64).var(axis=0, ddof=1).mean()))
    assert noise[0] < 0.6 * noise[1] and noise[0] < 0.6 * noise[2], noise


@pytest.mark.parametrize("method", [psdr.interior.LightTracing(), BIDIRECTIONAL], ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("name", ["floor.vertex_positions", "camera.to_world"])
def test_paths_from_the_camera_follow_what_moves(method, name):
    """The images of all three have the same mean, and so have their derivatives."""
    scene = psdr.load_dict(IMAGES["area"]())
    integrators = [psdr.PathIntegrator(max_depth=3, interior=m) for m in (method, psdr.interior.Replay())]
    told, replayed = (psdr.plan(scene, names=[name], integrator=i) for i in integrators)
    assert "whose image has the same mean" in str(told)
    assert replayed.wanted.geometry and told.boundary is not None
    for part in ("config", "wanted", "interior", "kept", "boundary", "light"):
        assert getattr(told, part) == getattr(replayed, part)


def test_what_it_does_not_know_is_refused_by_name():
    scene = psdr.load_dict(IMAGES["masks and a hidden lamp"]())
    with pytest.raises(ValueError, match=r"does not know hide_emitters"):
        psdr.plan(scene, integrator=psdr.PathIntegrator(interior=BIDIRECTIONAL, hide_emitters=True))
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    meter = {"type": "radiancemeter", "origin": [0.0, -4.0, 1.5], "direction": [0.0, 1.0, 0.0], "film": film}
    metered = psdr.load_dict({**IMAGES["area"](), "camera": meter})
    integrator = psdr.PathIntegrator(interior=BIDIRECTIONAL, boundary=None)
    with pytest.raises(ValueError, match=r"interior\.Bidirectional\(\) does not know the one ray.*Replay"):
        psdr.plan(metered, integrator=integrator)
    glass = psdr.load_dict(ROOMS["matte.bsdf.specular_transmittance.value"]())
    together = psdr.PathIntegrator(interior=psdr.interior.Bidirectional(connections="all"), max_depth=4)
    with pytest.raises(ValueError, match=r"target_error.*draws them together; use connections='light'"):
        psdr.render(psdr.load_dict(IMAGES["box filter"]()), integrator=together, target_error=0.1)
    for depth in (-1, 17):
        with pytest.raises(ValueError, match=r"max_depth: got .*expected 1 to 16; or use connections='light'"):
            psdr.plan(scene, integrator=psdr.PathIntegrator(interior=CONNECTED, max_depth=depth))
    with pytest.raises(ValueError, match=r"connections: got 'some', expected 'light' or 'all'"):
        psdr.interior.Bidirectional(connections="some")
    with pytest.raises(ValueError, match="expected an integer from 1 to 64"):
        psdr.interior.Bidirectional(block=0)
    decided = psdr.plan(glass, names=["floor.bsdf.reflectance.value"], integrator=integrator)
    assert "weighted with those from the camera" in str(decided) and "bidirectional" in decided.interior.label

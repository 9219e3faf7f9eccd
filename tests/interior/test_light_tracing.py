"""Derivatives by light tracing: against finite differences, path replay, closed forms; both modes; what is refused."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.helpers import assert_mean, assert_same_mean, blocks
from tests.path.test_light_tracing import (
    BATCHES,
    ENVIRONMENT,
    GLASS,
    INTENSITY,
    LIGHT_TRACING,
    POINT,
    ROUGH,
    SPOT,
    VEIL,
    ball,
    camera_of,
    lamp,
    pixel_means,
    refracted_radiance,
    rgb,
    room,
    texels,
    under_water,
)

#: Largest relative difference of the two modes, whose float32 sums differ.
MODES = 1e-4
#: Tolerance of a slope.
SLOPE = 0.02


def corner(**objects):
    """A room without balls, in which nothing hides anything, seen by few pixels."""
    described = room(camera_of(size=8), max_depth=4, **objects)
    return {name: value for name, value in described.items() if name not in ("glossy", "matte")}


def weights(size):
    y, x = np.mgrid[0:size, 0:size] / size
    return np.stack([1.0 + 0.5 * np.sin(6.0 * x), 1.0 + 0.4 * np.cos(5.0 * y), 0.7 + 0.6 * x], axis=-1).astype(
        np.float32
    )


def reverse(scene, params, adjoint, names, **options):
    params.requires_grad_only(*names)
    psdr.render_backward(scene, params, adjoint, **options)
    return [params[name].grad.numpy().astype(np.float64) for name in names]


def test_slopes_are_one_and_the_modes_and_all_numbers_of_workers_agree():
    """By a reflectance, an intensity and a position, at once in reverse mode."""
    scene = psdr.load_dict(corner(point=POINT))
    params = psdr.traverse(scene)
    integrator = psdr.PathIntegrator(max_depth=4, interior=LIGHT_TRACING, boundary=None)
    options = {"integrator": integrator, "spp": 4096, "seed": 3}
    adjoint = weights(8)
    steps = {"floor.bsdf.reflectance.value": 0.02, "point.intensity.value": 0.1, "point.position": 0.05}
    directions = {name: np.array([1.0, 1.0, 1.0] if "value" in name else [0.0, 0.0, 1.0], np.float32) for name in steps}
    backward = reverse(scene, params, adjoint, list(steps), **options)
    try:
        psdr.set_workers(3)
        params.zero_grad()
        for one, other in zip(backward, reverse(scene, params, adjoint, list(steps), **options), strict=True):
            np.testing.assert_array_equal(other, one)
    finally:
        psdr.set_workers(None)
    for (name, step), gradient in zip(steps.items(), backward, strict=True):
        # All three are tangents, so that one kernel serves them all.
        tangents = {other: directions[other] * float(other == name) for other in steps}
        forward = psdr.render_forward(scene, params, tangents, **options).numpy().astype(np.float64)
        total = (forward * adjoint).sum()
        assert (gradient * directions[name]).sum() == pytest.approx(total, rel=MODES)
        values, ends = params[name].numpy().copy(), []
        for sign in (1.0, -1.0):
            params[name] = values + sign * step * directions[name]
            params.update()
            ends.append((psdr.render(scene, **options).numpy().astype(np.float64) * adjoint).sum())
        params[name] = values
        params.update()
        assert total / ((ends[0] - ends[1]) / (2.0 * step)) == pytest.approx(1.0, abs=SLOPE), name


@pytest.mark.slow
def test_derivatives_of_a_caustic_are_those_of_its_closed_form():
    """By the intensity of a light that only light paths find, and by the colour of what they pass."""
    scene = psdr.load_dict(under_water())
    params = psdr.traverse(scene)
    expected = pixel_means(refracted_radiance)
    slopes = {
        "light.intensity.value": expected / INTENSITY,
        "floor.bsdf.reflectance.value": 2.0 * expected,
        "surface.bsdf.specular_transmittance.value": expected,
    }
    for name, slope in slopes.items():
        images = [
            psdr.render_forward(scene, params, {name: 1.0}, spp=2048, seed=i).numpy()[..., 0] for i in range(BATCHES)
        ]
        assert_mean(np.array(images, np.float64), slope, name)
        adjoint = weights(8)
        (gradient,) = reverse(scene, params, adjoint, [name], spp=512, seed=1)
        forward = psdr.render_forward(scene, params, {name: 1.0}, spp=512, seed=1).numpy()
        assert gradient.sum() == pytest.approx((forward.astype(np.float64) * adjoint).sum(), rel=MODES)


SKY = {"type": "envmap", "bitmap": texels(1, 6, 12)["bitmap"] ** 3}
TEXTURED = {"type": "diffuse", "reflectance": texels(3, 4, 4)}
PLASTIC = {"type": "plastic", "diffuse_reflectance": 0.5}
WIDE_SPOT = {**SPOT, "beam_width": 10.0, "intensity": rgb(20.0, 40.0, 60.0)}
ROOMS = {
    "glossy.bsdf.alpha.value": lambda: room(lamp=lamp()),
    "lamp.emitter.radiance.value": lambda: room(lamp=lamp()),
    "matte.bsdf.reflectance.value": lambda: room(
        lamp=lamp(), matte=ball([-0.5, -0.3, 0.6], type="diffuse", reflectance=0.0)
    ),
    "matte.bsdf.reflectance.data": lambda: room(point=POINT, matte=ball([-0.5, -0.3, 0.6], **TEXTURED)),
    "matte.bsdf.diffuse_reflectance.value": lambda: room(lamp=lamp(), matte=ball([-0.5, -0.3, 0.6], **PLASTIC)),
    "matte.bsdf.opacity.value": lambda: room(lamp=lamp(), matte=ball([-0.5, -0.3, 0.6], **VEIL)),
    "matte.bsdf.eta": lambda: room(max_depth=6, lamp=lamp(), matte=ball([-0.5, -0.3, 0.6], **ROUGH)),
    "matte.bsdf.alpha.value": lambda: room(max_depth=6, lamp=lamp(), matte=ball([-0.5, -0.3, 0.6], **ROUGH)),
    "matte.bsdf.specular_transmittance.value": lambda: room(
        max_depth=6, lamp=lamp(), matte=ball([-0.5, -0.3, 0.6], **GLASS)
    ),
    "sky.scale": lambda: room(sky=SKY),
    "sky.to_world": lambda: room(sky=SKY),
    "sky.radiance.value": lambda: room(sky=ENVIRONMENT),
    "spot.cutoff_angle": lambda: room(spot=WIDE_SPOT),
    "spot.to_world": lambda: room(spot=WIDE_SPOT),
    "point.position": lambda: room(point=POINT),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ROOMS)
def test_derivative_images_are_those_of_path_replay(name):
    scene = psdr.load_dict(ROOMS[name]())
    params = psdr.traverse(scene)
    values = params[name].numpy()
    tangent = np.random.default_rng(4).uniform(0.5, 1.0, values.shape).astype(np.float32)
    if name.endswith("to_world"):
        tangent = np.zeros((4, 4), np.float32)
        tangent[:3, 2] = [0.3, -0.2, 0.1]
    depth = scene.description.integrator["max_depth"]
    found = []
    for method in (psdr.interior.Replay(), LIGHT_TRACING):
        integrator = psdr.PathIntegrator(max_depth=depth, interior=method, boundary=None)
        options = {"integrator": integrator, "spp": 128}
        images = [psdr.render_forward(scene, params, {name: tangent}, seed=i, **options) for i in range(BATCHES)]
        found.append(blocks(np.array([image.numpy() for image in images], np.float64), 8))
    assert np.abs(found[0].mean(axis=0)).max() > 0.0
    assert_same_mean(found[1], found[0], name)
    adjoint = weights(24)
    (gradient,) = reverse(scene, params, adjoint, [name], seed=0, **options)
    forward = psdr.render_forward(scene, params, {name: tangent}, seed=0, **options).numpy().astype(np.float64)
    scale = np.abs(forward * adjoint).sum()
    assert abs((gradient * tangent).sum() - (forward * adjoint).sum()) < MODES * scale


def test_the_plan_says_who_draws_what():
    scene = psdr.load_dict(room(point=POINT, matte=ball([-0.5, -0.3, 0.6], **GLASS)))
    decided = psdr.plan(scene, names=["point.intensity.value"], integrator="ptracer")
    assert decided.interior.label == "light tracing" and "what mirrors and glass show" in str(decided)

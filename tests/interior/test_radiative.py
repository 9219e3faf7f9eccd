"""Radiative backpropagation: closed forms, zeros, replay's mean, both modes, what it costs and what it refuses."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients import scenes
from tests.gradients.measure import NO_ROULETTE
from tests.gradients.test_table import load

ALBEDO, RADIANCE, DEPTH, SIZE = (0.6, 0.0, 0.3), 0.5, 5, 8
NAME = "room.bsdf.reflectance.value"
#: Standard errors that a mean over batches may be off by.
Z = 4.0


def room(radiance: float) -> dict:
    """A closed ball of one reflectance that shines equally everywhere, or a dark one with a lamp of no power."""
    ball = scenes.ball(True, face_normals=True)
    ball["bsdf"] = {"type": "diffuse", "reflectance": scenes.rgb(*ALBEDO)}
    light = {"lamp": {"type": "point", "position": [0.0, 0.0, 0.3], "intensity": 0.0}}
    if radiance > 0.0:
        ball["emitter"] = {"type": "area", "radiance": scenes.rgb(*3 * [radiance])}
        light = {}
    return {"type": "scene", "sensor": scenes.camera([0.1, 0.2, 0.0], [1, 0, 0], size=SIZE), "room": ball, **light}


def integrator(depth: int, **options) -> psdr.PathIntegrator:
    interior = psdr.interior.Radiative(**options)
    return psdr.PathIntegrator(max_depth=depth, rr_depth=NO_ROULETTE, interior=interior, boundary=None)


def gradient(scene, params, names, adjoint, method, seed: int, spp: int = 16) -> np.ndarray:
    params.requires_grad_only(*names)
    params.zero_grad()
    psdr.render_backward(scene, params, adjoint, integrator=method, spp=spp, seed=seed)
    return np.concatenate([params[name].grad.numpy().ravel() for name in names]).astype(float)


@pytest.fixture(scope="module")
def furnace():
    scene = psdr.load_dict(room(RADIANCE))
    return scene, psdr.traverse(scene)


def test_derivatives_have_a_closed_form_at_zero_reflectance_too(furnace):
    """I = E (1 + a + ... + a^4) for paths of five vertices."""
    scene, params = furnace
    adjoint = np.full((SIZE, SIZE, 3), 1.0 / SIZE**2, np.float32)
    found = np.stack([gradient(scene, params, [NAME], adjoint, integrator(DEPTH), seed) for seed in range(24)])
    a = np.array(ALBEDO)
    expected = RADIANCE * sum(k * a ** (k - 1) for k in range(1, DEPTH))
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    assert (error < 0.02 * expected).all()
    np.testing.assert_array_less(np.abs(found.mean(axis=0) - expected), Z * error + 1e-5)


@pytest.mark.slow
def test_the_modes_are_transposes_of_each_other(furnace):
    scene, params = furnace
    adjoint = np.random.default_rng(3).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
    tangent = np.array([0.3, 1.0, -0.6], np.float32)
    reverse = gradient(scene, params, [NAME], adjoint, integrator(DEPTH), seed=2, spp=4) @ tangent
    image = psdr.render_forward(scene, params, {NAME: tangent}, integrator=integrator(DEPTH), spp=4, seed=2)
    forward = (image.numpy().astype(float) * adjoint).sum()
    assert abs(forward) > 1e-2
    assert reverse == pytest.approx(forward, rel=1e-4)


@pytest.mark.slow
def test_the_linear_form_counts_all_light_as_one_and_says_so():
    """In the dark the unbiased derivative is 0 and that of the linear form, for paths of two vertices, 1."""
    scene = psdr.load_dict(room(0.0))
    params = psdr.traverse(scene)
    adjoint = np.full((SIZE, SIZE, 3), 1.0 / SIZE**2, np.float32)
    linear = integrator(2, linear=True)
    np.testing.assert_allclose(gradient(scene, params, [NAME], adjoint, linear, seed=1), 1.0, rtol=1e-4)
    assert "counts as 1" in str(psdr.plan(scene, params, integrator=linear))
    assert "counts as 1" not in str(psdr.plan(scene, params, integrator=integrator(2)))


@pytest.mark.slow
def test_it_has_the_mean_of_replay_for_moving_shapes():
    """The same terms from other random numbers; the boundary term is left out of both."""
    scene, params = load("gap")
    names = ["floor.vertex_positions", "floor.bsdf.reflectance.value"]
    camera = scene.camera(0)
    adjoint = np.random.default_rng(5).uniform(size=(camera.crop_height, camera.crop_width, 3)).astype(np.float32)
    methods = [psdr.PathIntegrator(max_depth=3, boundary=None), integrator(3)]
    means, errors = [], []
    for method in methods:
        found = np.stack([gradient(scene, params, names, adjoint, method, seed, spp=64) for seed in range(32)])
        means.append(found.mean(axis=0))
        errors.append(found.std(axis=0, ddof=1) / np.sqrt(len(found)))
    assert np.abs(means[0]).max() > 10.0 * np.max(errors)
    np.testing.assert_array_less(np.abs(means[0] - means[1]), Z * np.hypot(*errors) + 1e-6 * np.abs(means[0]).max())


def test_moving_shapes_behind_mirrors_are_refused():
    scene, params = load("mirror")
    params.requires_grad_only("room.vertex_positions")
    with pytest.raises(ValueError, match=r"interior\.Radiative\(\) does not know.*use interior\.Replay\(\)"):
        psdr.plan(scene, params, integrator=integrator(3))

"""Media that emit light: closed forms of a slab, thermal equilibrium in a furnace, and what is refused.

What moves beside them: ``test_glow_boundary.py``.
"""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.media.scenes import camera, cube, medium, sky, volume, whole
from tests.media.test_gradient_forms import derivatives
from tests.path.helpers import assert_mean, batches

SIGMA, ALBEDO, EMISSION = (f"slab.interior_medium.{name}.value.value" for name in ("sigma_t", "albedo", "emission"))
NAMES = [SIGMA, "slab.interior_medium.scale", ALBEDO, EMISSION, "sky.radiance.value"]
#: Absorbs the width of the camera and the step by which rays leave surfaces, relative.
WIDTH = 1e-3


@pytest.fixture(scope="module")
def slab():
    """A cube of side 2 before a sky, seen along its axis."""
    shining = {**medium((1.0, 1.0, 1.0), (0.5, 0.5, 0.5)), "emission": volume((1.0, 1.0, 1.0))}
    parts = {
        "sensor": camera([0, 0, 5], [0, 0, 0], up=(0, 1, 0)),
        "slab": cube(shining),
        "sky": sky(1.0, 1.0, 1.0),
    }
    scene = psdr.load_dict(whole(**parts))
    return scene, psdr.traverse(scene)


def filled(slab, sigma, albedo, emission, radiance):
    scene, params = slab
    for name, value in ((SIGMA, sigma), (ALBEDO, albedo), (EMISSION, emission), ("sky.radiance.value", radiance)):
        params[name] = np.broadcast_to(np.float32(value), params[name].shape)
    params.update()
    return scene, params


def forward(scene, params, name, depth):
    """The mean derivative over the image by a change of all numbers of a parameter."""
    params.requires_grad_only(*NAMES)  # one kernel for all of them
    tangents = dict.fromkeys(NAMES, 0.0) | {name: np.ones(params[name].shape, np.float32)}
    found = psdr.render_forward(scene, params, tangents, integrator=psdr.PathIntegrator(max_depth=depth), spp=16)
    return found.numpy().mean()


@pytest.mark.parametrize(
    ("sigma", "value", "slope"),
    [
        (0.3, 1.052773, -0.948122),
        (0.0, 1.4, -1.4),
        (1e-4, 1.39986, -1.399813),
        (1e5, 7e-6, -7e-11),
    ],
)
def test_a_slab_shines(slab, sigma, value, slope):
    """0.7 a unit length over a length of 2 without scattering; by sigma where that is 0, too."""
    scene, params = filled(slab, sigma, 0.0, 0.7, 0.0)
    integrator = psdr.PathIntegrator(max_depth=1)
    np.testing.assert_allclose(psdr.render(scene, integrator=integrator, spp=4).numpy(), value, rtol=1e-3)
    expected = [slope, sigma * slope, 0.0, value / 0.7, np.exp(-2.0 * sigma)]
    found = derivatives(scene, params, NAMES, spp=16, depth=1)
    np.testing.assert_allclose(found.mean(axis=0), expected, rtol=2e-3, atol=1e-30)
    for name, derivative in ((SIGMA, slope), (EMISSION, value / 0.7)):
        np.testing.assert_allclose(forward(scene, params, name, 1), derivative, rtol=2e-3)


@pytest.mark.slow
def test_in_equilibrium_nothing_is_seen(slab):
    """What is absorbed is emitted: with epsilon = sigma (1 - albedo) L all is L, and stays so along that constraint."""
    sigma, albedo = np.array([0.4, 1.5, 4.0]), np.array([0.9, 0.5, 0.7])
    scene, params = filled(slab, sigma, albedo, sigma * (1 - albedo), 1.0)
    assert_mean(batches(scene, spp=256, max_depth=-1).mean(axis=(1, 2)), 1.0, "equilibrium", WIDTH)
    params.requires_grad_only(*NAMES)
    found = []
    for seed in range(8):
        params.zero_grad()
        psdr.render_backward(
            scene, params, np.full((4, 4, 3), 1 / 16, np.float32), integrator=psdr.PathIntegrator(), spp=512, seed=seed
        )
        by_sigma, by_albedo, by_emission = (params[n].grad.numpy().reshape(3) for n in (SIGMA, ALBEDO, EMISSION))
        assert (by_emission > 0.1).all() and (np.abs(by_sigma) > 0.02).all()
        along = [by_sigma + (1 - albedo) * by_emission, by_albedo - sigma * by_emission]
        found.append(1.0 + np.concatenate(along))
    assert_mean(np.array(found), 1.0, "along the constraint", WIDTH)


@pytest.mark.parametrize(
    ("media", "words"),
    [
        ({"type": "heterogeneous", "emission": {"type": "gridvolume", "data": -np.ones((2, 2, 2))}}, "'emission'"),
        ({"type": "homogeneous", "emission": -1.0}, "at least 0"),
    ],
)
def test_what_is_wrong_is_named(media, words):
    with pytest.raises(ValueError, match=words):
        psdr.load_dict(whole(sensor=camera([0, 0, 5], [0, 0, 0], up=(0, 1, 0)), slab=cube(media), sky=sky(1, 1, 1)))


@pytest.mark.slow
def test_a_slab_that_grows(slab):
    """Along the rays: more of it shines, and less of the sky is seen through it."""
    sigma, emission, radiance = np.array([0.0, 0.3, 1.2]), np.array([0.7, 0.2, 1.0]), np.array([0.5, 1.0, 0.1])
    scene, params = filled(slab, sigma, 0.0, emission, radiance)
    params.requires_grad_only("slab.to_world")
    adjoint = np.broadcast_to(np.float32([1.0, 2.0, -1.5]) / 16, (4, 4, 3)).copy()
    psdr.render_backward(scene, params, adjoint, integrator=psdr.PathIntegrator(max_depth=1), spp=64)
    found = params["slab.to_world"].grad.numpy().reshape(4, 4)[2, 2]
    expected = 2.0 * np.exp(-2.0 * sigma) * (emission - sigma * radiance) @ [1.0, 2.0, -1.5]
    np.testing.assert_allclose(found, expected, rtol=WIDTH)


def test_methods_that_do_not_know_it_are_refused(slab):
    scene, params = slab
    adjoint = np.ones((4, 4, 3), np.float32)
    params.requires_grad_only(SIGMA)
    method = psdr.interior.DifferentialRatioTracking()
    with pytest.raises(ValueError, match=r"does not know media that emit light; use interior.Replay\(\)"):
        psdr.render_backward(scene, params, adjoint, integrator=psdr.PathIntegrator(interior=method), spp=4)

"""Pilots, budgets and moments of methods whose paths start at the lights: terms add up to what the drivers return."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.interior.test_light_tracing import corner, weights
from tests.path.helpers import assert_same_mean
from tests.path.test_light_tracing import camera_of, lamp
from warp_psdr.accuracy import quantity

NAMES = ["floor.bsdf.reflectance.value", "lamp.emitter.radiance.value"]
#: Sums of float32 in another order.
ROUNDING = 2e-6


def integrator(method):
    return psdr.PathIntegrator(max_depth=4, interior=method)


@pytest.fixture(scope="module")
def lit():
    scene = psdr.load_dict(corner(lamp=lamp()))
    params = psdr.traverse(scene)
    params.requires_grad_only(*NAMES)
    return scene, params


def added(what, spp, seed):
    """Return the terms of a quantity, added up."""
    assert [part.name for part in what.parts[1:]] == ["light paths"]
    return what.finished(sum(part.run(spp, seed) for part in what.parts))


def test_terms_add_up_to_what_the_drivers_return(lit):
    """Of bidirectional paths under a filter that reaches further: image, and derivatives in both modes."""
    scene, params = lit
    options = {"integrator": integrator(psdr.interior.Bidirectional())}
    image = added(quantity.image(scene, sensor=0, **options), 16, 5)
    drawn = psdr.render(scene, spp=16, seed=5, **options).numpy()
    np.testing.assert_allclose(image, drawn.reshape(-1), rtol=1e-5, atol=ROUNDING * drawn.max())
    params.zero_grad()
    psdr.render_backward(scene, params, weights(8), spp=16, seed=5, **options)
    expected = np.concatenate([params[name].grad.numpy() for name in NAMES])
    found = added(quantity.gradient(scene, params, weights(8), sensor=0, **options), 16, 5)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    tangents = {name: np.ones(3, np.float32) for name in NAMES}
    found = added(quantity.derivative(scene, params, tangents, sensor=0, **options), 16, 5)
    drawn = psdr.render_forward(scene, params, tangents, spp=16, seed=5, **options).numpy()
    np.testing.assert_allclose(found, drawn.reshape(-1), rtol=1e-5, atol=ROUNDING * np.abs(drawn).max())


@pytest.mark.slow
def test_budgets_and_comparisons_take_light_paths(lit):
    scene, params = lit
    options = {"integrator": integrator(psdr.interior.Bidirectional())}
    report = psdr.accuracy(scene, params, weights(8), seconds=1.0, clock="cpu", **options)
    assert [term.name for term in report.terms] == ["interior", "light paths"]
    assert all(term.seconds > 0.0 for term in report.terms) and report.seconds_to(0.01) > 0.0
    params.zero_grad()
    psdr.render_backward(scene, params, weights(8), spp=4096, seed=9, **options)
    expected = [params[name].grad.numpy().copy() for name in NAMES]
    params.zero_grad()
    reached = psdr.render_backward(scene, params, weights(8), target_error=0.01, report=report, **options)
    assert reached.error < 0.02
    for name, value in zip(NAMES, expected, strict=True):
        np.testing.assert_allclose(params[name].grad.numpy(), value, rtol=0.06)
    # Light tracing leaves the derivative by a reflectance to light paths alone.
    params.requires_grad_only(NAMES[0])
    methods = [psdr.interior.LightTracing(), psdr.interior.Bidirectional(), psdr.interior.Replay()]
    found = psdr.interior.compare(
        scene, params, weights(8), methods=methods, integrator=integrator("auto"), seconds=1.0, clock="cpu"
    )
    assert {row.method for row in found.rows} == set(methods) and all(row.seconds > 0.0 for row in found.rows)
    params.requires_grad_only(*NAMES)


@pytest.mark.slow
@pytest.mark.parametrize("method", [psdr.interior.LightTracing(), psdr.interior.Bidirectional(connections="all")])
def test_moments_tell_the_variance_of_images(method):
    scene = psdr.load_dict(corner(lamp=lamp()) | {"camera": camera_of("box", size=8)})
    spp, repeats = 32, 24
    options = {"integrator": integrator(method), "spp": spp}
    found = [[a.numpy().astype(float) for a in psdr.render_moment(scene, seed=s, **options)] for s in range(repeats)]
    images, seconds = (np.array(values) for values in zip(*found, strict=True))
    predicted = (seconds - images**2) / (spp - 1)
    deviations = (images - images.mean(axis=0)) ** 2 * repeats / (repeats - 1)
    assert_same_mean(deviations.mean(axis=(1, 2, 3)), predicted.mean(axis=(1, 2, 3)), "variance")
    direct = np.array([psdr.render(scene, seed=900 + s, **options).numpy().astype(float) for s in range(repeats)])
    assert_same_mean(images.mean(axis=(1, 2, 3)), direct.mean(axis=(1, 2, 3)), "mean")

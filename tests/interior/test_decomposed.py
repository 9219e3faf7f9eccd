"""Decomposed branches: unbiased, equal in both modes, with everything else replayed beside them."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients.measure import shared_random_numbers
from tests.interior.test_resampled import (
    DIFFERENCES,
    ROUNDING,
    SCENES,
    SIZE,
    SLOPE,
    Z,
    assert_the_mean_by_roughness_is_that_of_replay,
    backward,
    integrator,
    load,
)

GLOSSY = ["metal", "beckmann metal", "brushed metal", "phong", "orennayar"]
#: Scene -> weights of mixtures: two smooth models, a mirror and paint, lobes of one model, and the index of refraction,
#: by which a coat and the base below it share the light.
MIXTURES = {
    "blend": ["ball.bsdf.weight.value"],
    "half mirror": ["ball.bsdf.weight.value"],
    "mask": ["ball.bsdf.opacity.value"],
    "principled": ["ball.bsdf.metallic.value", "ball.bsdf.clearcoat.value"],
    "plastic": ["ball.bsdf.eta"],
}


def forward(name, tangents, method, seed, *, spp=4, depth=3):
    scene, params = load(name)
    options = {"integrator": integrator(method, depth), "spp": spp, "seed": seed}
    return psdr.render_forward(scene, params, tangents, **options).numpy().astype(np.float64)


def signs(name, parameter):
    """Weights of pixels by the sign of their derivative: a lobe's energy hardly depends on its shape."""
    return np.sign(forward(name, {parameter: 1.0}, psdr.interior.Resampled(), 77, spp=256)).astype(np.float32)


def test_mean_by_roughness_is_that_of_replay():
    assert_the_mean_by_roughness_is_that_of_replay(psdr.interior.Decomposed())


@pytest.mark.slow
@pytest.mark.parametrize("name", GLOSSY)
def test_mean_is_that_of_replay(name):
    _material, branched, _others = SCENES[name]
    batches, spp = (32, 8) if name == "metal" else (64, 16)
    for parameter in branched:
        weights = signs(name, parameter)
        a = backward(name, [parameter], psdr.interior.Replay(), range(batches), spp=spp, weights=weights)[:, 0]
        b = backward(
            name, [parameter], psdr.interior.Decomposed(), range(900, 900 + batches), spp=spp, weights=weights
        )[:, 0]
        error = np.sqrt(a.var(ddof=1) / batches + b.var(ddof=1) / batches)
        assert abs(a.mean()) > 5.0 * error > 0.0, "there is a derivative to compare"
        assert abs(a.mean() - b.mean()) < Z * error, (parameter, a.mean(), b.mean(), error)


@pytest.mark.slow
@pytest.mark.parametrize("name", MIXTURES)
def test_mean_by_weights_is_that_of_replay(name):
    for parameter in MIXTURES[name]:
        weights = signs(name, parameter)
        a = backward(name, [parameter], psdr.interior.Replay(), range(64), spp=16, weights=weights)[:, 0]
        b = backward(name, [parameter], psdr.interior.Decomposed(), range(900, 964), spp=32, weights=weights)[:, 0]
        error = np.sqrt(a.var(ddof=1) / 64 + b.var(ddof=1) / 64)
        assert abs(a.mean()) > 5.0 * error > 0.0, "there is a derivative to compare"
        assert abs(a.mean() - b.mean()) < Z * error, (parameter, a.mean(), b.mean(), error)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["blend", "mask", "principled", "plastic"])
def test_forward_mode_by_weights_sums_to_reverse_mode(name):
    """One weight has the samples of reverse mode; several at once have the sum of their derivatives."""
    grey = np.random.default_rng(4).normal(size=(SIZE, SIZE, 1)).astype(np.float32) * np.ones(3, np.float32)
    method, names = psdr.interior.Decomposed(), MIXTURES[name]
    if len(names) == 1:
        reverse = backward(name, names, method, [11], weights=grey)[0, 0]
        found = grey * forward(name, {names[0]: 1.0}, method, 11)
        scale = np.abs(found).sum()
        assert abs(found.sum() - reverse) <= ROUNDING * scale and abs(reverse) > 10.0 * ROUNDING * scale
        return
    weights = signs(name, names[0])
    tangents = {names[0]: 1.0, names[1]: -0.7}
    a = backward(name, names, method, range(32), spp=16, weights=weights) @ [1.0, -0.7]
    b = np.array([(weights * forward(name, tangents, method, 900 + s, spp=16)).sum() for s in range(32)])
    error = np.sqrt(a.var(ddof=1) / 32 + b.var(ddof=1) / 32)
    assert abs(a.mean()) > 5.0 * error and abs(a.mean() - b.mean()) < Z * error


@pytest.mark.slow
@pytest.mark.parametrize("name", ["brushed metal", "phong", "abc"])
def test_several_roughnesses_take_turns(name):
    _material, branched, _others = SCENES[name]
    weights = signs(name, branched[0])
    a = backward(name, branched, psdr.interior.Replay(), range(64), spp=16, weights=weights)
    b = backward(name, branched, psdr.interior.Decomposed(), range(900, 964), spp=16, weights=weights)
    error = np.sqrt(a.var(0, ddof=1) / 64 + b.var(0, ddof=1) / 64)
    assert (np.abs(a.mean(0)) > 5.0 * error).all() and (np.abs(a.mean(0) - b.mean(0)) < Z * error).all()


@pytest.mark.slow
def test_the_rest_is_replayed_beside_it():
    _material, branched, others = SCENES["metal"]
    alone = backward("metal", others, psdr.interior.Replay(), [5])[0]
    beside = backward("metal", branched + others, psdr.interior.Decomposed(), [5])[0]
    np.testing.assert_allclose(beside[1:], alone, rtol=ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*GLOSSY, "abc"])
def test_forward_mode_sums_to_reverse_mode(name):
    # Grey: forward mode chooses vertices by the colours alike.
    grey = np.random.default_rng(4).normal(size=(SIZE, SIZE, 1)).astype(np.float32) * np.ones(3, np.float32)
    method = psdr.interior.Decomposed()
    for parameter in SCENES[name][1]:
        reverse = backward(name, [parameter], method, [11], weights=grey)[0, 0]
        found = grey * forward(name, {parameter: 1.0}, method, 11)
        scale = np.abs(found).sum()
        assert abs(found.sum() - reverse) <= ROUNDING * scale and abs(reverse) > 10.0 * ROUNDING * scale


@pytest.mark.slow
def test_forward_mode_takes_two_roughnesses_at_once():
    names = SCENES["brushed metal"][1]
    method, tangents = psdr.interior.Decomposed(), {names[0]: 1.0, names[1]: -0.7}
    weights = np.sign(forward("brushed metal", tangents, psdr.interior.Resampled(), 77, spp=256))
    found = [
        [(weights * forward("brushed metal", tangents, m, s, spp=16)).sum() for s in range(first, first + 48)]
        for m, first in ((psdr.interior.Replay(), 0), (method, 900))
    ]
    (a, b), (da, db) = np.mean(found, 1), np.std(found, 1, ddof=1) / np.sqrt(48)
    assert abs(a) > 5.0 * np.hypot(da, db) and abs(a - b) < Z * np.hypot(da, db)


def test_equal_bits_for_any_number_of_workers():
    try:
        found = []
        for workers in (1, 2, 5):
            psdr.set_workers(workers)
            found.append(backward("metal", SCENES["metal"][1], psdr.interior.Decomposed(), [3]))
    finally:
        psdr.set_workers(None)
    assert (found[0] == found[1]).all() and (found[0] == found[2]).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameter", "step"),
    [
        ("metal", "ball.bsdf.alpha.value", 0.01),
        ("brushed metal", "ball.bsdf.alpha_v.value", 0.02),
        ("phong", "ball.bsdf.nu.value", 2.0),
        ("abc", "ball.bsdf.B.value", 4.0),
        ("orennayar", "ball.bsdf.sigma.value", 0.04),
        ("blend", "ball.bsdf.weight.value", 0.05),
        ("plastic", "ball.bsdf.eta", 0.02),
    ],
)
def test_slope_of_finite_differences(name, parameter, step):
    scene, params = load(name)
    value = params[parameter].numpy().copy()
    weights = signs(name, parameter)
    gradient = backward(name, [parameter], psdr.interior.Decomposed(), range(20), spp=64, weights=weights)[:, 0]

    def loss(change, seed):
        params[parameter] = value + np.float32(change)
        params.update()
        image = psdr.render(scene, integrator=integrator(psdr.interior.Replay()), spp=512, seed=seed).numpy()
        return (image.astype(np.float64) * weights).sum()

    try:
        with shared_random_numbers():
            slopes = np.array([(loss(step, s) - loss(-step, s)) / (2.0 * step) for s in range(DIFFERENCES)])
    finally:
        params[parameter] = value
        params.update()
    noise = np.hypot(*(x.std(ddof=1) / np.sqrt(len(x)) for x in (slopes, gradient))) / abs(slopes.mean())
    assert noise < SLOPE / 2.0
    assert abs(gradient.mean() / slopes.mean() - 1.0) < SLOPE + 2.0 * noise


@pytest.mark.slow
def test_less_noise_than_replay_at_equal_samples():
    def variance(method):
        return np.var([forward("metal", {SCENES["metal"][1][0]: 1.0}, method, s, depth=2) for s in range(12)], 0).sum()

    assert variance(psdr.interior.Replay()) > 3.0 * variance(psdr.interior.Decomposed())


@pytest.mark.parametrize(
    ("name", "parameter", "message"),
    [
        ("plastic", "ball.bsdf.alpha", r"not those of alpha of 'roughplastic'\. Use interior\.Resampled\(\)"),
        ("principled", "ball.bsdf.roughness.value", r"roughness of 'principled'\. Use interior\.Resampled\(\)"),
        ("metal", "ball.bsdf.eta.value", r"eta of 'roughconductor'\. Use interior\.Resampled\(\)"),
        ("abc", "ball.bsdf.eta.value", r"eta of 'abc'\. Use interior\.Resampled\(\)"),
        ("metal", "floor.bsdf.reflectance.value", r"Decomposed\(\) draws .* no parameter .* Use interior\.Replay\(\)"),
    ],
)
def test_refuses(name, parameter, message):
    with pytest.raises(ValueError, match=message):
        psdr.plan(load(name)[0], names=[parameter], integrator=integrator(psdr.interior.Decomposed()))


def test_the_plan_names_it():
    plan = psdr.plan(load("metal")[0], names=SCENES["metal"][1], integrator=integrator(psdr.interior.Decomposed()))
    _item, decision, reason = next(line for line in plan.lines if line[0] == "interior")
    assert decision.startswith("decomposed branches") and reason.startswith("a lobe of each sign; 16 light points")

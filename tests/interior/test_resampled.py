"""Resampled branches: unbiased, equal in both modes, with everything else replayed beside them."""

import functools

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.gradients.measure import NO_ROULETTE, shared_random_numbers
from tests.gradients.scenes import rgb
from warp_psdr.kernels.interior.resampled import make_resampling

SIZE = 16
#: Difference of two means over their standard error that independent batches exceed once in 16,000 tries.
Z = 4.0
#: Noise of correlated differences and of the derivative, and the difference's own error.
SLOPE = 0.02
#: Correlated differences.
DIFFERENCES = 32
#: Sums in another order.
ROUNDING = 1e-5

#: Name -> (material of the ball, what is branched, what is replayed beside it).
SCENES = {
    "metal": (
        {
            "type": "roughconductor",
            "distribution": "ggx",
            "alpha": 0.15,
            "eta": rgb(0.2, 0.9, 1.1),
            "k": rgb(3.9, 2.4, 2.2),
        },
        ["ball.bsdf.alpha.value"],
        ["ball.bsdf.specular_reflectance.value", "floor.bsdf.reflectance.value"],
    ),
    "plastic": (
        {"type": "roughplastic", "distribution": "ggx", "alpha": 0.2, "diffuse_reflectance": rgb(0.5, 0.2, 0.1)},
        ["ball.bsdf.alpha", "ball.bsdf.eta"],
        ["ball.bsdf.diffuse_reflectance.value"],
    ),
    "principled": (
        {"type": "principled", "base_color": rgb(0.7, 0.4, 0.2), "roughness": 0.35, "metallic": 0.6, "clearcoat": 0.5},
        ["ball.bsdf.roughness.value", "ball.bsdf.metallic.value", "ball.bsdf.clearcoat.value"],
        ["ball.bsdf.base_color.value"],
    ),
    "blend": (
        {
            "type": "blendbsdf",
            "weight": 0.4,
            "bsdf_0": {"type": "diffuse", "reflectance": rgb(0.6, 0.3, 0.1)},
            "bsdf_1": {"type": "roughconductor", "distribution": "ggx", "alpha": 0.2},
        },
        ["ball.bsdf.weight.value"],
        ["ball.bsdf.bsdf_0.reflectance.value"],
    ),
    "beckmann metal": (
        {"type": "roughconductor", "distribution": "beckmann", "alpha": 0.1, "material": "Au"},
        ["ball.bsdf.alpha.value"],
        ["ball.bsdf.eta.value"],
    ),
    "brushed metal": (
        {"type": "roughconductor", "distribution": "ggx", "alpha_u": 0.1, "alpha_v": 0.3, "material": "Cu"},
        ["ball.bsdf.alpha_u.value", "ball.bsdf.alpha_v.value"],
        ["floor.bsdf.reflectance.value"],
    ),
    "phong": (
        {"type": "ashikhminshirley", "nu": 20.0, "nv": 80.0, "specular_reflectance": rgb(0.3, 0.4, 0.5)},
        ["ball.bsdf.nu.value", "ball.bsdf.nv.value"],
        ["ball.bsdf.reflectance.value"],
    ),
    "abc": (
        {"type": "abc", "A": 2.0, "B": 60.0, "C": 1.3, "eta": rgb(0.2, 0.9, 1.1), "k": rgb(4, 2, 2)},
        ["ball.bsdf.A.value", "ball.bsdf.B.value", "ball.bsdf.C.value"],
        ["ball.bsdf.specular_reflectance.value"],
    ),
    "orennayar": (
        {"type": "orennayar", "sigma": 0.4, "reflectance": rgb(0.7, 0.5, 0.4)},
        ["ball.bsdf.sigma.value"],
        ["ball.bsdf.reflectance.value"],
    ),
    "mask": (
        {"type": "mask", "opacity": 0.6, "nested": {"type": "roughconductor", "distribution": "ggx", "alpha": 0.3}},
        ["ball.bsdf.opacity.value"],
        ["ball.bsdf.nested_bsdf.specular_reflectance.value"],
    ),
    "half mirror": (
        {
            "type": "blendbsdf",
            "weight": 0.4,
            "bsdf_0": {"type": "diffuse", "reflectance": rgb(0.6, 0.3, 0.1)},
            "bsdf_1": {"type": "conductor", "eta": rgb(0.2, 0.9, 1.1), "k": rgb(3.9, 2.4, 2.2)},
        },
        ["ball.bsdf.weight.value", "ball.bsdf.bsdf_1.k.value"],
        [],
    ),
}


@functools.cache
def load(name: str):
    look_at, scale, translate = psdr.Transform.look_at, psdr.Transform.scale, psdr.Transform.translate
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    pose = look_at([0, -4, 1.2], [0, 0, 0.2], [0, 0, 1])
    lamp = translate([0.5, -1.5, 3.0]) @ psdr.Transform.rotate([1, 0, 0], 180.0)
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 35.0, "to_world": pose, "film": film},
            "ball": {"type": "sphere", "bsdf": SCENES[name][0]},
            "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": rgb(6, 5, 4)}},
            "floor": {
                "type": "rectangle",
                "to_world": translate([0.0, 0.0, -1.0]) @ scale(4.0),
                "bsdf": {"type": "diffuse", "reflectance": rgb(0.6, 0.4, 0.3)},
            },
            "sky": {"type": "constant", "radiance": rgb(0.3, 0.3, 0.4)},
        }
    )  # fmt: skip
    return scene, psdr.traverse(scene)


def integrator(method, depth=3, **options):
    return psdr.PathIntegrator(max_depth=depth, rr_depth=NO_ROULETTE, interior=method, boundary=None, **options)


def adjoint():
    return np.random.default_rng(3).uniform(0.5, 1.5, size=(SIZE, SIZE, 3)).astype(np.float32)


def backward(name, parameters, method, seeds, *, spp=4, weights=None, depth=3):
    """Gradients of some parameters, a row a seed, float64."""
    scene, params = load(name)
    params.requires_grad_only(*parameters)
    weights = adjoint() if weights is None else weights
    rows = []
    for seed in seeds:
        params.zero_grad()
        psdr.render_backward(scene, params, weights, integrator=integrator(method, depth), spp=spp, seed=seed)
        rows.append(np.concatenate([params[n].grad.numpy().ravel() for n in parameters]))
    assert not any(psdr.invalid_samples(scene).values())
    return np.array(rows, np.float64)


def assert_equal_means(a, b):
    error = np.sqrt(a.var(0, ddof=1) / len(a) + b.var(0, ddof=1) / len(b))
    assert (error > 0.0).all() and (np.abs(a.mean(0)) > 3.0 * error).all(), "there is a derivative to compare"
    z = (a.mean(0) - b.mean(0)) / error
    assert np.abs(z).max() < Z, z


@functools.cache
def make_chooser(candidates: int):
    choose = make_resampling(candidates).choose

    @wp.kernel(module="unique", enable_backward=False)
    def chooser(t: wp.array(dtype=wp.float32), steps: int, out: wp.array(dtype=wp.float64)):
        for i in range(steps):
            for j in range(steps):
                u = wp.vec2((wp.float32(i) + 0.5) / wp.float32(steps), (wp.float32(j) + 0.5) / wp.float32(steps))
                chosen = choose(t, u)
                if chosen.first < 0:
                    out[0] = out[0] + wp.float64(chosen.first_weight)
                if chosen.first >= 0:
                    out[chosen.first] = out[chosen.first] + wp.float64(chosen.first_weight)
                if chosen.second >= 0:
                    out[chosen.second] = out[chosen.second] + wp.float64(chosen.second_weight)

    return chooser


@pytest.mark.parametrize("kind", ["two signs", "nearly one sign", "one sign", "zeros"])
def test_every_candidate_counts_as_much_as_it_would_without_a_choice(kind):
    t = np.random.default_rng(7).normal(size=16).astype(np.float32)
    if kind == "nearly one sign":
        t = np.where(t < 0.0, 0.02 * t, t).astype(np.float32)
    if kind == "one sign":
        t = -np.abs(t)
    if kind == "zeros":
        t[::2] = 0.0
    steps = 512
    out = wp.zeros(16, dtype=wp.float64, device="cpu")
    wp.launch(make_chooser(16), dim=1, inputs=[wp.array(t, device="cpu"), steps, out], device="cpu")
    # The steps of the quadrature: a candidate's share of the numbers is rounded to one of them.
    error = np.abs(t).sum() / steps / np.maximum(np.abs(t), 1e-30)
    assert (np.abs(16.0 * out.numpy() / steps**2 - (t != 0.0)) <= np.where(t != 0.0, error, 0.0)).all()


def test_a_target_that_is_not_a_number_is_seen():
    t = np.full(4, 0.5, np.float32)
    t[2] = np.nan
    out = wp.zeros(4, dtype=wp.float64, device="cpu")
    wp.launch(make_chooser(4), dim=1, inputs=[wp.array(t, device="cpu"), 2, out], device="cpu")
    assert np.isnan(out.numpy()).any()


def assert_the_mean_by_roughness_is_that_of_replay(method, batches=32):
    replay, found = (
        backward("metal", SCENES["metal"][1], interior, range(first, first + batches))
        for interior, first in ((psdr.interior.Replay(), 0), (method, 1000))
    )
    assert_equal_means(replay, found)


def test_mean_by_roughness_is_that_of_replay():
    assert_the_mean_by_roughness_is_that_of_replay(psdr.interior.Resampled())


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_mean_is_that_of_replay(name):
    _material, branched, others = SCENES[name]
    batches = 32 if name == "metal" else 64
    spp = 4 if name == "metal" else 16
    replay = backward(name, branched + others, psdr.interior.Replay(), range(batches), spp=spp)
    resampled = backward(name, branched + others, psdr.interior.Resampled(), range(1000, 1000 + batches), spp=spp)
    assert_equal_means(replay, resampled)


@pytest.mark.slow
def test_the_rest_is_replayed_beside_it():
    _material, branched, others = SCENES["metal"]
    alone = backward("metal", others, psdr.interior.Replay(), [5])[0]
    beside = backward("metal", branched + others, psdr.interior.Resampled(), [5])[0]
    np.testing.assert_allclose(beside[1:], alone, rtol=ROUNDING)


@pytest.mark.slow
def test_forward_mode_sums_to_reverse_mode():
    scene, params = load("metal")
    name = SCENES["metal"][1][0]
    for spp, depth in ((4, 3), (1, 2)):
        ones = np.ones((SIZE, SIZE, 3), np.float32)
        reverse = backward("metal", [name], psdr.interior.Resampled(), [11], spp=spp, weights=ones, depth=depth)[0, 0]
        options = {"integrator": integrator(psdr.interior.Resampled(), depth), "spp": spp, "seed": 11}
        forward = psdr.render_forward(scene, params, {name: 1.0}, **options).numpy().astype(np.float64).sum()
        assert abs(forward - reverse) <= ROUNDING * abs(reverse) and reverse != 0.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["blend", "mask"])
def test_forward_mode_by_weights_sums_to_reverse_mode(name):
    """With candidates of both ends. Grey: forward mode chooses vertices by the colours alike."""
    scene, params = load(name)
    parameter = SCENES[name][1][0]
    grey = np.random.default_rng(4).normal(size=(SIZE, SIZE, 1)).astype(np.float32) * np.ones(3, np.float32)
    reverse = backward(name, [parameter], psdr.interior.Resampled(), [11], weights=grey)[0, 0]
    options = {"integrator": integrator(psdr.interior.Resampled()), "spp": 4, "seed": 11}
    found = grey * psdr.render_forward(scene, params, {parameter: 1.0}, **options).numpy().astype(np.float64)
    scale = np.abs(found).sum()
    assert abs(found.sum() - reverse) <= ROUNDING * scale and abs(reverse) > 10.0 * ROUNDING * scale


def test_equal_bits_for_any_number_of_workers():
    name = SCENES["metal"][1]
    try:
        found = []
        for workers in (1, 2, 5):
            psdr.set_workers(workers)
            found.append(backward("metal", name, psdr.interior.Resampled(), [3]))
    finally:
        psdr.set_workers(None)
    assert (found[0] == found[1]).all() and (found[0] == found[2]).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameter", "step"),
    [
        ("metal", "ball.bsdf.alpha.value", 0.01),
        ("plastic", "ball.bsdf.alpha", 0.01),
        ("principled", "ball.bsdf.roughness.value", 0.02),
        ("blend", "ball.bsdf.weight.value", 0.05),
        ("half mirror", "ball.bsdf.weight.value", 0.05),
    ],
)
def test_slope_of_finite_differences(name, parameter, step):
    scene, params = load(name)
    value, method = params[parameter].numpy().copy(), psdr.interior.Resampled()
    params.requires_grad_only(parameter)
    # A lobe's energy hardly depends on its shape: so every pixel counts with the sign of its derivative.
    image = psdr.render_forward(scene, params, {parameter: 1.0}, integrator=integrator(method), spp=256, seed=77)
    weights = np.sign(image.numpy())
    gradient = backward(name, [parameter], method, range(20), spp=64, weights=weights).sum(1)

    def loss(change, seed):
        params[parameter] = value + np.float32(change)
        params.update()
        return (
            psdr.render(scene, integrator=integrator(psdr.interior.Replay()), spp=512, seed=seed).numpy() * weights
        ).sum()

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
@pytest.mark.parametrize("method", [psdr.interior.Resampled(), psdr.interior.Decomposed()])
@pytest.mark.parametrize(("name", "value"), [("mask", 0.0), ("mask", 1.0), ("blend", 0.0), ("blend", 0.02)])
def test_derivatives_where_a_lobe_is_hardly_there(name, value, method):
    """At the ends of a weight or an opacity, where one of the lobes adds nothing to the image, and near them."""
    _scene, params = load(name)
    parameter = SCENES[name][1][0]
    before = params[parameter].numpy().copy()
    params[parameter] = np.float32(value) * np.ones_like(before)
    params.update()
    try:
        replay = backward(name, [parameter], psdr.interior.Replay(), range(64), spp=16)
        drawn = backward(name, [parameter], method, range(1000, 1064), spp=16)
    finally:
        params[parameter] = before
        params.update()
    assert_equal_means(replay, drawn)


@pytest.mark.slow
def test_less_noise_than_replay_at_equal_samples():
    scene, params = load("metal")
    name = SCENES["metal"][1][0]
    params.requires_grad_only(name)

    def variance(method):
        options = {"integrator": integrator(method, 2), "spp": 4}
        return np.var(
            [psdr.render_forward(scene, params, {name: 1.0}, seed=s, **options).numpy() for s in range(12)], 0
        ).sum()

    assert variance(psdr.interior.Replay()) > 3.0 * variance(psdr.interior.Resampled())


@pytest.mark.parametrize("candidates", [0, 1, 5, 289, 16.0, True])
def test_candidates_are_a_square(candidates):
    with pytest.raises(ValueError, match=r"candidates: got .*expected a square from 4 to 256"):
        psdr.interior.Resampled(candidates=candidates)


def test_refuses_what_is_not_branched():
    scene, _params = load("metal")
    names = ["ball.bsdf.specular_reflectance.value"]
    with pytest.raises(ValueError, match=r"no parameter that is requested is one .* Use interior\.Replay\(\)"):
        psdr.plan(scene, names=names, integrator=integrator(psdr.interior.Resampled()))


def test_refuses_lights_of_no_area_behind_masks():
    mask = {"type": "mask", "opacity": 0.5, "nested": {"type": "roughconductor", "alpha": 0.2}}
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective"},
            "ball": {"type": "sphere", "bsdf": mask},
            "lamp": {"type": "point", "intensity": 1.0},
        }
    )
    shape, opacity = "ball.bsdf.nested_bsdf.alpha.value", "ball.bsdf.opacity.value"
    with pytest.raises(ValueError, match=r"lights of no area .* Use interior\.Replay\(\), or area lights"):
        psdr.plan(scene, names=[shape], integrator=integrator(psdr.interior.Resampled()))
    with pytest.raises(ValueError, match=r"lights of no area .* Use interior\.Replay\(\), or area lights"):
        psdr.plan(scene, names=[opacity], integrator=integrator(psdr.interior.Resampled()))


def test_the_plan_names_it():
    scene, _params = load("metal")
    plan = psdr.plan(scene, names=SCENES["metal"][1], integrator=integrator(psdr.interior.Resampled()))
    _item, decision, reason = next(line for line in plan.lines if line[0] == "interior")
    assert decision.startswith("resampled branches") and reason.startswith("16 candidates")

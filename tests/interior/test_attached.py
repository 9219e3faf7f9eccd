"""Attached samples: the table against its toy, unbiased where they are offered, refused where they are not."""

import functools
import itertools

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.gradients.measure import NO_ROULETTE, shared_random_numbers
from tests.gradients.scenes import rgb
from tests.interior.test_resampled import assert_equal_means
from warp_psdr.kernels.bsdf.microfacet import make_reflection
from warp_psdr.kernels.bsdf.motion import SampleMotion, make_reflection_motion
from warp_psdr.options.combinations import EDGES, MOVING_LIGHT, SAMPLES, TABLE, UNMOVED, WEIGHTS, combination
from warp_psdr.topology.outlook import has_in_front

Attached = psdr.interior.Attached
ATTACHED = Attached(bsdf="attached", weights="attached")
ALPHA = "thing.bsdf.alpha.value"
SIZE = 16
#: Noise of correlated differences and of the derivative, and the difference's own error.
SLOPE = 0.02
#: Sums in another order.
ROUNDING = 1e-5
#: What the table's numbers are rounded by, and a bias that is none.
ROUNDED, NO_BIAS = 0.006, 1e-3

# ---- The toy: light L(x) times f(x), seen by samples of p_b (parameter "alpha") and of p_e (parameter "light").

A, M, WIDTH = 0.5, 0.4, 0.6
Z = np.linspace(-9.0, 9.0, 100_001)
#: Of the random numbers; and a step into the complex plane, which has the derivative of every sample without an error.
SHARE, STEP = np.exp(-0.5 * Z * Z) / np.sqrt(2.0 * np.pi) * (Z[1] - Z[0]), 1e-30


def normal(x, width):
    return np.exp(-x * x / (2.0 * width * width)) / (width * np.sqrt(2.0 * np.pi))


def density_e(x, m):
    return normal(x - m, WIDTH)


def value(x, a):
    return normal(x, a) * (1.0 + 0.3 * x * x)


LIGHTS = {
    "smooth": lambda x, m: 1.0 / (1.0 + ((x - m) / 0.5) ** 2),
    "step": lambda x, m: np.where(np.real(x - m) > 0.0, 1.0, 0.0),
}


@functools.cache
def toy(light, parameter, bsdf, emitter, weights):
    """Mean and variance of the estimate of a derivative by two samples, one of each technique."""
    a = A + (STEP * 1j if parameter == "alpha" else 0.0)
    m = M + (STEP * 1j if parameter == "light" else 0.0)
    of_b, of_e = (a if bsdf == "attached" else A), (m if emitter == "attached" else M)
    x_b, x_e = of_b * Z, of_e + WIDTH * Z

    def weight(x, other):
        p, q = {"attached": (a, m), "position": (A, M), "detached": (A, M)}[weights]
        x = np.real(x) if weights == "detached" else x
        b, e = normal(x, p), density_e(x, q)
        return (e if other else b) / (b + e)

    found = [
        np.imag(weight(x_b, False) * value(x_b, a) * LIGHTS[light](x_b, m) / normal(x_b, of_b)) / STEP,
        np.imag(weight(x_e, True) * value(x_e, a) * LIGHTS[light](x_e, m) / density_e(x_e, of_e)) / STEP,
    ]
    means = [f @ SHARE for f in found]
    return sum(means), sum(f * f @ SHARE - mean * mean for f, mean in zip(found, means, strict=True))


@functools.cache
def toy_exact(light, parameter):
    dx = Z[1] - Z[0]
    if parameter == "alpha":
        return np.imag(value(Z, A + STEP * 1j)) @ LIGHTS[light](Z, M) * dx / STEP
    low, high = (value(Z, A) @ LIGHTS[light](Z, m) * dx for m in (M - 0.01, M + 0.01))
    return (high - low) / 0.02


@pytest.mark.parametrize("row", TABLE, ids=lambda row: "-".join((row.bsdf[-1], row.emitter[-1], row.weights[-1])))
def test_the_toy_finds_the_numbers_of_the_table(row):
    light = "step" if row.when else "smooth"
    exact = toy_exact(light, row.parameter)
    assert abs(exact - row.exact) < ROUNDED
    for choice in itertools.product(row.bsdf, row.emitter, row.weights):
        found, variance = toy(light, row.parameter, *choice)
        assert (abs(found - exact) < NO_BIAS) == row.right, choice
    assert abs(found - row.found) < ROUNDED and abs(variance - row.variance) < ROUNDED


def test_every_choice_has_a_row():
    for choice in itertools.product(SAMPLES, SAMPLES, WEIGHTS):
        row = combination(*choice)
        if row.offered:
            assert Attached(**dict(zip(("bsdf", "emitter", "weights"), choice, strict=True))).combination is row
        else:
            with pytest.raises(ValueError, match="is biased" if not row.right else "is not offered") as caught:
                Attached(**dict(zip(("bsdf", "emitter", "weights"), choice, strict=True)))
            assert row.reason in str(caught.value) and (row.right or row.numbers in str(caught.value))


@pytest.mark.parametrize("name", ["bsdf", "emitter", "weights"])
def test_unknown_choices_are_named(name):
    with pytest.raises(ValueError, match=rf"{name}: got 'reparametrised', expected one of 'detached'.*WarpedArea"):
        Attached(**{name: "reparametrised"})


# ---- How samples move.


@functools.cache
def make_mover(distribution):
    sample, pdf = make_reflection(distribution).sample, make_reflection(distribution).pdf
    motion = make_reflection_motion(distribution)

    @wp.kernel(module="unique", enable_backward=False)
    def mover(
        wi: wp.array(dtype=wp.vec3),
        alpha: wp.array(dtype=wp.vec2),
        v: wp.array(dtype=wp.vec2),
        seen: wp.array(dtype=wp.vec3),
        moved: wp.array(dtype=wp.vec3),
        density: wp.array(dtype=wp.float32),
        found: wp.array(dtype=SampleMotion),
    ):
        i = wp.tid()
        moved[i] = sample(wi[i], alpha[i][0], alpha[i][1], v[i])
        density[i] = pdf(wi[i], seen[i], alpha[i][0], alpha[i][1])
        found[i] = motion(wi[i], moved[i], alpha[i][0], alpha[i][1], v[i])

    return mover


@pytest.mark.parametrize("distribution", ["ggx", pytest.param("beckmann", marks=pytest.mark.slow)])
def test_velocities_are_those_of_the_sampling_routine(distribution):
    n, h = 500, 2e-3
    rng = np.random.default_rng(5)
    wi = rng.normal(size=(n, 3))
    wi[:, 2] = np.abs(wi[:, 2]) + 0.2
    wi[0] = (0.0, 0.0, 1.0)
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    alpha, v = rng.uniform(0.1, 0.6, (n, 2)), rng.uniform(0.05, 0.95, (n, 2))

    def run(roughness, seen):
        given = [(wi, wp.vec3), (roughness, wp.vec2), (v, wp.vec2), (seen, wp.vec3)]
        given = [wp.array(x.astype(np.float32), dtype=t, device="cpu") for x, t in given]
        out = [wp.zeros(n, dtype=t, device="cpu") for t in (wp.vec3, wp.float32, SampleMotion)]
        wp.launch(make_mover(distribution), dim=n, inputs=[*given, *out], device="cpu")
        return [x.numpy() for x in out]

    wo, _density, found = run(alpha, wi)
    above = wo[:, 2] > 0.1
    assert above.sum() > n / 2
    for axis, name in enumerate(("by_u", "by_v")):
        step = np.zeros(2)
        step[axis] = h
        high, low = run(alpha + step, wo), run(alpha - step, wo)
        velocity = (high[0] - low[0])[above] / (2.0 * h)
        np.testing.assert_allclose(found[name][above], velocity, atol=0.01 * np.abs(velocity).max())
        assert np.abs(velocity).max() > 1.0
        rate = np.log(high[1] / low[1])[above] / (2.0 * h)
        np.testing.assert_allclose(found["log_pdf"][above, axis], rate, atol=0.01 * np.abs(rate).max())


# ---- Estimates.


def sky(kind):
    if kind == "constant":
        return {"type": "constant", "radiance": rgb(0.3, 0.5, 0.8)}
    theta, phi = np.linspace(0.0, np.pi, 9)[:, None], (np.arange(16) + 0.5) / 8.0 * np.pi
    waves = (np.cos(theta) + 0.0 * phi, 0.8 * np.sin(theta) * np.cos(phi), 0.9 * np.sin(theta) * np.sin(2.0 * phi))
    return {"type": "envmap", "bitmap": 1.1 + np.stack(waves, -1).astype(np.float32)}


def metal(distribution="ggx", **roughness):
    optics = {"eta": rgb(0.2, 0.9, 1.1), "k": rgb(3.9, 2.4, 2.2)}
    return {"type": "roughconductor", "distribution": distribution, **(roughness or {"alpha": 0.1}), **optics}


def description(bsdf, kind="envmap", plate=False, **more):
    ball = {"type": "sphere", "face_normals": True, "bsdf": bsdf}
    turned = psdr.Transform.rotate([1, 0, 0], 20.0)
    thing = {"type": "rectangle", "to_world": turned, "bsdf": {"type": "twosided", "nested": bsdf}} if plate else ball
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    pose = psdr.Transform.look_at([0, -4, 1.2], [0, 0, 0], [0, 0, 1])
    sensor = {"type": "perspective", "fov": 35.0, "to_world": pose, "film": film}
    return {"type": "scene", "sensor": sensor, "thing": thing, "sky": sky(kind), **more}


#: Name -> (scene, what is attached, what is replayed beside it).
SCENES = {
    "ball": (description(metal()), [ALPHA], ["thing.bsdf.specular_reflectance.value"]),
    "near specular": (description(metal(alpha=0.02)), [ALPHA], ["sky.scale"]),
    "Beckmann": (description(metal("beckmann", alpha=0.2)), [ALPHA], []),
    "plate": (
        description(metal(alpha_u=0.1, alpha_v=0.3), kind="constant", plate=True),
        ["thing.bsdf.brdf_0.alpha_u.value", "thing.bsdf.brdf_0.alpha_v.value"],
        ["sky.radiance.value"],
    ),
    "floor and lamp": (
        description(
            metal(),
            kind="constant",
            lamp={"type": "rectangle", "to_world": psdr.Transform.look_at([1, -2, 2], [0, 0, 0], [0, 0, 1]),
                  "emitter": {"type": "area", "radiance": 4.0}},
        ),
        [ALPHA],
        [],
    ),
    "lights of no area": (
        description(
            metal(alpha=0.2),
            sun={"type": "directional", "direction": [0.2, 0.6, -1.0], "irradiance": 2.0},
            point={"type": "point", "position": [-2.0, -2.0, 1.0], "intensity": rgb(6.0, 4.0, 2.0)},
        ),
        [ALPHA],
        ["sun.irradiance.value", "point.intensity.value"],
    ),
    "lamp behind": (
        description(metal())
        | {
            "thing": {"type": "rectangle", "bsdf": metal(alpha=0.2)},
            "lamp": {"type": "rectangle", "to_world": psdr.Transform.translate([0.0, 0.0, -2.0]),
                     "emitter": {"type": "area", "radiance": 3.0}},
        },
        [ALPHA],
        ["lamp.emitter.radiance.value"],
    ),
}  # fmt: skip


@functools.cache
def load(name):
    scene = psdr.load_dict(SCENES[name][0])
    return scene, psdr.traverse(scene)


def integrator(method, depth=3):
    return psdr.PathIntegrator(max_depth=depth, rr_depth=NO_ROULETTE, interior=method, boundary=None)


def adjoint():
    return np.random.default_rng(3).uniform(0.5, 1.5, size=(SIZE, SIZE, 3)).astype(np.float32)


def backward(name, parameters, method, seeds, *, spp=16, weights=None):
    """Gradients of some parameters, a row a seed, float64."""
    scene, params = load(name)
    params.requires_grad_only(*parameters)
    weights = adjoint() if weights is None else weights
    rows = []
    for seed in seeds:
        params.zero_grad()
        psdr.render_backward(scene, params, weights, integrator=integrator(method), spp=spp, seed=seed)
        rows.append(np.concatenate([params[n].grad.numpy().ravel() for n in parameters]))
    assert not any(psdr.invalid_samples(scene).values())
    return np.array(rows, np.float64)


def slope_of(name, parameter, method, step, *, batches, spp):
    """The derivative over correlated differences of images, and the noise of that ratio."""
    scene, params = load(name)
    value = params[parameter].numpy().copy()
    gradient = backward(name, [parameter], method, range(batches), spp=spp).sum(1)

    def loss(change, seed):
        params[parameter] = value + np.float32(change)
        params.update()
        image = psdr.render(scene, integrator=integrator(psdr.interior.Replay()), spp=4 * spp, seed=seed)
        return (image.numpy().astype(np.float64) * adjoint()).sum()

    try:
        with shared_random_numbers():
            slopes = np.array([(loss(step, s) - loss(-step, s)) / (2.0 * step) for s in range(batches)])
    finally:
        params[parameter] = value
        params.update()
    noise = np.hypot(*(x.std(ddof=1) / np.sqrt(len(x)) for x in (slopes, gradient))) / abs(slopes.mean())
    return gradient.mean() / slopes.mean(), noise


def test_slope_of_finite_differences():
    slope, noise = slope_of("ball", ALPHA, ATTACHED, 0.01, batches=32, spp=64)
    assert noise < SLOPE / 2.0
    assert abs(slope - 1.0) < SLOPE + 2.0 * noise


@pytest.mark.slow
def test_forward_mode_sums_to_reverse_mode():
    scene, params = load("ball")
    ones = np.ones((SIZE, SIZE, 3), np.float32)
    reverse = backward("ball", [ALPHA], ATTACHED, [11], spp=4, weights=ones)[0, 0]
    options = {"integrator": integrator(ATTACHED), "spp": 4, "seed": 11}
    forward = psdr.render_forward(scene, params, {ALPHA: 1.0}, **options).numpy().astype(np.float64).sum()
    assert abs(forward - reverse) <= ROUNDING * abs(reverse) and abs(reverse) > 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "bsdf", "weights"),
    [
        ("ball", "attached", "attached"),
        ("ball", "attached", "position"),
        ("ball", "detached", "attached"),
        ("near specular", "attached", "attached"),
        ("Beckmann", "attached", "attached"),
        ("Beckmann", "attached", "position"),
        ("plate", "attached", "attached"),
        ("plate", "attached", "position"),
        ("floor and lamp", "detached", "attached"),
        ("lights of no area", "attached", "attached"),
        ("lamp behind", "attached", "attached"),
    ],
)
def test_mean_is_that_of_replay(name, bsdf, weights):
    _description, attached, others = SCENES[name]
    method = Attached(bsdf=bsdf, weights=weights)
    replay = backward(name, attached + others, psdr.interior.Replay(), range(64), spp=64)
    found = backward(name, attached + others, method, range(1000, 1064), spp=64)
    assert_equal_means(replay, found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameter", "weights", "step"),
    [
        ("ball", ALPHA, "position", 0.01),
        ("Beckmann", ALPHA, "attached", 0.01),
        ("plate", SCENES["plate"][1][0], "attached", 0.03),
    ],
)
def test_more_slopes_of_finite_differences(name, parameter, weights, step):
    slope, noise = slope_of(name, parameter, Attached(bsdf="attached", weights=weights), step, batches=64, spp=256)
    assert noise < SLOPE / 2.0
    assert abs(slope - 1.0) < SLOPE + 2.0 * noise


@pytest.mark.slow
def test_all_detached_is_replay_and_attached_weights_only_add_noise():
    replay = backward("ball", [ALPHA], psdr.interior.Replay(), range(64))
    assert (replay == backward("ball", [ALPHA], Attached(), range(64))).all()
    assert (replay == backward("ball", [ALPHA], Attached(weights="position"), range(64))).all()
    assert backward("ball", [ALPHA], Attached(weights="attached"), range(64)).var() > 1.05 * replay.var()


@pytest.mark.slow
def test_less_noise_than_replay_where_metal_is_nearly_specular():
    variance = {m: backward("near specular", [ALPHA], m, range(32)).var() for m in (psdr.interior.Replay(), ATTACHED)}
    assert variance[psdr.interior.Replay()] > 4.0 * variance[ATTACHED]


@pytest.mark.slow
def test_the_rest_is_replayed_beside_it():
    _description, attached, others = SCENES["ball"]
    alone = backward("ball", others, psdr.interior.Replay(), [5])[0]
    np.testing.assert_allclose(backward("ball", attached + others, ATTACHED, [5])[0, 1:], alone, rtol=ROUNDING)


# ---- Refusals.


def refused(scene, names, method=ATTACHED):
    with pytest.raises(ValueError, match=r"interior\.Attached\(bsdf=") as caught:
        psdr.plan(psdr.load_dict(scene), names=names, integrator=integrator(method))
    return str(caught.value)


def test_directions_that_may_cross_edges_are_refused():
    (row,) = [row for row in TABLE if row.when == EDGES]
    floor = {"type": "rectangle", "to_world": psdr.Transform.translate([0, 0, -1.5])}
    lamp = SCENES["floor and lamp"][0]["lamp"]
    smooth = {"type": "sphere", "bsdf": metal()}
    for scene, said in (
        (description(metal(), floor=floor), "rays that leave 'thing' may meet surfaces"),
        (description(metal(), lamp=lamp), "rays that leave 'thing' may meet surfaces"),
        (description(metal()) | {"thing": smooth}, "interpolated normals"),
    ):
        text = refused(scene, [ALPHA])
        assert said in text and row.numbers in text and row.reason in text


def test_light_that_moves_is_refused():
    (row,) = [row for row in TABLE if row.when == MOVING_LIGHT]
    for name in ("lamp.to_world", "lamp.vertex_positions"):
        for method in (Attached(), ATTACHED):
            text = refused(SCENES["floor and lamp"][0], [name], method)
            assert row.numbers in text and row.reason in text


def test_what_it_does_not_move_is_refused():
    assert "no parameter that is requested is one" in refused(description(metal()), ["sky.scale"])
    mixed = {"type": "blendbsdf", "weight": 0.5, "a": metal(), "b": {"type": "diffuse"}}
    name = "thing.bsdf.bsdf_0.alpha.value"
    assert "no parameter that is requested is one" in refused(description(mixed), [name])
    # Lobes that are chosen by chance, the choice by the roughness among it, and directions into the body.
    parameters = {
        "roughdielectric": "alpha",
        "roughplastic": "alpha",
        "principled": "roughness",
        "ashikhminshirley": "nu",
        "abc": "B",
        "orennayar": "sigma",
    }
    for other, parameter in parameters.items():
        bsdf = {"type": other, parameter: 0.2, **({"A": 1.0, "C": 2.0} if other == "abc" else {})}
        params = psdr.traverse(psdr.load_dict(description(bsdf)))
        name = next(n for n in params if n.startswith(f"thing.bsdf.{parameter}"))
        text = refused(description(bsdf), [name])
        assert repr(other) in text and UNMOVED[other] in text and "interior.Replay()" in text


def test_the_plan_names_the_choice():
    scene, _params = load("ball")
    plan = psdr.plan(scene, names=[ALPHA], integrator=integrator(ATTACHED))
    _item, decision, reason = next(line for line in plan.lines if line[0] == "interior")
    assert decision.startswith("attached samples") and "weights attached" in reason


def test_what_lies_in_front():
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    square = np.array([[0, 4, 6], [0, 6, 2]])  # of z = 0, seen from above
    assert has_in_front(corners, square, 1.0, False) and not has_in_front(corners, square, -1.0, False)
    assert has_in_front(corners, square, -1.0, True) and not has_in_front(corners[[0, 2, 4, 6]], square // 2, 1.0, True)

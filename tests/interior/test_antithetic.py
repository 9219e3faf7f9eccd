"""Pairs by what turns normals, mirrored and resampled: unbiased, equal in both modes, all else replayed beside them."""

import functools

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.gradients.configs import shift, turn
from tests.gradients.measure import NO_ROULETTE, shared_random_numbers
from tests.gradients.scenes import noise, rgb
from warp_psdr.estimate.passes import camera_gradient_kernels
from warp_psdr.kernels.interior.factors.half_vectors import mirrored
from warp_psdr.kernels.interior.factors.opposite import sort_by
from warp_psdr.options.interior import Branches
from warp_psdr.plan import choice

SIZE = 16
#: Difference of two means over their standard error that independent batches exceed once in 16,000 tries.
Z = 4.0
#: Noise of correlated differences and of the derivative, and the difference's own error.
SLOPE = 0.02
#: Sums in another order.
ROUNDING = 2e-5

#: Both draw pairs by what turns normals.
PAIRS = pytest.mark.parametrize(
    "method", [psdr.interior.Antithetic(), psdr.interior.Resampled()], ids=["mirrored", "resampled"]
)


def metal(alpha, distribution="ggx"):
    index = {"eta": rgb(0.2, 0.9, 1.1), "k": rgb(3.9, 2.4, 2.2)}
    return {"type": "roughconductor", "distribution": distribution, "alpha": alpha, **index}


def tilted(*direction):
    """Tilt normals, or a normal map's colours, all alike."""
    return lambda values: np.broadcast_to(np.asarray(direction, float), values.shape)


def random_heights(values):
    return noise(*values.shape, low=-1.0, high=1.0, seed=4)


BUMPS = {"type": "bitmap", "data": noise(4, 4, 1, seed=8), "raw": True}
BRUSHED = {"type": "roughconductor", "distribution": "ggx", "alpha_u": 0.1, "alpha_v": 0.3, "material": "Au"}
WHITE = {"type": "diffuse", "reflectance": rgb(0.6, 0.4, 0.3)}
#: Name -> (material of the ball, of the floor, {what is paired: along what}, what is replayed beside it).
SCENES = {
    "mapped": (
        {"type": "normalmap", "normalmap": rgb(0.55, 0.48, 0.9), "nested": metal(0.1)},
        WHITE,
        {"ball.bsdf.normalmap.value": (tilted(1.0, 0.0, 0.0), tilted(0.0, 1.0, 0.0))},
        ["ball.bsdf.nested_bsdf.specular_reflectance.value", "floor.bsdf.reflectance.value"],
    ),
    "moved": (
        metal(0.15, "beckmann"),
        {"type": "twosided", "nested": metal(0.2)},
        {"ball.to_world": (shift(1.0, 0.3, 0.2),), "floor.vertex_normals": (tilted(0.0, 1.0, 0.0),)},
        ["ball.bsdf.alpha.value"],
    ),
    "bumped": (
        {"type": "bumpmap", "bumps": BUMPS, "scale": 0.05, "nested": BRUSHED},
        {"type": "principled", "base_color": rgb(0.7, 0.4, 0.2), "roughness": 0.35, "metallic": 0.6},
        {"ball.bsdf.nested_texture.data": (random_heights,), "floor.to_world": (turn(1.0, 0.0, 0.0),)},
        ["floor.bsdf.base_color.value"],
    ),
    "glass": (
        {"type": "roughdielectric", "alpha": 0.15},
        WHITE,
        {"ball.vertex_normals": (tilted(1.0, 0.0, 0.0), tilted(0.0, 1.0, 0.3))},
        ["floor.bsdf.reflectance.value"],
    ),
}


@functools.cache
def load(name: str):
    look_at, scale, translate = psdr.Transform.look_at, psdr.Transform.scale, psdr.Transform.translate
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    lamp = translate([0.5, -1.5, 3.0]) @ psdr.Transform.rotate([1, 0, 0], 180.0)
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 35.0,
                "to_world": look_at([0, -4, 1.2], [0, 0, 0.2], [0, 0, 1]),
                "film": film,
            },
            "ball": {"type": "sphere", "bsdf": SCENES[name][0]},
            "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": rgb(6, 5, 4)}},
            "floor": {
                "type": "rectangle",
                "to_world": translate([0.0, 0.0, -1.1]) @ scale(4.0),
                "bsdf": SCENES[name][1],
            },
            "sky": {"type": "constant", "radiance": rgb(0.3, 0.3, 0.4)},
        }
    )
    return scene, psdr.traverse(scene)


def integrator(method, depth=3):
    return psdr.PathIntegrator(max_depth=depth, rr_depth=NO_ROULETTE, interior=method, boundary=None)


def adjoint():
    return np.random.default_rng(3).uniform(0.5, 1.5, size=(SIZE, SIZE, 3)).astype(np.float32)


def directions(params, name):
    """Yield (parameter, direction) of what is paired in a scene."""
    for parameter, tangents in SCENES[name][2].items():
        for tangent in tangents:
            yield parameter, np.asarray(tangent(params[parameter].numpy()), np.float32)


def backward(name, parameters, method, seeds, *, spp=4, weights=None):
    """Gradients of some parameters, a row a seed, float64."""
    scene, params = load(name)
    params.requires_grad_only(*parameters)
    weights = adjoint() if weights is None else weights
    rows = []
    for seed in seeds:
        params.zero_grad()
        psdr.render_backward(scene, params, weights, integrator=integrator(method), spp=spp, seed=seed)
        rows.append(np.concatenate([params[p].grad.numpy().ravel() for p in parameters]))
    assert not any(psdr.invalid_samples(scene).values())
    return np.array(rows, np.float64)


def forward(name, parameter, tangent, method, seed, *, spp=4, depth=3):
    scene, params = load(name)
    options = {"integrator": integrator(method, depth), "spp": spp, "seed": seed}
    return psdr.render_forward(scene, params, {parameter: tangent}, **options).numpy().astype(np.float64)


def signs(name, parameter, tangent, spp=64):
    """Weights of pixels by the sign of their derivative: a lobe's energy hardly depends on where it points."""
    return np.sign(forward(name, parameter, tangent, psdr.interior.Antithetic(), 77, spp=spp)).astype(np.float32)


@pytest.mark.slow
@PAIRS
@pytest.mark.parametrize("name", ["mapped", *(pytest.param(n, marks=pytest.mark.slow) for n in list(SCENES)[1:])])
def test_mean_is_that_of_replay(name, method):
    batches, spp = (32, 16) if name == "mapped" else (64, 32)
    for parameter, tangent in directions(load(name)[1], name):
        found = []
        weights = signs(name, parameter, tangent)
        for first, drawn in ((0, psdr.interior.Replay()), (1000, method)):
            rows = backward(name, [parameter], drawn, range(first, first + batches), spp=spp, weights=weights)
            found.append(rows @ tangent.ravel().astype(np.float64))
        a, b = found
        error = np.sqrt(a.var(ddof=1) / batches + b.var(ddof=1) / batches)
        assert abs(a.mean()) > 5.0 * error > 0.0, "there is a derivative to compare"
        assert abs(a.mean() - b.mean()) < Z * error, (parameter, a.mean(), b.mean(), error)


@pytest.mark.slow
@PAIRS
def test_the_rest_is_replayed_beside_it(method):
    _ball, _floor, paired, others = SCENES["mapped"]
    first = sum(load("mapped")[1][name].size for name in paired)
    replay = backward("mapped", [*paired, *others], psdr.interior.Replay(), [5])[0]
    beside = backward("mapped", [*paired, *others], method, [5])[0]
    assert not np.allclose(beside[:first], replay[:first])
    np.testing.assert_allclose(beside[first:], replay[first:], rtol=ROUNDING)


@pytest.mark.slow
@PAIRS
@pytest.mark.parametrize("name", ["mapped", *(pytest.param(n, marks=pytest.mark.slow) for n in list(SCENES)[1:])])
def test_forward_mode_sums_to_reverse_mode(name, method):
    # Grey: forward mode chooses vertices by the colours alike.
    grey = np.random.default_rng(4).normal(size=(SIZE, SIZE, 1)).astype(np.float32) * np.ones(3, np.float32)
    for parameter, tangent in directions(load(name)[1], name):
        reverse = backward(name, [parameter], method, [11], weights=grey)[0] @ tangent.ravel().astype(np.float64)
        found = grey * forward(name, parameter, tangent, method, 11)
        scale = np.abs(found).sum()
        assert abs(found.sum() - reverse) <= ROUNDING * scale and abs(reverse) > 10.0 * ROUNDING * scale


def test_equal_bits_for_any_number_of_workers():
    try:
        found = []
        for workers in (1, 2, 5):
            psdr.set_workers(workers)
            found.append(backward("mapped", list(SCENES["mapped"][2]), psdr.interior.Antithetic(), [3]))
    finally:
        psdr.set_workers(None)
    assert (found[0] == found[1]).all() and (found[0] == found[2]).all()


@pytest.mark.slow
@PAIRS
@pytest.mark.parametrize(
    ("name", "parameter", "tangent", "step", "differences"),
    [
        ("mapped", "ball.bsdf.normalmap.value", tilted(1.0, 0.0, 0.0), 0.01, 64),
        ("moved", "floor.vertex_normals", tilted(0.0, 1.0, 0.0), 0.02, 64),
    ],
)
def test_slope_of_finite_differences(name, parameter, tangent, step, differences, method):
    scene, params = load(name)
    value = params[parameter].numpy().copy()
    tangent = np.asarray(tangent(value), np.float32)
    weights = signs(name, parameter, tangent, spp=256)
    gradient = backward(name, [parameter], method, range(40), spp=512, weights=weights) @ tangent.ravel()

    def loss(change, seed):
        params[parameter] = value + np.float32(change) * tangent
        params.update()
        image = psdr.render(scene, integrator=integrator(psdr.interior.Replay()), spp=512, seed=seed).numpy()
        return (image.astype(np.float64) * weights).sum()

    try:
        with shared_random_numbers():
            slopes = np.array([(loss(step, s) - loss(-step, s)) / (2.0 * step) for s in range(differences)])
    finally:
        params[parameter] = value
        params.update()
    noise_of_both = np.hypot(*(x.std(ddof=1) / np.sqrt(len(x)) for x in (slopes, gradient))) / abs(slopes.mean())
    assert noise_of_both < SLOPE / 2.0
    assert abs(gradient.mean() / slopes.mean() - 1.0) < SLOPE + 2.0 * noise_of_both


@pytest.mark.slow
def test_less_noise_than_replay_at_equal_samples():
    parameter, tangent = next(directions(load("mapped")[1], "mapped"))

    def variance(method):
        return np.var([forward("mapped", parameter, tangent, method, s, depth=2) for s in range(12)], 0).sum()

    assert variance(psdr.interior.Replay()) > 2.0 * variance(psdr.interior.Antithetic())


@wp.kernel(module="unique", enable_backward=False)
def sort_them(key: wp.array(dtype=wp.float32), t: wp.array(dtype=wp.float32), order: wp.array(dtype=wp.int32)):
    sort_by(key, t, order)


def test_candidates_are_sorted():
    keys = np.random.default_rng(5).permutation([*range(12), 3, 3, 7, 0]).astype(np.float32)
    key, t = wp.array(keys, device="cpu"), wp.array(np.arange(16, dtype=np.float32), device="cpu")
    order = wp.zeros(16, dtype=int, device="cpu")
    wp.launch(sort_them, dim=1, inputs=[key, t, order], device="cpu")
    expected = np.argsort(keys, kind="stable")
    assert key.numpy().tolist() == np.sort(keys).tolist()
    assert order.numpy().tolist() == t.numpy().tolist() == expected.tolist()


@pytest.mark.slow
def test_at_grazing_angles_resampled_pairs_have_the_least_noise():
    """A brushed plate under an even sky, seen at 80 degrees, by texels of its normal map: alpha tan(theta) is 1.1."""
    look_at, n = psdr.Transform.look_at, 16
    height, far = 10.0 * np.cos(np.radians(80.0)), 10.0 * np.sin(np.radians(80.0))
    bumps = np.random.default_rng(1).normal(size=(n, n, 3)) * [0.06, 0.06, 0.0] + [0.0, 0.0, 1.0]
    colors = (0.5 + 0.5 * bumps / np.linalg.norm(bumps, axis=-1, keepdims=True)).astype(np.float32)
    texture = {"type": "bitmap", "data": colors, "raw": True}
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    pose = look_at([-far, 0.0, height], [0, 0, 0], [0, 1, 0])
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 2.2, "to_world": pose, "film": film},
            "plate": {
                "type": "rectangle",
                "to_world": psdr.Transform.scale([1.2, 0.2, 1.0]),
                "bsdf": {"type": "normalmap", "normalmap": texture, "nested": metal(0.2)},
            },
            "sky": {"type": "constant"},
        }
    )
    params = psdr.traverse(scene)
    params.requires_grad("plate.bsdf.normalmap.data")
    variance = {}
    for method in (psdr.interior.Replay(), psdr.interior.Antithetic(), psdr.interior.Resampled()):
        rows = []
        for seed in range(12):
            params.zero_grad()
            psdr.render_backward(
                scene, params, np.ones((8, 8, 3), np.float32), integrator=integrator(method, 2), spp=16, seed=seed
            )
            rows.append(params["plate.bsdf.normalmap.data"].grad.numpy().copy())
        variance[type(method).__name__] = np.var(rows, axis=0, dtype=np.float64).sum()
    assert variance["Replay"] > 6.0 * variance["Resampled"]
    assert variance["Antithetic"] > 4.0 * variance["Resampled"]


@wp.kernel(module="unique", enable_backward=False)
def mirror_them(
    wi: wp.vec3,
    m: wp.vec3,
    eta: wp.float32,
    wo: wp.array(dtype=wp.vec3),
    wo_out: wp.array(dtype=wp.vec3),
    j_out: wp.array(dtype=wp.vec2),
):
    i = wp.tid()
    r = mirrored(wi, wo[i], m, eta)
    wo_out[i] = r.wo
    j_out[i] = wp.vec2(r.own, r.other)


def reflected(wi, wo, m, eta=1.0):
    count = len(wo)
    found, factors = wp.zeros(count, dtype=wp.vec3, device="cpu"), wp.zeros(count, dtype=wp.vec2, device="cpu")
    directions = wp.array(wo.astype(np.float32), dtype=wp.vec3, device="cpu")
    inputs = [wp.vec3(*wi), wp.vec3(*m), eta, directions, found, factors]
    wp.launch(mirror_them, dim=count, inputs=inputs, device="cpu")
    return found.numpy().astype(np.float64), factors.numpy().astype(np.float64)


def unit(v):
    return np.asarray(v) / np.linalg.norm(v, axis=-1, keepdims=True)


@pytest.mark.parametrize("eta", [1.0, 1.5, 1.0 / 1.5, -1.5])
@pytest.mark.parametrize("theta", [0.1, 0.8, 1.3])
def test_partners_are_partners_and_keep_the_measure_of_half_vectors(theta, eta):
    """A negative index: from below."""
    m = unit([0.1, -0.2, 1.0])
    wi = unit([np.sin(theta), 0.1, np.cos(theta) * np.sign(eta)])
    mirror = functools.partial(reflected, eta=abs(eta))
    wo = unit(np.random.default_rng(5).normal(size=(4000, 3)))
    partner, factors = mirror(wi, wo, m)
    if eta != 1.0:
        through = factors[:, 1] * (wi @ m) * (wo @ m) < 0.0
        # In the denser medium, beyond the critical angle, the partner of a facet that refracts reflects all.
        assert through.sum() > 100 or (abs(eta) < 1.0 and theta > 0.7)
    there = factors[:, 1] > 0.0
    assert there.any() and not there.all()
    back, again = mirror(wi, partner[there], m)
    np.testing.assert_allclose(back, wo[there], atol=2e-4)
    plain = factors[there].max(axis=1) < 20.0  # those of what leaves along the facet are ill-conditioned
    np.testing.assert_allclose(again[plain, ::-1], factors[there][plain], rtol=1e-3, atol=1e-4)
    # Where it is smooth: dw' / dw by differences of tangent vectors is the ratio of the factors.
    pick = np.flatnonzero(there & (factors.min(1) > 0.5) & (factors.max(1) < 20.0))[:200]
    s = unit(np.cross(wo[pick], [0.3, 1.0, 0.2]))
    t = np.cross(wo[pick], s)
    step = 4e-3
    ends = [mirror(wi, unit(wo[pick] + sign * step * e), m) for e in (s, t) for sign in (1.0, -1.0)]
    area = np.linalg.norm(np.cross(ends[0][0] - ends[1][0], ends[2][0] - ends[3][0]), axis=1) / (2.0 * step) ** 2
    inside = np.all([factors_there[:, 1] > 0.0 for _wo, factors_there in ends], axis=0)
    assert inside.sum() > 80
    np.testing.assert_allclose(area[inside], (factors[pick, 1] / factors[pick, 0])[inside], rtol=2e-2)


def test_what_passes_without_an_index_is_its_own_partner():
    _partner, factors = reflected(unit([0.5, 0.0, 1.0]), unit(np.array([[0.2, 0.1, -1.0]])), [0.0, 0.0, 1.0])
    assert factors.tolist() == [[1.0, 0.0]]


def plan_of(bsdf, names, **more):
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective"},
            "ball": {"type": "sphere", "bsdf": bsdf},
            "sky": {"type": "constant"},
            **more,
        }
    )
    return psdr.plan(scene, names=names, integrator=integrator(psdr.interior.Antithetic()))


@pytest.mark.parametrize(
    ("bsdf", "names", "more", "message"),
    [
        (metal(0.1), ["ball.bsdf.alpha.value"], {}, r"gain nothing\. Use interior\.Resampled\(\)"),
        (metal(0.1), ["ball.bsdf.specular_reflectance.value"], {}, r"no parameter .* Use interior\.Replay\(\)"),
        (WHITE, ["ball.to_world"], {}, r"the scene has none\. Use interior\.Replay\(\)"),
        (
            metal(0.1),
            ["ball.to_world"],
            {"mirror": {"type": "sphere", "radius": 0.1, "bsdf": {"type": "conductor"}}},
            r"smooth mirrors or glass; use interior\.Replay\(\)",
        ),
        (
            {"type": "mask", "nested": {"type": "normalmap", "normalmap": rgb(0.5, 0.5, 1.0), "nested": metal(0.1)}},
            ["ball.bsdf.nested_bsdf.normalmap.value"],
            {"lamp": {"type": "point", "intensity": 1.0}},
            r"lights of no area .* Use interior\.Replay\(\), or area lights",
        ),
    ],
)  # fmt: skip
def test_refuses(bsdf, names, more, message):
    with pytest.raises(ValueError, match=message):
        plan_of(bsdf, names, **more)


def test_the_plan_names_it():
    plan = plan_of(metal(0.1), ["ball.vertex_normals"])
    _item, decision, reason = next(line for line in plan.lines if line[0] == "interior")
    assert decision.startswith("antithetic pairs") and reason.startswith("a pair at one glossy vertex")


def test_the_scale_of_bumps_is_drawn_for_once():
    """It is a number of a glossy model, and it turns normals."""
    scene, _params = load("bumped")
    plan = psdr.plan(scene, names=["ball.bsdf.scale"], integrator=integrator("auto"))
    assert plan.offered == ("normals",)
    methods = [method for _kind, method in choice.candidates(plan)]
    assert methods == [Branches(normals="antithetic"), Branches(normals="resampled")]


def test_resampled_replays_vertices_that_move_beside_mirrors():
    mirror = {"type": "sphere", "radius": 0.1, "bsdf": {"type": "conductor"}}
    ball = {"type": "sphere", "bsdf": metal(0.1)}
    others = {"mirror": mirror, "sensor": {"type": "perspective"}, "sky": {"type": "constant"}}
    scene = psdr.load_dict({"type": "scene", "ball": ball, **others})
    resampled = integrator(psdr.interior.Resampled())
    plan = psdr.plan(scene, names=["ball.bsdf.alpha.value", "ball.to_world"], integrator=resampled)
    assert len(camera_gradient_kernels(plan, "reverse")) == 2
    with pytest.raises(ValueError, match=r"smooth mirrors or glass; use interior\.Replay\(\)"):
        psdr.plan(scene, names=["ball.to_world"], integrator=resampled)

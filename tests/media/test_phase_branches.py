"""Branches in media by g of ``hg``: lobes of their density, the derivatives of replay, both modes, what is refused."""

import functools

import numpy as np
import pytest
import warp as wp
from scipy import stats

import warp_psdr as psdr
from tests.gradients.measure import shared_random_numbers
from tests.interior.test_resampled import NO_ROULETTE
from tests.media.scenes import camera, cube, grid, grids, lamp, medium, point, puffs, rgb, sky, square, whole
from tests.path.helpers import SIGNIFICANCE
from warp_psdr.kernels.phase.hg import hg_slope
from warp_psdr.kernels.phase.hg_lobes import hg_lobe_cosine, hg_lobe_mass

SIZE = 16
#: Difference of two means over their standard error that independent batches exceed once in 16,000 tries.
Z = 4.0
#: Noise of correlated differences and of the derivative, and the difference's own error.
SLOPE = 0.02
ROUNDING = 1e-5
DRAWS = 100_000
METHODS = {"decomposed": psdr.interior.Decomposed(), "resampled": psdr.interior.Resampled()}
FLOOR = square(-1.2, 3.0, {"type": "diffuse", "reflectance": rgb(0.6, 0.4, 0.2)})
VIEW = ([3.5, 0.5, 0.6], [0, 0, 0], 30.0, SIZE)


def ball(y, interior):
    """A sphere: rays that run along the edges of a cube are lost, one in a million samples."""
    pose = psdr.Transform.translate([0, y, 0]) @ psdr.Transform.scale(0.65)
    return {"type": "sphere", "to_world": pose, "bsdf": {"type": "null"}, "interior": interior}


def scene_of(name):
    parts = {"sensor": camera(*VIEW), "floor": FLOOR}
    if name == "lamp":
        parts |= {"haze": ball(0.0, medium(1.2, (0.9, 0.8, 0.7), g=0.6)), "lamp": lamp(3.0, 1.2)}
    if name == "smoke":
        parts |= {"haze": cube(grids(grid(puffs(8)), 0.9, g=-0.4, scale=3.0)), "sky": sky(1.0, 0.8, 0.6)}
    if name == "bulb":
        parts |= {
            "haze": ball(0.7, medium(1.0, 0.9, g=0.0)),
            "air": ball(-0.7, {**medium(0.6, 0.9), "phase": {"type": "rayleigh"}}),
            "bulb": point([2.0, -1.5, 2.5], (4.0, 5.0, 6.0)),
        }
    return whole(**parts)


G = "haze.interior_medium.phase_function.g"
ALBEDO = "haze.interior_medium.albedo.value.value"


@functools.cache
def load(name):
    scene = psdr.load_dict(scene_of(name))
    return scene, psdr.traverse(scene)


def integrator(method, depth=4):
    return psdr.PathIntegrator(max_depth=depth, rr_depth=NO_ROULETTE, interior=method, boundary=None)


def backward(name, names, method, seeds, spp, weights=None):
    scene, params = load(name)
    params.requires_grad_only(*names)
    weights = np.ones((SIZE, SIZE, 3), np.float32) if weights is None else weights
    rows = []
    for seed in seeds:
        params.zero_grad()
        psdr.render_backward(scene, params, weights, integrator=integrator(method), spp=spp, seed=seed)
        rows.append(np.concatenate([params[n].grad.numpy().ravel() for n in names]))
    assert not any(psdr.invalid_samples(scene).values())
    return np.array(rows, np.float64)


@functools.cache
def make_drawing():
    @wp.kernel(module="unique", enable_backward=False)
    def phase_drawing(
        g: wp.float32, u: wp.array(dtype=wp.float32), mu_out: wp.array2d(dtype=wp.float32),
        slope_out: wp.array2d(dtype=wp.float32), mass_out: wp.array(dtype=wp.float32),
    ):  # fmt: skip
        i = wp.tid()
        for k in range(2):
            mu_out[i, k] = hg_lobe_cosine(g, k == 1, u[i])
            slope_out[i, k] = hg_slope(g, mu_out[i, k])
        mass_out[i] = hg_lobe_mass(g)

    return phase_drawing


@pytest.mark.parametrize("g", [-0.99, -0.6, 0.0, 1e-4, 0.3, 0.8, 0.95])
def test_cosines_have_the_density_of_a_lobe(g):
    """By Kolmogorov and Smirnov; the mass is the integral over a lobe, and each lobe has one sign."""
    u = np.random.default_rng(5).random(DRAWS).astype(np.float32)
    u[:2] = 0.0, 1.0 - 2.0**-24
    outputs = [wp.zeros(shape, dtype=wp.float32, device="cpu") for shape in ((DRAWS, 2), (DRAWS, 2), DRAWS)]
    wp.launch(make_drawing(), dim=DRAWS, inputs=[g, wp.array(u, device="cpu"), *outputs], device="cpu")
    mu, slope, mass = (x.numpy().astype(np.float64) for x in outputs)
    turn = g * (5.0 - g * g) / (3.0 + g * g)
    assert (slope[:, 0] <= 1e-4 * mass[0]).all() and (slope[:, 1] >= -1e-4 * mass[0]).all()

    def below(x):
        """Minus the derivative by g of the probability of a cosine below x, by differences in double precision."""
        h = 1e-4 * (1.0 - abs(g))

        def share(a):
            # (1 - a^2) / (2 a) (1 / q - 1 / (1 + a)) without the division by a.
            q = np.sqrt(1.0 + a * a - 2.0 * a * x)
            return (1.0 - a) * (1.0 + x) / (q * (1.0 + a + q))

        return -(share(g + h) - share(g - h)) / (2.0 * h)

    assert abs(mass[0] / below(np.array(turn)) - 1.0) < 1e-4
    # In float32 cosines near 1 are few where the lobe is a degree wide.
    inverted = 2e-3 if abs(g) < 0.9 else 5e-2
    assert np.abs(below(mu) / mass[:, None] - u[:, None]).max() < inverted
    for k, cdf in enumerate((lambda x: below(x) / mass[0], lambda x: 1.0 - below(x) / mass[0])):
        assert (mu[:, k] <= turn + 1e-5).all() if k == 0 else (mu[:, k] >= turn - 1e-5).all()
        assert stats.kstest(mu[:, k], cdf).pvalue > SIGNIFICANCE


OTHERS = [("lamp", "resampled"), *((n, m) for n in ("smoke", "bulb") for m in METHODS)]


@pytest.mark.slow_rows("lamp-decomposed")
@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("lamp", "decomposed"),
        *(pytest.param(n, m, marks=pytest.mark.slow) for n, m in OTHERS),
    ],
)
def test_mean_is_that_of_replay(name, method):
    batches, spp = (32, 32) if name == "lamp" else (64, 64)
    a = backward(name, [G, ALBEDO], psdr.interior.Replay(), range(batches), spp)
    b = backward(name, [G, ALBEDO], METHODS[method], range(900, 900 + batches), spp)
    error = np.sqrt(a.var(0, ddof=1) / batches + b.var(0, ddof=1) / batches)
    assert (np.abs(b.mean(0)) > 5.0 * error).all(), "there is a derivative to compare"
    assert (np.abs(a.mean(0) - b.mean(0)) < Z * error).all()


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_forward_mode_sums_to_reverse_mode(method):
    scene, params = load("lamp")
    # Grey: forward mode chooses collisions by the colours alike.
    grey = np.random.default_rng(4).normal(size=(SIZE, SIZE, 1)).astype(np.float32) * np.ones(3, np.float32)
    reverse = backward("lamp", [G], METHODS[method], [11], 16, grey)[0, 0]
    options = {"integrator": integrator(METHODS[method]), "spp": 16, "seed": 11}
    found = grey * psdr.render_forward(scene, params, {G: 1.0}, **options).numpy().astype(np.float64)
    scale = np.abs(found).sum()
    assert abs(found.sum() - reverse) <= ROUNDING * scale and abs(reverse) > 10.0 * ROUNDING * scale


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_slope_of_finite_differences(method):
    scene, params = load("lamp")
    value, step = params[G].numpy().copy(), 0.02
    weights = np.sign(
        psdr.render_forward(scene, params, {G: 1.0}, integrator=integrator(METHODS[method]), spp=256, seed=77).numpy()
    )
    gradient = backward("lamp", [G], METHODS[method], range(24), 128, weights)[:, 0]

    def loss(change, seed):
        params[G] = value + np.float32(change)
        params.update()
        image = psdr.render(scene, integrator=integrator(psdr.interior.Replay()), spp=512, seed=seed).numpy()
        return (image.astype(np.float64) * weights).sum()

    try:
        with shared_random_numbers():
            slopes = np.array([(loss(step, s) - loss(-step, s)) / (2.0 * step) for s in range(24)])
    finally:
        params[G] = value
        params.update()
    noise = np.hypot(*(x.std(ddof=1) / np.sqrt(len(x)) for x in (slopes, gradient))) / abs(slopes.mean())
    assert noise < SLOPE / 2.0
    assert abs(gradient.mean() / slopes.mean() - 1.0) < SLOPE + 2.0 * noise


def test_what_it_refuses_and_the_plan():
    scene, _params = load("lamp")
    for name, method in METHODS.items():
        with pytest.raises(ValueError, match=r"draws directions for g of 'hg' .* for interior\.Replay\(\)"):
            psdr.plan(scene, names=[ALBEDO], integrator=integrator(method))
        assert f"{name} branches" in str(psdr.plan(scene, names=[G], integrator=integrator(method)))
        blend = {"type": "blendphase", "weight": 0.4, "a": {"type": "hg", "g": 0.5}, "b": {"type": "isotropic"}}
        haze = cube({**medium(), "phase": blend})
        parts = {"sensor": camera(*VIEW), "haze": haze, "sky": sky(1.0, 1.0, 1.0)}
        other = psdr.load_dict(whole(**parts))
        with pytest.raises(ValueError, match=r"no other phase function\. Use interior\.Replay\(\)"):
            psdr.plan(other, names=["haze.interior_medium.phase_function.phase_0.g"], integrator=integrator(method))

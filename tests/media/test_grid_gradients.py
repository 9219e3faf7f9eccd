"""Derivatives of grids: formulas, where density or albedo is zero or touches a majorant; differences; both modes."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients import measure
from tests.gradients.configs import Case, mixed, ones
from tests.gradients.scenes import SCENES
from tests.gradients.scenes import SIZE as FILM
from tests.media import scenes
from tests.media.scenes import camera, cube, grid, grids, point, puffs, rgb, sky, square
from tests.media.test_grids import ALBEDO, COLUMN, DATA, SCALE, SIZE, WIDTH, set_values, slab
from tests.path.helpers import assert_mean

BATCHES = 8
NAMES = (DATA, ALBEDO, SCALE, "sky.radiance.value")
#: Both modes draw the same numbers: float32 sums of the same terms in another order, relative.
ROUNDING = 2e-5
#: Weights of the channels.
W = np.array([1.0, 0.5, -0.7])


@pytest.fixture(scope="module")
def scene():
    return psdr.load_dict(slab())


def gradients(scene, adjoint, depth, spp, names=NAMES, **options):
    """Gradients of each of BATCHES seeds, by name."""
    params = psdr.traverse(scene)
    params.requires_grad_only(*names)
    integrator = psdr.PathIntegrator(max_depth=depth, **options)
    found = {name: [] for name in names}
    for seed in range(BATCHES):
        params.zero_grad()
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=spp, seed=seed)
        for name in names:
            found[name].append(params[name].grad.numpy().astype(np.float64))
    assert psdr.invalid_samples(scene)["interior"] == 0
    return {name: np.stack(values) for name, values in found.items()}


def mean_weights():
    """The adjoint of the image's mean, its channels weighed by W."""
    return np.broadcast_to(W / SIZE**2, (SIZE, SIZE, 3)).astype(np.float32)


@pytest.mark.parametrize("column", ["layers", "plateau"])
def test_transmittance(scene, column):
    """-h T by each layer's density, also where it touches its majorant: there Mitsuba's derivative is zero."""
    values = COLUMN if column == "layers" else np.full((5, 3), 0.4)
    set_values(scene, data=np.asarray(values)[:, None, None, :], albedo=0.0, scale=1.5)
    found = gradients(scene, mean_weights(), 1, 2048)
    depth = 0.4 * np.asarray(values, np.float64).sum(axis=0)
    t = W * np.exp(-1.5 * depth)
    layers = found[DATA].sum(axis=(2, 3))
    assert_mean(layers, np.broadcast_to(-1.5 * 0.4 * t, (5, 3)), "by layer", WIDTH)
    assert_mean(found[SCALE], np.array([-(depth * t).sum()]), "by scale", WIDTH)
    assert_mean(found["sky.radiance.value"], t, "by the sky", WIDTH)


def test_where_nothing_is(scene):
    """Scattered once under a sky of 1, each layer's derivative is (a - 1) h where there is no density at all."""
    set_values(scene, data=0.0, albedo=0.6, scale=1.5)
    found = gradients(scene, mean_weights(), 2, 4096)
    expected = np.broadcast_to(1.5 * 0.4 * (0.6 - 1.0) * W, (5, 3))
    assert_mean(found[DATA].sum(axis=(2, 3)), expected, "no density", WIDTH)
    assert not found[ALBEDO].any() and not found[SCALE].any()


def smoke_scene():
    """Smoke with empty voxels and an albedo by voxel and channel, over a floor."""
    albedo = np.random.default_rng(0).uniform(0.1, 0.5, (3, 4, 5, 3))
    return {
        "sensor": camera([4, 3, 2.5], [0, 0, -0.3], 25.0, FILM),
        "floor": square(-1.2, 3.0, {"type": "diffuse", "reflectance": rgb(0.6, 0.4, 0.2)}),
        "cube": cube(grids(grid(0.4 * puffs(12)), grid(albedo), g=0.4), turn=20.0),
        "sky": sky(0.8, 0.9, 1.0),
        "sun": {"type": "directional", "direction": [0.8, -0.2, -0.5], "irradiance": rgb(1.0, 2.0, 3.0)},
        "bulb": point([2.0, -1.5, 2.5], (4.0, 5.0, 6.0)),
    }


def block(values):
    """A block of voxels, scaled."""
    chosen = np.zeros(values.shape)
    n = values.shape[0]
    chosen[n // 4 : 3 * n // 4, n // 4 : 3 * n // 4, n // 4 : 3 * n // 4] = 1.0
    return chosen * values


SCENES |= {"smoke": smoke_scene}
SMOKE = "cube.interior_medium."
#: Without density the same paths are drawn as in the differences.
TOGETHER = (SMOKE + "albedo.data", SMOKE + "phase_function.g", "floor.bsdf.reflectance.value", "sun.irradiance.value")
CASES = [
    Case("smoke", SMOKE + "albedo.data", mixed, 0.05, depth=4, spp=64),
    Case("smoke", SMOKE + "albedo.data", ones, 0.05, depth=4, spp=64),
    Case("smoke", "sun.irradiance.value", mixed, 0.05, depth=4, spp=64),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "mode"), [pytest.param(c, m, id=f"{c}-{m}") for c in CASES for m in ("reverse", "forward")]
)
def test_derivative_equals_finite_differences(case, mode):
    _scene, params = measure.load(case.scene)
    params.requires_grad_only(*TOGETHER)
    measure.assert_agrees(measure.compare(case, mode, 8, params.requested))


@pytest.mark.slow
def test_forward_and_reverse_mode_are_adjoint(scene):
    set_values(scene, data=COLUMN[:, None, None, :], albedo=0.7, scale=1.5)
    params = psdr.traverse(scene)
    params.requires_grad_only(*NAMES)
    w = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
    integrator = psdr.PathIntegrator(max_depth=5, rr_depth=3)
    psdr.render_backward(scene, params, w, integrator=integrator, spp=64, seed=2)
    for name in NAMES:
        found = params[name].grad.numpy().astype(np.float64)
        v = np.random.default_rng(len(name)).normal(size=found.shape).astype(np.float32)
        tangents = dict.fromkeys(NAMES, 0.0) | {name: v}
        image = psdr.render_forward(scene, params, tangents, integrator=integrator, spp=64, seed=2).numpy()
        left, right = (image.astype(np.float64) * w).sum(), (found * v).sum()
        bound = ROUNDING * max(np.linalg.norm(image) * np.linalg.norm(w), np.linalg.norm(found) * np.linalg.norm(v))
        assert found.any() and abs(left - right) <= bound, (name, left, right, bound)


def test_any_number_of_workers_gives_equal_bits(scene):
    set_values(scene, data=COLUMN[:, None, None, :], albedo=0.7, scale=1.5)
    first = gradients(scene, mean_weights(), 2, 64)
    before = psdr.set_workers(1)
    try:
        again = gradients(scene, mean_weights(), 2, 64)
    finally:
        psdr.set_workers(before)
    for name, found in first.items():
        assert found.any()
        np.testing.assert_array_equal(found, again[name])


DENSITIES = {"smoke": 0.6 * puffs(16), "plateau": np.full((8, 8, 8, 1), 0.8, np.float32)}
#: Of a scene, the direction in which its voxels change, and the step of differences.
DIRECTIONS = {
    ("smoke", "all"): (lambda values: values, 0.25),
    ("smoke", "block"): (block, 0.25),
    ("smoke", "empty"): (lambda values: 1.0 * (values == 0.0), 0.1),
    ("plateau", "all"): (np.ones_like, 0.1),
    ("plateau", "block"): (block, 0.25),
}


@pytest.fixture(scope="module")
def dense():
    """A scene and its derivatives by all voxels, a batch each, by name of the density."""
    found = {}

    def make(name):
        if name not in found:
            parts = {"sensor": camera([0.3, 0.2, 5], [0, 0, 0], 15.0, 8, up=(0, 1, 0)), "sky": sky(1.0, 0.8, 0.6)}
            parts["cube"] = cube(grids(grid(DENSITIES[name]), 0.2, g=0.4))
            scene = psdr.load_dict(scenes.whole(bulb=point([2, -1.5, 2.5], (2, 2, 2)), **parts))
            adjoint = np.full((8, 8, 3), 1.0 / 192.0, np.float32)
            by = gradients(scene, adjoint, 3, 2048, (SMOKE + "sigma_t.data",), rr_depth=1 << 20)
            found[name] = scene, by[SMOKE + "sigma_t.data"]
        return found[name]

    return make


@pytest.mark.slow
@pytest.mark.parametrize(("name", "part"), DIRECTIONS, ids=["-".join(key) for key in DIRECTIONS])
def test_density_against_one_sided_differences(dense, name, part):
    """Of second order, away from zero: where voxels are empty, and where all of them touch their majorant."""
    scene, found = dense(name)
    params, values = psdr.traverse(scene), DENSITIES[name]
    along, step = DIRECTIONS[name, part]
    direction, parameter = along(values), SMOKE + "sigma_t.data"
    integrator = psdr.PathIntegrator(max_depth=3, rr_depth=1 << 20)
    derivatives = (found * direction).sum(axis=(1, 2, 3, 4))
    differences = []
    for seed in range(BATCHES):
        at = []
        for k in (0, 1, 2):
            params[parameter] = (values + k * step * direction).astype(np.float32)
            params.update()
            image = psdr.render(scene, integrator=integrator, spp=8192, seed=100 + seed).numpy()
            at.append(image.astype(np.float64).mean())
        differences.append((4.0 * at[1] - 3.0 * at[0] - at[2]) / (2.0 * step))
    params[parameter] = values
    params.update()
    error = np.hypot(*(np.std(x, ddof=1) / np.sqrt(BATCHES) for x in (derivatives, differences)))
    scale = abs(np.mean(differences))
    assert error < 0.015 * scale, f"too noisy to tell: {error / scale:.1%} of the difference"
    assert abs(derivatives.mean() - np.mean(differences)) < measure.SLOPE_TOLERANCE * scale + 3.0 * error

"""Light sources that are not surfaces: values, densities, and what is compiled for them."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

from tests.emitter.helpers import (
    ALL_KINDS,
    BOTH,
    ENVIRONMENTS,
    LIGHTS,
    ROTATION,
    Light,
    envmap,
    light_frame_directions,
    pose,
    queries,
    random_map,
    sample_kernel,
    sun_map,
    vjp_kernel,
)
from warp_psdr.kernels import constants as c
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.scene.lights.light_sampling import UNIFORM_COMPENSATED, build_env_distribution

SIGNIFICANCE = 1e-5


def half_black_map():
    data = random_map(12, 10, 3)
    data[:, 3:8] = 0.0
    return data


MAPS = {
    "random": random_map,
    "one channel": lambda: random_map()[..., :1],
    "sun": sun_map,
    "sun at the zenith": lambda: sun_map(row=0, column=3),
    "sun at the nadir": lambda: sun_map(row=15, column=0),
    "half black": half_black_map,
    "black": lambda: np.zeros((7, 5, 3), np.float32),
    "two rows, one column": lambda: np.array([[[1.0, 0.5, 0.2]], [[0.1, 0.4, 0.0]]], np.float32),
}


def cell_quadrature(height, width, parts, points):
    """Directions (light's frame) and solid angles that integrate over every cell, each divided in parts x parts bins.

    Shapes (rows, columns, points, points, ...): midpoints in cos(theta) and phi, in which the solid angle is uniform.
    """
    z = np.cos(np.pi * np.arange(height) / (height - 1))
    t = (np.arange(parts * points) + 0.5) / (parts * points)
    z = (z[:-1, None] + (z[1:] - z[:-1])[:, None] * t).reshape(-1, points)
    phi = (2.0 * np.pi * (0.5 + np.arange(width)[:, None] + t) / width).reshape(-1, points)
    rows = np.arange(len(z)) // parts
    edges = np.cos(np.pi * np.arange(height) / (height - 1))
    area = 2.0 * np.pi / width * (edges[:-1] - edges[1:])[rows] / (parts * points) ** 2
    z, phi = np.broadcast_arrays(z[:, None, :, None], phi[None, :, None, :])
    return light_frame_directions(np.arccos(z), phi), np.broadcast_to(area[:, None, None, None], z.shape)


def bin_of(v, height, width, parts):
    """Number of the bin of `cell_quadrature` that a direction (light's frame) falls into."""
    edges = np.cos(np.pi * np.arange(height) / (height - 1))
    z = edges[:-1, None] + (edges[1:] - edges[:-1])[:, None] * np.arange(parts) / parts
    row = np.searchsorted(-z.ravel(), -v[:, 1], side="right") - 1
    phi = np.arctan2(v[:, 0], -v[:, 2]) / (2.0 * np.pi) * width - 0.5
    return row * width * parts + (np.floor(phi * parts).astype(int) % (width * parts))


@pytest.mark.parametrize(
    ("name", "compensated"), [*((name, False) for name in MAPS), ("random", True), ("sun", True), ("half black", True)]
)
def test_environment_samples_follow_their_density(name, compensated, device):
    data = MAPS[name]()
    light = envmap(data, device, compensated=compensated)
    height, width = data.shape[:2]
    directions, area = cell_quadrature(height, width, parts=2, points=4)
    _, pdf = light.evaluate(directions.reshape(-1, 3) @ ROTATION.T)
    mass = (pdf.astype(np.float64).reshape(area.shape) * area).sum(axis=(2, 3)).ravel()
    # Midpoints are exact for a bilinear density, so this is float32 rounding (and directions on cell borders).
    assert mass.sum() == pytest.approx(1.0, abs=2e-4)

    n = 400_000
    u = np.random.default_rng(8).random((n, 2), dtype=np.float32)
    s = light.sample(np.zeros((n, 3)), u)
    assert s.pdf.min() > 0.0
    np.testing.assert_allclose(np.linalg.norm(s.wi, axis=1), 1.0, atol=1e-6)
    observed = np.bincount(bin_of(s.wi @ ROTATION, height, width, 2), minlength=mass.size)
    expected = n * mass / mass.sum()
    rare = expected < 20.0
    observed = np.append(observed[~rare], observed[rare].sum())
    expected = np.append(expected[~rare], expected[rare].sum())
    keep = expected > 0.0
    assert observed[~keep].sum() == 0
    assert stats.chisquare(observed[keep], expected[keep]).pvalue > SIGNIFICANCE

    # The density and the radiance that a sample carries are those of its direction; 1e-3 of the samples may lie in the
    # next cell after rounding.
    radiance, pdf = light.evaluate(s.wi)
    wrong = np.abs(pdf - s.pdf) > 2e-3 * s.pdf
    assert wrong.mean() < 1e-3
    np.testing.assert_allclose(s.radiance, radiance, rtol=2e-3, atol=2e-4 * max(data.max(), 1e-9))


@pytest.mark.parametrize(("name", "noise"), [("random", 0.4), ("sun", 0.25), ("sun at the zenith", 0.2)])
def test_environment_estimates_are_unbiased_and_quiet(name, noise):
    data = MAPS[name]()
    directions, area = cell_quadrature(*data.shape[:2], parts=2, points=32)
    light = envmap(data)
    radiance, _ = light.evaluate(directions.reshape(-1, 3) @ ROTATION.T)
    exact = (radiance.mean(axis=1, dtype=np.float64) * area.ravel()).sum()
    n = 200_000
    s = light.sample(np.zeros((n, 3)), np.random.default_rng(9).random((n, 2), dtype=np.float32))
    estimate = s.radiance.mean(axis=1, dtype=np.float64) / s.pdf
    # 5 standard errors, and 1e-3 for the midpoint rule.
    assert abs(estimate.mean() - exact) < 5.0 * estimate.std() / np.sqrt(n) + 1e-3 * exact
    # Without the density within cells the sun alone would have 4/3 per direction: sqrt(16/9 - 1) = 0.88.
    assert estimate.std() < noise * exact


def test_positions_within_a_cell_of_few_random_numbers_are_uniform():
    # In the sun's row a cell far from it is found by one to a few of the 2^24 random numbers. Texels there would get
    # wrong derivatives if that many positions were all there is.
    light = envmap(sun_map(256, 2048, row=40, column=7, sky=1e-6), rotation=np.eye(3))
    marginal, conditional = light.scene.env_marginal.numpy(), light.scene.env_conditional.numpy()
    row, column = 40, 1000
    conditional = conditional[: 255 * 2049].reshape(255, 2049)
    levels = (conditional[row, column : column + 2] * 2.0**24).astype(int)
    assert 1 <= levels[1] - levels[0] <= 4
    rng = np.random.default_rng(10)
    n = 20_000
    u = np.empty((n, 2))
    u[:, 0] = rng.integers(*levels, n) / 2.0**24
    u[:, 1] = marginal[row] + rng.random(n) * (marginal[row + 1] - marginal[row])
    v = light.sample(np.zeros((n, 3)), np.floor(u * 2.0**24) / 2.0**24).wi.astype(np.float64)
    position = np.arctan2(v[:, 0], -v[:, 2]) / (2.0 * np.pi) * 2048 - 0.5 - column
    # The texels around the cell are equal, so positions are uniform; 1e-3 of a cell is float32 rounding.
    assert position.min() > -1e-3
    assert position.max() < 1.0 + 1e-3
    assert stats.kstest(position, "uniform").pvalue > SIGNIFICANCE


def test_every_cell_of_a_large_map_with_a_sun_can_be_sampled():
    marginal, conditional = build_env_distribution(sun_map(256, 2048, row=40, column=7, sky=1e-6))
    assert marginal.shape == (256,)
    assert conditional.shape == (255, 2049)
    assert np.diff(marginal).min() > 0.0
    assert np.diff(conditional, axis=1).min() > 0.0
    # The four cells around the sun; 0.95 less what the rest needs for one level each.
    share = np.diff(marginal)[39:41, None] * np.diff(conditional, axis=1)[39:41, 6:8]
    assert share.sum() == pytest.approx(0.95, abs=1e-3)


def test_compensated_maps_lose_their_mean_where_enough_is_left():
    """A sun keeps its share and dim sky loses all but the uniform one; a map without contrast is drawn as it is."""

    def shares(data, compensated):
        marginal, conditional = build_env_distribution(data, compensated)
        return np.diff(marginal)[:, None] * np.diff(conditional, axis=1)

    sky = np.ones((16, 32, 3), np.float32)
    sky[5, 7] = 300.0
    plain, compensated = shares(sky, False), shares(sky, True)
    dim = np.ones_like(plain, bool)
    dim[4:6, 6:8] = False
    assert compensated[~dim].sum() == pytest.approx(1.0 - UNIFORM_COMPENSATED, abs=0.001)
    assert compensated[dim].sum() == pytest.approx(UNIFORM_COMPENSATED, abs=0.001) and compensated.min() > 0.0
    assert plain[dim].sum() > 2.0 * compensated[dim].sum()
    overcast = np.random.default_rng(3).uniform(0.95, 1.05, (16, 32, 3))
    flat, left = shares(overcast, False), shares(overcast, True)
    assert np.abs(left / flat - 1.0).max() < 0.1
    np.testing.assert_array_equal(shares(np.zeros((4, 8, 3)), True), shares(np.zeros((4, 8, 3)), False))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (np.zeros((1, 4, 3)), "at least two rows"),
        (np.zeros((4, 4)), "shape"),
        (np.full((4, 4, 3), np.nan), "NaN"),
        (np.full((4, 4, 3), np.inf), "infinite"),
    ],
)
def test_bad_maps_are_refused(data, message):
    with pytest.raises(ValueError, match=message):
        build_env_distribution(data)


def test_constant_environment(device):
    light = Light(c.EMITTER_CONSTANT, device, radiance=[0.3, 0.5, 0.7])
    u = np.random.default_rng(11).random((1000, 2), dtype=np.float32)
    s = light.sample(np.zeros((1000, 3)), u)
    radiance, pdf = light.evaluate(s.wi)
    np.testing.assert_allclose(radiance, np.tile([0.3, 0.5, 0.7], (1000, 1)), rtol=1e-6)
    np.testing.assert_array_equal(s.radiance, radiance)
    np.testing.assert_allclose(pdf, 0.25 / np.pi, rtol=1e-6)
    np.testing.assert_array_equal(s.pdf, pdf)
    assert np.linalg.norm(s.wi.mean(axis=0)) < 5.0 / np.sqrt(1000)
    assert not s.delta.any()
    assert np.all(s.distance == np.float32(c.FAR))


# -- dispatch ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow_rows("constant", "envmap")
@pytest.mark.parametrize("name", ["constant", "envmap", "point", "spot", "textured spot", "projector", "directional"])
def test_dispatch_over_all_kinds_equals_the_single_kind(name):
    light = Light(**LIGHTS[name])
    x, w, a_wi = queries(name, light)
    u = np.random.default_rng(14).random((len(x), 2), dtype=np.float32)
    one, many = light.sample(x, u), light.sample(x, u, kinds=ALL_KINDS)
    for field in vars(one):
        np.testing.assert_array_equal(getattr(one, field), getattr(many, field))
    args = "reverse", np.zeros(len(light.values)), x, w, a_wi
    for a, b in zip(light.vjp(*args), light.vjp(*args, kinds=ALL_KINDS), strict=True):
        np.testing.assert_array_equal(a, b)
    if light.kind in ENVIRONMENTS:
        for a, b in zip(light.evaluate(x), light.evaluate(x, kinds=ALL_KINDS), strict=True):
            np.testing.assert_array_equal(a, b)


def test_functions_that_no_light_has_are_none():
    point = make_lights((c.EMITTER_POINT,), "reverse", BOTH)
    assert point.environment_eval is None
    assert point.environment_pdf is None
    assert point.environment_eval_pdf is None
    assert point.environment_vjp is None
    constant = make_lights((c.EMITTER_CONSTANT,), "reverse", BOTH)
    assert constant.sample_vjp is None
    assert make_lights((), "reverse", BOTH) == (None,) * 6
    primal = make_lights(ALL_KINDS, None, ())
    assert primal.sample_vjp is None
    assert primal.environment_vjp is None


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (((c.EMITTER_AREA,), None, ()), "kind of light 0"),
        (((c.EMITTER_POINT,), "backward", ()), "role 'backward'"),
        (((c.EMITTER_POINT,), "reverse", ("colour",)), "'colour'"),
    ],
)
def test_bad_requests_are_named(args, message):
    with pytest.raises(ValueError, match=message):
        make_lights(*args)


@pytest.mark.slow
def test_scenes_hold_code_of_their_own_lights_only_and_compile_for_cuda(tmp_path):
    sources = {}
    for name, kinds in {"all": ALL_KINDS, "few": (c.EMITTER_CONSTANT, c.EMITTER_POINT)}.items():
        kernels = {
            "sample": sample_kernel(kinds),
            "environment": vjp_kernel(kinds, "reverse", BOTH, True),
            "delta": vjp_kernel(kinds, "forward", BOTH, False),
        }
        for stage, kernel in kernels.items():
            folder = tmp_path / name / stage
            wp.compile_aot_module(kernel.module, arch=90, module_dir=folder)
            assert list(folder.glob("*.ptx")) + list(folder.glob("*.cubin"))
            sources[name, stage] = "".join(path.read_text() for path in folder.glob("*.cu"))
    words = {
        "sample": ("make_envmap", "find_interval", "make_spot", "falloff", "make_directional"),
        "environment": ("make_envmap", "locate", "bilinear_dot"),
        "delta": ("spot_dot", "projector_dot", "directional_dot"),
    }
    for stage, present in words.items():
        for word in present:
            assert word in sources["all", stage]
            assert word not in sources["few", stage]


# -- Mitsuba -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mitsuba():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    return mi


def mitsuba_environment(mi, emitter, direction):
    out = []
    for d in np.asarray(direction, np.float64):
        si = mi.SurfaceInteraction3f()
        si.wi = mi.Vector3f(*(-d))
        out.append(np.array(emitter.eval(si)))
    return np.array(out)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_environment_map_equals_mitsubas(mitsuba, mirror):
    data = random_map(7, 10, 5)
    rotation = ROTATION @ np.diag([mirror, 1.0, 1.0])
    matrix = mitsuba.ScalarTransform4f(pose(rotation).astype(np.float64))
    plugin = {"type": "envmap", "bitmap": mitsuba.Bitmap(data), "scale": 1.5, "to_world": matrix}
    d = np.random.default_rng(15).normal(size=(400, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    expected = mitsuba_environment(mitsuba, mitsuba.load_dict(plugin), d)
    # 2e-5: float32 azimuths times the map's width, in both renderers.
    np.testing.assert_allclose(envmap(data, rotation=rotation).evaluate(d)[0], expected, atol=2e-5)


def test_constant_environment_equals_mitsubas(mitsuba):
    emitter = mitsuba.load_dict({"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.5, 0.7]}})
    d = np.array([[0.0, 0.6, 0.8]])
    light = Light(c.EMITTER_CONSTANT, radiance=[0.3, 0.5, 0.7])
    np.testing.assert_allclose(light.evaluate(d)[0], mitsuba_environment(mitsuba, emitter, d), rtol=1e-5)


@pytest.mark.parametrize("name", ["point", "spot", "textured spot", "projector", "directional"])
def test_delta_lights_equal_mitsubas(mitsuba, name):
    rgb = {"type": "rgb", "value": [3.0, 2.0, 1.0]}
    matrix = mitsuba.ScalarTransform4f(pose(translation=(0.3, -0.2, 0.5)).astype(np.float64))
    plugin, light = {
        "point": (
            {"type": "point", "intensity": rgb, "position": [0.2, -0.1, 1.5]},
            Light(c.EMITTER_POINT, radiance=[3.0, 2.0, 1.0], position=[0.2, -0.1, 1.5]),
        ),
        "spot": (
            {"type": "spot", "intensity": rgb, "to_world": matrix, "cutoff_angle": 50.0, "beam_width": 20.0},
            Light(
                c.EMITTER_SPOT,
                radiance=[3.0, 2.0, 1.0],
                to_world=pose(translation=(0.3, -0.2, 0.5)),
                angles=[50.0, 20.0],
            ),
        ),
        "textured spot": (
            {
                **{"type": "spot", "intensity": rgb, "to_world": matrix, "cutoff_angle": 50.0, "beam_width": 20.0},
                "texture": {"type": "bitmap", "bitmap": mitsuba.Bitmap(random_map()), "raw": True},
            },
            Light(
                c.EMITTER_TEXTURED_SPOT,
                radiance=[3.0, 2.0, 1.0],
                to_world=pose(translation=(0.3, -0.2, 0.5)),
                angles=[50.0, 20.0],
                projected=random_map(),
            ),
        ),
        "projector": (
            {
                **{"type": "projector", "to_world": matrix, "fov": 100.0, "scale": 1.5},
                "irradiance": {"type": "bitmap", "bitmap": mitsuba.Bitmap(random_map()), "raw": True},
            },
            Light(
                c.EMITTER_PROJECTOR,
                radiance=random_map(),
                to_world=pose(translation=(0.3, -0.2, 0.5)),
                scale=[1.5],
                angles=[100.0],
            ),
        ),
        "directional": (
            {"type": "directional", "irradiance": rgb, "to_world": matrix},
            Light(c.EMITTER_DIRECTIONAL, radiance=[3.0, 2.0, 1.0], to_world=pose(translation=(0.3, -0.2, 0.5))),
        ),
    }[name]
    emitter = mitsuba.load_dict(plugin)
    x = np.random.default_rng(16).normal(size=(300, 3)).astype(np.float32) * 2.0
    wi, radiance = [], []
    for p in x:
        it = mitsuba.SurfaceInteraction3f()
        it.p = mitsuba.Point3f(*p.astype(np.float64))
        sample, weight = emitter.sample_direction(it, [0.5, 0.5])
        wi.append(np.array(sample.d))
        radiance.append(np.array(weight))
    s = light.sample(x, np.zeros((len(x), 2)))
    np.testing.assert_allclose(s.wi, wi, atol=1e-6)
    # 2e-5: the falloff's arc cosine near the axis.
    np.testing.assert_allclose(s.radiance, radiance, rtol=1e-4, atol=2e-5)
    if name == "spot":
        # Points in the beam, in the falloff and in the dark were among them.
        share = np.array(radiance)[:, 0] * ((x - [0.3, -0.2, 0.5]) ** 2).sum(axis=1) / 3.0
        assert (share > 0.999).any()
        assert ((share > 0.1) & (share < 0.9)).any()
        assert (share == 0.0).any()
    assert s.delta.all()
    np.testing.assert_array_equal(s.pdf, 1.0)

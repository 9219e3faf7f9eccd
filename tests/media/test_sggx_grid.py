"""Grids of microflakes, and microflakes in grids and in media that emit: formulas, differences, Mitsuba, errors."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.media.scenes import (
    FLOOR,
    camera,
    cube,
    grid,
    grids,
    integrator,
    medium,
    point,
    puffs,
    rgb,
    sky,
    volume,
    whole,
)
from tests.media.test_sggx import AHEAD, EYE, FLAKES, INTENSITY, LIGHT, SLAB, WIDTH, about_d, area, expected
from tests.path.helpers import assert_mean, assert_same_mean, batches, blocks
from tests.peer import MITSUBA_ROUNDING, for_mitsuba
from warp_psdr.kernels import structs
from warp_psdr.kernels.constants import FILTER_BILINEAR, PHASE_SGGX_GRID, WRAP_CLAMP
from warp_psdr.kernels.phase.dispatch import make_phase, make_phase_sink
from warp_psdr.kernels.phase.microflakes import make_flake_sinks, make_microflakes

S, DENSITY = SLAB + "phase_function.S.data", SLAB + "sigma_t.data"
#: Two voxels along x: they are turned in different ways, and differ in size.
TWO = np.array([FLAKES["turned"], [0.2, 0.6, 0.9, -0.1, 0.2, 0.1]]).reshape(1, 1, 2, 6)
THIN = [0.3, 0.8]
KINDS = ["homogeneous", "heterogeneous"]


def at(values, x):
    """Values (..., 2, C) along x of a grid that fills the cube from -1 to 1, interpolated."""
    share = np.clip(x + 0.5, 0.0, 1.0)[..., None]
    two = np.asarray(values, np.float64).reshape(2, -1)
    return (1.0 - share) * two[0] + share * two[1]


def areas(values, w):
    """A along w for each of the matrices (N, 6)."""
    return np.array([area(six, d) for six, d in zip(values, np.broadcast_to(w, (len(values), 3)), strict=True)])


def microflakes(kind, values, density=THIN, albedo=0.6, **more):
    """A medium of flakes; the density varies along x where it may."""
    density = np.asarray(density, np.float64)
    sigma_t = volume(density.mean()) if kind == "homogeneous" else grid(density.reshape(1, 1, 2))
    flakes = grid(values) if np.ndim(values) == 4 else list(values)
    return {**medium(1.0, albedo), "type": kind, "sigma_t": sigma_t, "phase": {"type": "sggx", "S": flakes}, **more}


def slab(inside, **lights):
    """A cube that is seen along (.6, 0, .8): a length of 2.5."""
    return psdr.load_dict(whole(sensor=camera(EYE, [0, 0, 0], 0.05, up=(0, 1, 0)), slab=cube(inside), **lights))


# ---- Values and derivatives at a point ----


@pytest.fixture(scope="module")
def run():
    """Values, areas and derivatives along a tangent, of a grid of two voxels that fills the cube from 0 to 1."""
    kinds = (PHASE_SGGX_GRID,)
    phase, accumulate = make_phase(kinds), make_phase_sink(kinds, "forward")
    flakes, (_value, accumulate_area) = make_microflakes(kinds), make_flake_sinks(kinds, "forward")

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(
        scene: structs.Scene,
        tangent: wp.array(dtype=wp.float32),
        x: wp.array(dtype=wp.vec3),
        d: wp.vec3,
        wo: wp.array(dtype=wp.vec3),
        value_out: wp.array2d(dtype=wp.float32),
    ):
        i = wp.tid()
        m = structs.Medium()
        m.phase = PHASE_SGGX_GRID
        a = flakes.area_at(scene, m, x[i], d)
        value_out[i, 0] = phase.eval(scene, m, x[i], d, wo[i])
        value_out[i, 1] = accumulate(scene, tangent, m, x[i], d, wo[i], 1.0)
        value_out[i, 2] = a
        value_out[i, 3] = accumulate_area(scene, tangent, m, x[i], d, a)
        value_out[i, 4] = flakes.most_area(scene, m, d)

    def call(values, x, d, wo, tangent=None):
        scene, record = structs.Scene(), structs.Texture()
        record.filter, record.wrap, record.channels = FILTER_BILINEAR, WRAP_CLAMP, 6
        record.width, record.height, record.first, record.to_uv, record.second = 2, 1, 1, 12, 24
        flat = np.concatenate([values.reshape(-1), np.eye(3, 4).reshape(-1), [7.0]])
        scene.values = wp.array(flat, dtype=wp.float32)
        scene.textures = wp.array([record], dtype=structs.Texture)
        tangent = wp.array(np.zeros(12) if tangent is None else tangent, dtype=wp.float32)
        out = wp.zeros((len(wo), 5), dtype=wp.float32)
        inputs = [scene, tangent, wp.array(x, dtype=wp.vec3), wp.vec3(*d), wp.array(wo, dtype=wp.vec3)]
        wp.launch(kernel, dim=len(wo), inputs=inputs, outputs=[out])
        return out.numpy().astype(np.float64).T

    return call


def test_values_and_derivatives_at_points(run):
    """Those of the six channels, interpolated one by one; by each number of both voxels."""
    rng = np.random.default_rng(3)
    x, d = rng.uniform(-0.2, 1.2, (200, 3)), np.array([0.36, 0.48, 0.8])
    wo = about_d(rng.uniform(-1.0, 0.95, 200), rng.uniform(-np.pi, np.pi, 200))
    share = np.clip(2.0 * x[:, :1] - 0.5, 0.0, 1.0)

    def by_formula(values):
        six = (1.0 - share) * values[:6] + share * values[6:]
        return np.array([expected(s, d, w[None])[0] for s, w in zip(six, wo, strict=True)]), areas(six, d)

    flat = TWO.reshape(-1)
    value, _slope, found, _by_area, most = run(TWO, x, d, wo)
    np.testing.assert_allclose(value, by_formula(flat)[0], rtol=2e-4)
    np.testing.assert_allclose(found, by_formula(flat)[1], rtol=1e-5)
    assert (most == 7.0).all()
    h = 1e-5
    for tangent in np.eye(12):
        _value, by_value, _area, by_area, _most = run(TWO, x, d, wo, tangent)
        above, below = by_formula(flat + h * tangent), by_formula(flat - h * tangent)
        for slope, up, down in ((by_value, above[0], below[0]), (by_area, above[1], below[1])):
            difference = (up - down) / (2.0 * h)
            assert np.abs(difference).max() > 1e-3
            np.testing.assert_allclose(slope, difference, rtol=2e-3, atol=2e-4 * np.abs(difference).max())


# ---- Rays through the cube ----


def assert_derivatives(found, slopes):
    """Fail unless the mean of batches has these slopes, of which few are small, within its error and the width."""
    most = np.abs(slopes).max()
    error = np.std(found, axis=0, ddof=1) / np.sqrt(len(found)) + 2.0 * WIDTH * most / 5.0
    excess = np.abs(found.mean(axis=0) - slopes) / error
    assert excess.max() < 5.0, (found.mean(axis=0), slopes, excess)
    assert np.std(found, axis=0).max() < 0.05 * most and np.median(np.abs(slopes)) > 0.02 * most


def passed(values, density):
    """exp(-int sigma A dt) along the camera's ray."""
    t = (np.arange(2000) + 0.5) / 2000 * 2.5 - 1.25
    sigma = at(density, 0.6 * t)[:, 0]
    return np.exp(-2.5 * (sigma * areas(at(values, 0.6 * t), AHEAD)).mean())


def scattered_once(values, density, albedo):
    """The light of a bulb that the cube scatters towards the camera, by quadrature."""
    n = 200
    t = (np.arange(n) + 0.5) / n * 2.5
    x = np.array([-0.75, 0.0, -1.0]) + t[:, None] * AHEAD
    to_light = LIGHT - x
    r = np.linalg.norm(to_light, axis=1)
    wo = to_light / r[:, None]
    with np.errstate(divide="ignore"):
        leaves = np.where(wo > 0.0, (1.0 - x) / wo, (-1.0 - x) / wo).min(axis=1)
    seen = at(density, x[:, 0])[:, 0] * areas(at(values, x[:, 0]), AHEAD)
    before = (np.cumsum(seen) - 0.5 * seen) * (2.5 / n)
    share = (np.arange(32) + 0.5) / 32
    behind = []
    for p, w, length in zip(x, wo, leaves, strict=True):
        on = p[0] + share * length * w[0]
        behind.append((at(density, on)[:, 0] * areas(at(values, on), w)).mean() * length)
    turned = np.array([expected(s, AHEAD, w[None])[0] for s, w in zip(at(values, x[:, 0]), wo, strict=True)])
    return (albedo * seen * turned * np.exp(-before - behind) * INTENSITY / r**2).sum() * (2.5 / n)


def slopes_of(value, point, h=1e-4):
    """Derivatives of a function of flat numbers."""
    return np.array([(value(point + h * e) - value(point - h * e)) / (2.0 * h) for e in np.eye(len(point))])


def gradients(scene, names, depth, spp):
    """Gradients of the mean, flat, of eight seeds."""
    params = psdr.traverse(scene)
    params.requires_grad_only(*names)
    adjoint, found = np.full((4, 4, 3), 1.0 / 48.0, np.float32), []
    for seed in range(8):
        params.zero_grad()
        psdr.render_backward(
            scene, params, adjoint, integrator=psdr.PathIntegrator(max_depth=depth), spp=spp, seed=seed
        )
        found.append(np.concatenate([params[name].grad.numpy().astype(np.float64).reshape(-1) for name in names]))
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_what_passes(kind):
    """By each number of both voxels, and by the density, whose own grid is another."""
    scene = slab(microflakes(kind, TWO), sky=sky(1.0, 1.0, 1.0))
    density = [np.mean(THIN)] * 2 if kind == "homogeneous" else THIN
    image = batches(scene, spp=1024, max_depth=1).mean(axis=(1, 2))
    assert_mean(image, passed(TWO, density), "radiance", WIDTH)
    names = [S] + [DENSITY] * (kind == "heterogeneous")
    found = gradients(scene, names, 1, 1024)
    flat = np.concatenate([TWO.reshape(-1), density])[: found.shape[1]]
    slopes = slopes_of(lambda v: passed(v[:12], np.append(v[12:], density)[:2]), flat)
    assert_derivatives(found[:, slopes != 0.0], slopes[slopes != 0.0])
    assert (np.abs(found[:, slopes == 0.0]) < 1e-5).all() and (slopes == 0.0).sum() == 6  # the ray lies across y


@pytest.mark.slow_rows("homogeneous", "heterogeneous")
@pytest.mark.parametrize("kind", KINDS)
def test_light_scattered_once(kind):
    """By each number of both voxels, which turn flakes and let light pass to them and from them, and by the albedo."""
    scene = slab(microflakes(kind, TWO), bulb=point(LIGHT, (INTENSITY,) * 3))
    density = [np.mean(THIN)] * 2 if kind == "homogeneous" else THIN
    flat = np.append(TWO.reshape(-1), 0.6)
    image = batches(scene, spp=2048, max_depth=2).mean(axis=(1, 2))
    assert_mean(image, scattered_once(TWO, density, 0.6), "radiance", 2.0 * WIDTH)
    found = gradients(scene, [S, SLAB + "albedo.value.value"], 2, 1024)
    slopes = slopes_of(lambda v: scattered_once(v[:12], density, v[12]), flat)
    assert_derivatives(found, slopes)


def emitted(values, density, glow):
    """int glow exp(-int sigma A) dt along the camera's ray."""
    n = 2000
    x = 0.6 * ((np.arange(n) + 0.5) / n * 2.5 - 1.25)
    seen = at(density, x)[:, 0] * areas(at(values, x), AHEAD)
    return (np.exp(-(np.cumsum(seen) - 0.5 * seen) * (2.5 / n))).sum() * glow * (2.5 / n)


@pytest.mark.slow_rows("homogeneous-flakes0", "homogeneous-flakes1", "heterogeneous-flakes2")
@pytest.mark.parametrize(
    ("kind", "flakes"), [("homogeneous", TWO[0, 0, 0]), ("homogeneous", TWO), ("heterogeneous", TWO)]
)
def test_emission(kind, flakes):
    """Of one S in closed form; its extinction is that along the ray, and its radiance the same in all directions."""
    scene = slab(microflakes(kind, flakes, albedo=0.0, emission=volume(0.7)))
    density = [np.mean(THIN)] * 2 if kind == "homogeneous" else THIN
    image = batches(scene, spp=256, max_depth=1).mean(axis=(1, 2))
    two = np.broadcast_to(np.reshape(flakes, (-1, 6)), (2, 6))
    assert_mean(image, emitted(two, density, 0.7), "radiance", WIDTH)
    name = S if np.ndim(flakes) == 4 else S.removesuffix(".data")
    found = gradients(scene, [name, SLAB + "emission.value.value"], 1, 1024)
    size = np.size(flakes)

    def value(v):
        return emitted(np.broadcast_to(v[:size].reshape(-1, 6), (2, 6)), density, v[size])

    slopes = slopes_of(value, np.append(flakes, 0.7))
    assert_derivatives(found[:, slopes != 0.0], slopes[slopes != 0.0])
    assert (slopes != 0.0).sum() == size // 2 + 1


# ---- Against one S, finite differences, the transpose, and Mitsuba ----

PLAIN = {"sun": {"type": "directional", "direction": [0.8, -0.2, -0.5], "irradiance": rgb(1.0, 2.0, 3.0)}}


@pytest.mark.slow
def test_a_constant_grid_is_one_matrix():
    """Homogeneous with one S, and with a grid of it; heterogeneous of both: images, and derivatives, summed."""
    one = np.array(FLAKES["turned"])
    many = np.broadcast_to(one, (2, 3, 2, 6))
    found = []
    for kind, flakes in (("homogeneous", one), ("homogeneous", many), ("heterogeneous", one), ("heterogeneous", many)):
        scene = slab(microflakes(kind, flakes, [0.55, 0.55], 0.8), sky=sky(0.5, 0.7, 1.0), **PLAIN)
        image = batches(scene, spp=512, max_depth=5).mean(axis=(1, 2))
        name = S if np.ndim(flakes) == 4 else S.removesuffix(".data")
        by_s = gradients(scene, [name], 5, 2048).reshape(8, -1, 6).sum(axis=1)
        found.append((image, by_s))
    for image, by_s in found[1:]:
        assert_same_mean(image, found[0][0], "radiance")
        assert_same_mean(by_s, found[0][1], "derivatives by S")
        assert np.std(by_s, axis=0).max() < 0.1 * np.abs(found[0][1].mean(axis=0)).max()


def symmetric(six):
    """Matrices (..., 3, 3) of six numbers each, or the six of matrices."""
    if six.shape[-2:] == (3, 3):
        return six[..., [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return six[..., [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(*six.shape[:-1], 3, 3)


def turning_flakes():
    """A grid of microflakes that turn from voxel to voxel."""
    turns = np.random.default_rng(5).normal(size=(3, 2, 4, 3, 3))
    found = turns @ np.swapaxes(turns, -1, -2)
    return symmetric(0.6 * found / np.trace(found, axis1=-1, axis2=-2)[..., None, None] + 0.25 * np.eye(3))


INSIDE = "cube.interior_medium."
OF_SMOKE = INSIDE + "phase_function.S.data"


def flaky_smoke(fov=10.0, size=8, density=1.0):
    """Smoke with empty voxels, seen from outside, in the light of the sun and a bulb."""
    inside = {
        **grids(grid(density * puffs(12)), (0.9, 0.8, 0.7)),
        "phase": {"type": "sggx", "S": grid(turning_flakes())},
    }
    lights = {"bulb": point([2.0, -1.5, 2.5], (4.0, 5.0, 6.0)), **PLAIN}
    return whole(sensor=camera([4, 3, 2.5], [0, 0, -0.3], fov, size), cube=cube(inside, turn=20.0), **lights)


def grown(values):
    """All flakes grow, by shares of their own."""
    return values * np.random.default_rng(7).uniform(0.5, 1.0, (*values.shape[:3], 1))


def stretched(values):
    """All normals are drawn towards one direction."""
    e = np.array([0.78, 0.5, 0.38]) / np.linalg.norm([0.78, 0.5, 0.38])
    pulled = np.outer(e, e) @ symmetric(values)
    return symmetric(0.7 * (pulled + np.swapaxes(pulled, -1, -2)))


@pytest.mark.slow
@pytest.mark.parametrize(("tangent_of", "tolerance"), [(grown, 0.02), (stretched, 0.06)])
def test_derivative_equals_finite_differences(tangent_of, tolerance):
    """At depth 3; two steps, extrapolated, since densities of normals are far from linear. Forward is the transpose."""
    scene = psdr.load_dict(flaky_smoke())
    params = psdr.traverse(scene)
    values = params[OF_SMOKE].numpy().astype(np.float64)
    tangent, h = tangent_of(values), 0.1
    options = {"integrator": psdr.PathIntegrator(max_depth=3, rr_depth=100)}

    def mean(shift, seed):
        params[OF_SMOKE] = (values + shift * tangent).astype(np.float32)
        params.update()
        return psdr.render(scene, spp=8192, seed=seed, **options).numpy().astype(np.float64).mean()

    differences = []
    for seed in range(8):
        one, two = ((mean(s * h, seed) - mean(-s * h, seed)) / (2.0 * s * h) for s in (1, 2))
        differences.append((4.0 * one - two) / 3.0)
    params[OF_SMOKE] = values.astype(np.float32)
    params.update()
    params.requires_grad_only(OF_SMOKE)
    adjoint, found = np.full((8, 8, 3), 1.0 / 192.0, np.float32), []
    for seed in range(8):
        params.zero_grad()
        psdr.render_backward(scene, params, adjoint, spp=4096, seed=100 + seed, **options)
        found.append((params[OF_SMOKE].grad.numpy().astype(np.float64) * tangent).sum())
    (slope, slope_error), (expected_slope, error) = (
        (np.mean(v), np.std(v, ddof=1) / np.sqrt(8.0)) for v in (found, differences)
    )
    error = np.hypot(error, slope_error)
    assert 3.0 * error < 2.0 * tolerance * abs(expected_slope), (expected_slope, error)
    assert abs(slope - expected_slope) < max(tolerance * abs(expected_slope), 3.0 * error), (
        slope,
        expected_slope,
        error,
    )
    params.zero_grad()
    psdr.render_backward(scene, params, adjoint, spp=64, seed=3, **options)
    reverse = (params[OF_SMOKE].grad.numpy().astype(np.float64) * tangent).sum()
    image = psdr.render_forward(scene, params, {OF_SMOKE: tangent.astype(np.float32)}, spp=64, seed=3, **options)
    np.testing.assert_allclose(image.numpy().astype(np.float64).mean(), reverse, rtol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_furnace_is_not_seen(kind):
    """Albedo 1 under a sky of 1: 1 at any depth, whatever S, which has no derivative."""
    scene = slab(microflakes(kind, TWO, albedo=1.0), sky=sky(1.0, 1.0, 1.0))
    assert_mean(batches(scene, spp=512, max_depth=-1).mean(axis=(1, 2)), 1.0, "furnace", WIDTH)
    found = gradients(scene, [S], -1, 1024)
    assert_mean(1.0 + found, 1.0, "by S", WIDTH)
    assert np.std(found, axis=0).max() < 0.05


@pytest.mark.slow
def test_equals_mitsuba():
    """Scattered once: directions that Mitsuba 3.9.1 draws do not have the density that it says."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    parts = {**flaky_smoke(30.0, 24, 3.0), "integrator": integrator(max_depth=2), "floor": FLOOR}
    ours = batches(psdr.load_dict(parts), spp=64)
    theirs = mi.load_dict(for_mitsuba(mi, parts))
    assert "cube.interior_medium.phase_function.S.data" in mi.traverse(theirs)
    theirs = np.stack([np.array(mi.render(theirs, spp=64, seed=i)) for i in range(16)]).astype(np.float64)
    assert_same_mean(blocks(ours, 6), blocks(theirs, 6), "microflakes", MITSUBA_ROUNDING)


# ---- Edits, and what is refused ----


@pytest.mark.slow
def test_edits_are_followed_and_checked():
    """Larger flakes are tracked with a larger bound, as if they had been loaded."""
    scene = slab(microflakes("heterogeneous", TWO), sky=sky(1.0, 1.0, 1.0))
    params = psdr.traverse(scene)
    assert "1 x 1 voxels" in str(psdr.plan(scene)) and "sggx of a grid" in str(psdr.plan(scene))
    params[S] = (9.0 * TWO).astype(np.float32)
    params.update()
    image = psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=1), spp=64, seed=1).numpy()
    other = slab(microflakes("heterogeneous", 9.0 * TWO), sky=sky(1.0, 1.0, 1.0))
    loaded = psdr.render(other, integrator=psdr.PathIntegrator(max_depth=1), spp=64, seed=1).numpy()
    np.testing.assert_array_equal(image, loaded)
    broken = TWO.copy()
    broken[0, 0, 1, 3] = 2.0
    with pytest.raises(ValueError, match=r"after an edit the matrix of voxel \(0, 0, 1\).*eigenvalues from -"):
        params[S] = broken.astype(np.float32)
        params.update()
    params[S] = TWO.astype(np.float32)
    params.update()


@pytest.mark.parametrize(
    ("medium_of", "words"),
    [
        (lambda: microflakes("homogeneous", TWO), "a grid of 'S'.*one 'S', in a 'homogeneous' medium"),
        (lambda: microflakes("heterogeneous", TWO[0, 0, 0]), "in a 'heterogeneous' medium; make it 'homogeneous'"),
        (lambda: microflakes("homogeneous", TWO[0, 0, 0], emission=0.5), "emits light; leave 'emission' out"),
    ],
)
def test_what_moves_is_refused(medium_of, words):
    scene = slab(medium_of(), bulb=point(LIGHT, (INTENSITY,) * 3))
    params = psdr.traverse(scene)
    params.requires_grad_only("bulb.position")
    with pytest.raises(ValueError, match=f"what moves is not followed through .*{words}"):
        psdr.render_backward(scene, params, np.ones((4, 4, 3), np.float32), spp=4)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.ones((2, 2, 2, 3)), r"got the shape \(2, 2, 2, 3\).*\(Z, Y, X, 6\): S_xx, S_yy, S_zz, S_xy, S_xz, S_yz"),
        (np.ones((2, 6)), r"got the shape \(2, 6\)"),
        (
            np.zeros((1, 2, 1, 6)),
            r"voxel \(0, 0, 0\) \(z, y, x\) has eigenvalues from 0 to 0; give.*where nothing is, too",
        ),
        (np.where(np.arange(12) == 7, np.nan, TWO.reshape(-1)).reshape(1, 1, 2, 6), r"voxel \(0, 0, 1\).* holds NaN"),
        (TWO * [1, 1, -1, 1, 1, 1], "eigenvalues from -"),
    ],
)
def test_what_is_wrong_is_named(values, words):
    with pytest.raises(ValueError, match=words):
        inside = {**microflakes("heterogeneous", TWO), "phase": {"type": "sggx", "S": {**grid(TWO), "data": values}}}
        slab(inside, sky=sky(1.0, 1.0, 1.0))

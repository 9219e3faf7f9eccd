"""Microflakes: samples, values and derivatives against formulas, slabs, a furnace, what moves, and what is refused."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

import warp_psdr as psdr
from tests.gradients.configs import aim, shift, widen
from tests.media.scenes import camera, cube, medium, point, sky, whole
from tests.media.test_boundary import LIGHTS, NORMAL, PAINT, POSE, SIZE, SQUARE, difference
from tests.media.test_boundary import assert_mean as mean_equals
from tests.media.test_boundary import derivatives as moved
from tests.media.test_gradient_forms import derivatives
from tests.media.test_grid_boundary import ADJOINT
from tests.path.helpers import SIGNIFICANCE, assert_mean, batches
from warp_psdr.kernels import structs
from warp_psdr.kernels.constants import PHASE_SGGX
from warp_psdr.kernels.phase.dispatch import make_phase, make_phase_sink

#: Absorbs the width of the camera and the step by which rays leave surfaces, relative.
WIDTH = 1e-3
#: S_xx, S_yy, S_zz, S_xy, S_xz, S_yz: of a ball, a fibre along z, a sheet, and one that is turned.
FLAKES = {
    "ball": [1.0, 1.0, 1.0, 0.0, 0.0, 0.0],
    "fibre": [1.0, 1.0, 0.01, 0.0, 0.0, 0.0],
    "sheet": [0.02, 0.02, 1.0, 0.0, 0.0, 0.0],
    "turned": [0.5, 0.8, 0.3, 0.2, -0.1, 0.15],
}
D = np.array([0.36, 0.48, 0.8])
#: Bins of the cosine of the turn and of the azimuth, and points of the quadrature in each along both.
BINS, FINE = (16, 12), 24


@pytest.fixture(scope="module")
def run():
    """Samples, values and derivatives along a tangent; one kernel."""
    phase, accumulate = make_phase((PHASE_SGGX,)), make_phase_sink((PHASE_SGGX,), "forward")

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(
        scene: structs.Scene,
        tangent: wp.array(dtype=wp.float32),
        u: wp.array(dtype=wp.vec2),
        d: wp.array(dtype=wp.vec3),
        wo: wp.array(dtype=wp.vec3),
        drawn_out: wp.array(dtype=wp.vec3),
        value_out: wp.array2d(dtype=wp.float32),
    ):
        i = wp.tid()
        m = structs.Medium()
        m.phase = PHASE_SGGX
        drawn_out[i] = phase.sample(scene, m, wp.vec3(), d[i], u[i])
        value_out[i, 0] = phase.eval(scene, m, wp.vec3(), d[i], wo[i])
        value_out[i, 1] = accumulate(scene, tangent, m, wp.vec3(), d[i], wo[i], 1.0)

    def call(values, d, wo, tangent=(0.0,) * 6):
        n = len(wo)
        scene = structs.Scene()
        scene.values = wp.array(values, dtype=wp.float32)
        u = wp.array(np.random.default_rng(3).random((n, 2)).astype(np.float32), dtype=wp.vec2)
        d = wp.array(np.broadcast_to(d, (n, 3)).astype(np.float32), dtype=wp.vec3)
        drawn, value = wp.zeros(n, dtype=wp.vec3), wp.zeros((n, 2), dtype=wp.float32)
        inputs = [scene, wp.array(tangent, dtype=wp.float32), u, d, wp.array(wo, dtype=wp.vec3)]
        wp.launch(kernel, dim=n, inputs=inputs, outputs=[drawn, value])
        return drawn.numpy().astype(np.float64), *value.numpy().astype(np.float64).T

    return call


def matrix(values):
    xx, yy, zz, xy, xz, yz = values
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], np.float64)


def area(values, w):
    return np.sqrt(np.einsum("...i,ij,...j", w, matrix(values), w))


def expected(values, d, wo):
    """D(h) / (4 A(d))."""
    h = wo - d
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    s = matrix(values)
    stretch = np.einsum("...i,ij,...j", h, np.linalg.inv(s), h)
    return 1.0 / (4.0 * np.pi * np.sqrt(np.linalg.det(s)) * stretch**2 * area(values, d))


def about_d(mu, phi):
    """Directions by the cosine of the turn and the azimuth."""
    a = np.cross(D, [0.0, 0.0, 1.0])
    a /= np.linalg.norm(a)
    sine = np.sqrt(1.0 - mu**2)[..., None]
    return mu[..., None] * D + sine * (np.cos(phi)[..., None] * a + np.sin(phi)[..., None] * np.cross(D, a))


@pytest.mark.parametrize("name", FLAKES)
def test_samples_have_the_density(run, name):
    """Chi-square over the sphere; the density is the formula, and integrates to one."""
    counts = [n * FINE for n in BINS]
    mu = (np.arange(counts[0]) + 0.5) / counts[0] * 2.0 - 1.0
    phi = (np.arange(counts[1]) + 0.5) / counts[1] * 2.0 * np.pi - np.pi
    wo = about_d(*np.meshgrid(mu, phi, indexing="ij")).reshape(-1, 3)
    drawn, value, _slope = run(FLAKES[name], D, wo)
    # float32 loses digits of h where the turn is small.
    clear = wo @ D < 0.99
    np.testing.assert_allclose(value[clear], expected(FLAKES[name], D, wo)[clear], rtol=2e-4)
    share = value.reshape(BINS[0], FINE, BINS[1], FINE).mean(axis=(1, 3)) * 4.0 * np.pi / np.prod(BINS)
    assert share.sum() == pytest.approx(1.0, abs=5e-3)
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1.0, atol=2e-6)
    a = about_d(np.zeros(1), np.zeros(1))[0]
    turned = drawn @ D, np.arctan2(drawn @ np.cross(D, a), drawn @ a)
    found, _, _ = np.histogram2d(*turned, bins=BINS, range=[(-1.0, 1.0), (-np.pi, np.pi)])
    used = share * len(drawn) > 10.0
    assert used.sum() > 60
    p = stats.chisquare(found[used], share[used] * found[used].sum() / share[used].sum()).pvalue
    assert p > SIGNIFICANCE


def test_what_is_scattered_is_reciprocal(run):
    """A(d) f_p(d, wo) = A(wo) f_p(-wo, -d): extinction times phase function."""
    wo = np.random.default_rng(1).normal(size=(500, 3))
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    values = FLAKES["turned"]
    there, back = run(values, D, wo)[1], run(values, -wo, np.broadcast_to(-D, wo.shape))[1]
    np.testing.assert_allclose(area(values, D) * there, area(values, wo) * back, rtol=1e-3)


def test_derivatives_by_s(run):
    wo = np.random.default_rng(2).normal(size=(500, 3))
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    wo = wo[wo @ D < 0.95]
    values, h = np.array(FLAKES["turned"]), 1e-5
    for tangent in np.eye(6):
        _, _, slope = run(values, D, wo, tangent)
        difference = (expected(values + h * tangent, D, wo) - expected(values - h * tangent, D, wo)) / (2.0 * h)
        np.testing.assert_allclose(slope, difference, rtol=2e-3, atol=2e-4 * np.abs(difference).max())


SLAB = "slab.interior_medium."
NAMES = [SLAB + name for name in ("phase_function.S", "sigma_t.value.value", "albedo.value.value")]


@pytest.fixture(scope="module")
def slab():
    """A cube of microflakes before a sky, seen along (.6, 0, .8): a length of 2.5."""
    inside = {**medium(0.5, 0.6), "phase": {"type": "sggx", "S": FLAKES["turned"]}}
    view = camera([-3.0, 0, -4.0], [0, 0, 0], 0.05, up=(0, 1, 0))
    scene = psdr.load_dict(whole(sensor=view, slab=cube(inside), sky=sky(1.0, 1.0, 1.0)))
    return scene, psdr.traverse(scene)


@pytest.mark.slow
def test_a_slab_lets_pass_by_direction(slab):
    """exp(-sigma A(d) l), and its derivatives by each number of S."""
    scene, params = slab
    d, values = np.array([0.6, 0.0, 0.8]), FLAKES["turned"]
    a = area(values, d)
    passed = np.exp(-0.5 * 2.5 * a)
    integrator = psdr.PathIntegrator(max_depth=1)
    np.testing.assert_allclose(psdr.render(scene, integrator=integrator, spp=16).numpy(), passed, rtol=WIDTH)
    params.requires_grad_only(*NAMES)
    params.zero_grad()
    adjoint = np.full((4, 4, 3), 1.0 / 48.0, np.float32)
    psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=64)
    by_area = -0.5 * 2.5 * passed
    outer = np.array([0.36, 0.0, 0.64, 0.0, 2.0 * 0.48, 0.0]) / (2.0 * a)
    np.testing.assert_allclose(params[NAMES[0]].grad.numpy(), by_area * outer, rtol=3e-3, atol=2e-4)
    assert params[NAMES[1]].grad.numpy()[0] == pytest.approx(-2.5 * a * passed, rel=3e-3)


LIGHT, INTENSITY = np.array([1.5, 2.0, -2.5]), 7.0
EYE, AHEAD = np.array([-3.0, 0.0, -4.0]), np.array([0.6, 0.0, 0.8])


def scattered_once(values, sigma, albedo, light=LIGHT, eye=EYE, d=AHEAD):
    """The light of a bulb that the cube scatters towards the camera, by quadrature."""
    n = 2000
    with np.errstate(divide="ignore"):
        ends = np.sort([(-1.0 - eye) / d, (1.0 - eye) / d], axis=0)
    near, far = ends[0].max(), ends[1].min()
    t = (np.arange(n) + 0.5) * ((far - near) / n)
    x = eye + (near + t[:, None]) * d
    to_light = light - x
    r = np.linalg.norm(to_light, axis=1)
    wo = to_light / r[:, None]
    with np.errstate(divide="ignore"):
        leaves = np.where(wo > 0.0, (1.0 - x) / wo, (-1.0 - x) / wo).min(axis=1)
    passed = np.exp(-sigma * (t * area(values, d) + leaves * area(values, wo)))
    value = albedo * sigma * area(values, d) * expected(values, d, wo) * passed * INTENSITY / r**2
    return value.sum() * ((far - near) / n)


def test_light_scattered_once(slab):
    """By each number of S, which turns flakes, and lets light pass to them and from them; by the density and albedo."""
    inside = {**medium(0.5, 0.6), "phase": {"type": "sggx", "S": FLAKES["turned"]}}
    view = camera([-3.0, 0, -4.0], [0, 0, 0], 0.05, up=(0, 1, 0))
    scene = psdr.load_dict(whole(sensor=view, slab=cube(inside), bulb=point(LIGHT, (INTENSITY,) * 3)))
    at = np.array([*FLAKES["turned"], 0.5, 0.6])
    h = 1e-4 * np.eye(8)
    slopes = [
        (scattered_once((at + e)[:6], *(at + e)[6:]) - scattered_once((at - e)[:6], *(at - e)[6:])) / 2e-4 for e in h
    ]
    params = psdr.traverse(scene)
    params.requires_grad_only(*NAMES)
    adjoint = np.full((4, 4, 3), 1.0 / 48.0, np.float32)
    found = []
    for seed in range(8):
        params.zero_grad()
        integrator = psdr.PathIntegrator(max_depth=2)
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=4096, seed=seed)
        found.append(np.concatenate([params[name].grad.numpy().reshape(-1) for name in NAMES]))
    assert_mean(np.array(found, np.float64), np.array(slopes), "derivatives", WIDTH)
    assert np.abs(slopes).min() > 5e-4 and np.std(found, axis=0).max() < 0.05 * np.abs(slopes).max()
    image = batches(scene, spp=4096, max_depth=2).mean(axis=(1, 2))
    assert_mean(image, scattered_once(at[:6], *at[6:]), "radiance", WIDTH)


@pytest.mark.slow
def test_what_moves_beside_light_scattered_once():
    """The bulb, by which shadow rays and turns change, and the camera, which looks along other directions."""
    inside = {**medium(0.5, 0.6), "phase": {"type": "sggx", "S": FLAKES["turned"]}}
    view = camera(EYE, [0, 0, 0], 0.05, up=(0, 1, 0))
    scene = psdr.load_dict(whole(sensor=view, slab=cube(inside), bulb=point(LIGHT, (INTENSITY,) * 3)))
    params = psdr.traverse(scene)
    params.requires_grad_only("bulb.position", "sensor.to_world")
    adjoint = np.full((4, 4, 3), 1.0 / 48.0, np.float32)
    pose = params["sensor.to_world"].numpy()
    found = []
    for seed in range(8):
        params.zero_grad()
        integrator = psdr.PathIntegrator(max_depth=2, boundary=None)
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=4096, seed=seed)
        by_light, by_pose = (params[name].grad.numpy().astype(np.float64) for name in params.requested)
        turns = [(by_pose * aim(*axis)(pose)).sum() for axis in np.eye(3)]
        found.append([*by_light, *turns, (by_pose * shift(0.0, 1.0, 0.0)(pose)).sum()])
    at, h = (FLAKES["turned"], 0.5, 0.6), 1e-4
    slopes = [(scattered_once(*at, LIGHT + h * e) - scattered_once(*at, LIGHT - h * e)) / (2.0 * h) for e in np.eye(3)]
    for axis in np.eye(3):
        d = [AHEAD + side * h * np.cross(axis, AHEAD) for side in (1.0, -1.0)]
        sides = [scattered_once(*at, d=v / np.linalg.norm(v)) for v in d]
        slopes.append((sides[0] - sides[1]) / (2.0 * h))
    up = h * np.array([0.0, 1.0, 0.0])
    slopes.append((scattered_once(*at, eye=EYE + up) - scattered_once(*at, eye=EYE - up)) / (2.0 * h))
    assert_mean(np.array(found), np.array(slopes), "derivatives", WIDTH)
    assert np.std(found, axis=0).max() < 0.05 * np.abs(slopes).max()


FLAKY = {**medium((0.8, 0.6, 1.0), (0.9, 0.8, 0.7)), "phase": {"type": "sggx", "S": FLAKES["turned"]}}
#: Depth, parameter, direction, largest share of noise.
ROWS = [
    (2, SQUARE, NORMAL, 0.02),
    (3, SQUARE, widen, 0.02),
    (3, SQUARE, aim(0, 1, 0), 0.02),
    (3, "lamp.to_world", shift(0, 0, 1), 0.02),
    (3, "sensor.to_world", aim(0, 1, 0), 0.1),
]


def curtain(inside):
    """The tilted square in a cube, between a lamp and a floor."""
    parts = {"sensor": camera([4, 1.0, 0.6], [0, 0, 0], 38.0, SIZE), "fog": cube(inside, turn=15.0)}
    square = {"type": "rectangle", "to_world": POSE, "bsdf": PAINT}
    return psdr.load_dict(whole(**parts, **LIGHTS["area"], square=square))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:samples that were not finite")  # rays through the cube's own edges
@pytest.mark.parametrize(("depth", "name", "motion", "noise"), ROWS, ids=[f"{i}-{r[1]}" for i, r in enumerate(ROWS)])
def test_what_moves_equals_finite_differences(depth, name, motion, noise):
    """With the boundary term; forward mode is the transpose."""
    scene = curtain(FLAKY)
    params = psdr.traverse(scene)
    names = [SQUARE, "lamp.to_world", "sensor.to_world"]
    tangent = motion(params[name].numpy())
    expected = [(ADJOINT * difference(scene, name, tangent, depth, 2048, 1 + i)).sum() for i in range(8)]
    error = np.std(expected, ddof=1) / np.sqrt(8)
    grads = moved(scene, names, ADJOINT, spp=1024, depth=depth, batches=8)
    mean_equals([(g[names.index(name)] * tangent).sum() for g in grads], np.mean(expected), error, noise)
    options = {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": 16, "seed": 50}
    image = psdr.render_forward(scene, params, dict.fromkeys(names, 0.0) | {name: tangent}, **options).numpy()
    once = moved(scene, names, ADJOINT, spp=16, depth=depth, batches=1)[0][names.index(name)]
    np.testing.assert_allclose((ADJOINT * image).sum(), (once * tangent).sum(), rtol=2e-3)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:samples that were not finite")
def test_flakes_of_all_directions_are_isotropic_where_things_move():
    """S = 4 has twice as many flakes in sight as S = 1 (A = 2), and no direction."""
    colours, albedo = np.array([0.8, 0.6, 1.0]), (0.9, 0.8, 0.7)
    flakes = {**medium(tuple(0.5 * colours), albedo), "phase": {"type": "sggx", "S": [4.0, 4.0, 4.0, 0, 0, 0]}}
    names = [SQUARE, "lamp.to_world", "fog.to_world"]
    motions = [(0, NORMAL), (0, widen), (0, aim(0, 1, 0)), (1, shift(0.2, 0.1, 1.0)), (2, aim(0.2, 1, 0))]
    found = []
    for inside in (flakes, medium(tuple(colours), albedo)):
        scene = curtain(inside)
        params = psdr.traverse(scene)
        at = [params[name].numpy() for name in names]
        grads = moved(scene, names, ADJOINT, spp=512, depth=3, batches=8)
        found.append(np.array([[(g[i] * motion(at[i])).sum() for i, motion in motions] for g in grads]))
    spread = np.sqrt(sum(f.var(axis=0, ddof=1) for f in found) / 8)
    assert (np.abs(found[0].mean(axis=0) - found[1].mean(axis=0)) < 4.0 * spread).all(), (found, spread)
    assert (spread < 0.05 * np.abs(found[1].mean(axis=0)).max()).all(), spread


@pytest.mark.slow
def test_forward_and_reverse_mode_are_adjoint(slab):
    scene, params = slab
    params.requires_grad_only(*NAMES)
    params.zero_grad()
    w = np.random.default_rng(0).normal(size=(4, 4, 3)).astype(np.float32)
    options = {"integrator": psdr.PathIntegrator(max_depth=4, rr_depth=3), "spp": 64, "seed": 2}
    psdr.render_backward(scene, params, w, **options)
    for name in NAMES:
        found = params[name].grad.numpy().astype(np.float64)
        v = np.random.default_rng(len(name)).normal(size=found.shape).astype(np.float32)
        image = psdr.render_forward(scene, params, dict.fromkeys(NAMES, 0.0) | {name: v}, **options).numpy()
        left, right = (image.astype(np.float64) * w).sum(), (found * v).sum()
        bound = 2e-5 * max(np.linalg.norm(image) * np.linalg.norm(w), np.linalg.norm(found) * np.linalg.norm(v))
        assert found.any() and abs(left - right) <= bound, (name, left, right, bound)


@pytest.mark.slow
def test_a_furnace_is_not_seen(slab):
    """Albedo 1 under a sky of 1: 1 at any depth, whatever S, sigma and how flakes are turned."""
    scene, params = slab
    params[NAMES[2]] = 1.0
    params.update()
    assert_mean(batches(scene, spp=256, max_depth=-1).mean(axis=(1, 2)), 1.0, "furnace", WIDTH)
    found = derivatives(scene, params, NAMES, spp=1024, depth=-1)
    # By the trace direction of S and by the density nothing changes; by the albedo it does.
    assert_mean(1.0 + found[:, 1], 1.0, "by the density", WIDTH)
    assert_mean(1.0 + found[:, 0], 1.0, "by S", WIDTH)
    assert found[:, 2].mean() > 0.5
    params[NAMES[2]] = 0.6
    params.update()


def test_edits_are_checked(slab):
    _scene, params = slab
    with pytest.raises(ValueError, match=r"S: after an edit the matrix has eigenvalues from -.*positive definite"):
        params[NAMES[0]] = [1.0, 1.0, 1.0, 2.0, 0.0, 0.0]
        params.update()
    params[NAMES[0]] = FLAKES["turned"]
    params.update()


def test_what_is_not_followed_is_refused(slab):
    scene, params = slab
    adjoint = np.ones((4, 4, 3), np.float32)
    params.requires_grad_only(NAMES[1])
    method = psdr.interior.DifferentialRatioTracking()
    with pytest.raises(ValueError, match=r"does not know 'sggx'.*use interior.Replay\(\)"):
        psdr.render_backward(scene, params, adjoint, integrator=psdr.PathIntegrator(interior=method), spp=4)


@pytest.mark.parametrize(
    ("media", "words"),
    [
        ({}, "there is no 'S'"),
        ({"S": [1.0, 1.0, 1.0]}, "give six numbers"),
        ({"S": "1, 1, 1, 2, 0, 0"}, "eigenvalues from -1 to 3; give a symmetric, positive definite matrix"),
        ({"S": [1.0, 1.0, np.nan, 0, 0, 0]}, "NaN or infinite"),
        ({"S": {"type": "constvolume", "value": 1.0}}, "a 'constvolume' for 'S'; give six numbers"),
        ({"S": {"type": "gridvolume", "data": np.ones((1, 1, 1, 3))}}, r"give numbers \(Z, Y, X, 6\)"),
    ],
)
def test_what_is_wrong_is_named(media, words):
    inside = {"type": "homogeneous", "phase": {"type": "sggx", **media}}
    with pytest.raises(ValueError, match=words):
        psdr.load_dict(whole(sensor=camera([0, 0, 5], [0, 0, 0], up=(0, 1, 0)), slab=cube(inside), sky=sky(1, 1, 1)))

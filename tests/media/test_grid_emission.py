"""Grids that emit light: a slab in closed form, with its derivatives by every layer, and thermal equilibrium."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.media.scenes import camera, cube, grid, grids, medium, rgb, sky, whole
from tests.path.helpers import assert_mean, batches

SLAB = "slab.interior_medium."
SIGMA, EMISSION, ALBEDO = SLAB + "sigma_t.data", SLAB + "emission.data", SLAB + "albedo.value.value"
SCALE, SKY = SLAB + "scale", "sky.radiance.value"
NAMES = (SIGMA, EMISSION, SCALE, ALBEDO, SKY)
SIZE, BATCHES = 4, 8
#: Absorbs the width of the camera and the step by which rays leave surfaces, relative.
WIDTH = 1e-3
#: Layers of extinction and of emission, seen from the last to the first, by channel: ramps, zeros, a step.
SIGMAS = np.array([[0.0, 0.4, 0.5], [0.2, 0.4, 0.0], [0.4, 0.4, 0.0], [0.6, 1.4, 0.0], [0.8, 1.4, 0.9]])
EMISSIONS = np.array([[0.5, 0.0, 1.0], [0.1, 2.0, 1.0], [0.7, 0.0, 1.0], [0.3, 0.0, 0.2]])
#: Weights of the channels.
W = np.array([1.0, 0.5, -0.7])
#: Both modes draw the same numbers: float32 sums of the same terms in another order, relative.
ROUNDING = 2e-5


@pytest.fixture(scope="module")
def scene():
    """A cube of side 2 with layers, before a sky, seen along its axis."""
    layers = [np.ones((len(x), 2, 3, 3)) * x[:, None, None, :] for x in (SIGMAS, EMISSIONS)]
    shining = {**grids(grid(layers[0]), (0.5, 0.5, 0.5), g=0.4), "emission": grid(layers[1])}
    view = camera([0, 0, 5], [0, 0, 0], up=(0, 1, 0), size=SIZE)
    return psdr.load_dict(whole(sensor=view, slab=cube(shining), sky=sky(1.0, 1.0, 1.0)))


def fill(scene, **values):
    params = psdr.traverse(scene)
    for key, value in values.items():
        name = {"sigma": SIGMA, "emission": EMISSION, "albedo": ALBEDO, "scale": SCALE, "sky": SKY}[key]
        params[name] = np.broadcast_to(np.asarray(value, np.float32), params[name].shape)
    params.update()


def gradients(scene, depth, spp, w=W):
    """Gradients of the image's weighted mean, of each of BATCHES seeds, by name."""
    params = psdr.traverse(scene)
    params.requires_grad_only(*NAMES)
    adjoint = np.broadcast_to(w / SIZE**2, (SIZE, SIZE, 3)).astype(np.float32)
    found = {name: [] for name in NAMES}
    for seed in range(BATCHES):
        params.zero_grad()
        integrator = psdr.PathIntegrator(max_depth=depth)
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=spp, seed=seed)
        for name in NAMES:
            found[name].append(params[name].grad.numpy().astype(np.float64))
    assert psdr.invalid_samples(scene)["interior"] == 0
    return {name: np.stack(values) for name, values in found.items()}


def tents(n, u):
    """Weights (n, points) of voxels at places u of [0, 1], interpolated between centres and constant beyond."""
    return np.stack([np.interp(u, (np.arange(n) + 0.5) / n, row) for row in np.eye(n)])


def by_quadrature(sigmas, emissions, scale, background):
    """Radiance (3,) of a length of 2, and its derivatives by layers of extinction and emission and by the scale."""
    n = 20000
    t = (np.arange(n) + 0.5) * (2.0 / n)
    u = 1.0 - t / 2.0  # the camera is on the last layer's side
    of_sigma, of_emission = tents(len(sigmas), u), tents(len(emissions), u)
    sigma, emission = of_sigma.T @ sigmas, of_emission.T @ emissions
    depth = scale * np.cumsum(sigma, axis=0) * (2.0 / n) - scale * sigma / n
    passed = np.exp(-depth)
    end = np.exp(-scale * sigma.sum(axis=0) * (2.0 / n)) * background
    seen = emission * passed * (2.0 / n)
    behind = np.cumsum(seen[::-1], axis=0)[::-1] - 0.5 * seen + end
    by_sigma = -(of_sigma @ behind) * (2.0 / n)
    by_emission = of_emission @ passed * (2.0 / n)
    return seen.sum(axis=0) + end, scale * by_sigma, by_emission, (by_sigma * sigmas).sum(axis=0)


@pytest.mark.slow_rows("1.5-0.3", "0.0-0.0")
@pytest.mark.parametrize(("scale", "background"), [(1.5, 0.3), (0.0, 0.0)])
def test_a_slab_of_layers(scene, scale, background):
    """Without scattering; by every layer, also where nothing absorbs."""
    fill(scene, sigma=SIGMAS[:, None, None, :], emission=EMISSIONS[:, None, None, :], scale=scale, sky=background)
    value, by_sigma, by_emission, by_scale = by_quadrature(SIGMAS, EMISSIONS, scale, background)
    found = batches(scene, spp=1024, max_depth=1).mean(axis=(1, 2))
    assert_mean(found, value, "radiance", WIDTH)
    found = gradients(scene, 1, 2048)
    assert_mean(found[EMISSION].sum(axis=(2, 3)), by_emission * W, "by layers of emission", WIDTH)
    assert_mean(found[SIGMA].sum(axis=(2, 3)), by_sigma * W, "by layers of extinction", WIDTH)
    assert_mean(found[SCALE], (by_scale * W).sum(), "by scale", WIDTH)
    assert not found[ALBEDO].any() and np.abs(found[EMISSION]).sum() > 0.1


@pytest.mark.slow
def test_a_homogeneous_slab_of_luminous_layers():
    """Of one extinction, with emission and albedo by grids; by every layer and by the extinction."""
    sigma = np.array([0.5, 1.2, 0.1])
    glow, black = (grid(np.ones((len(x), 2, 3, 3)) * x[:, None, None, :]) for x in (EMISSIONS, np.zeros((2, 3))))
    shining = {**medium(tuple(sigma), g=0.4), "albedo": black, "emission": glow}
    view = camera([0, 0, 5], [0, 0, 0], up=(0, 1, 0), size=SIZE)
    scene = psdr.load_dict(whole(sensor=view, slab=cube(shining), sky=sky(0.3, 0.3, 0.3)))
    params, extinction = psdr.traverse(scene), SLAB + "sigma_t.value.value"
    placed = {name for name in params if name.startswith(SLAB) and name.endswith("to_world")}
    assert placed == {SLAB + "albedo.to_world", SLAB + "emission.to_world"}
    value, by_sigma, by_emission, _by_scale = by_quadrature(sigma[None, :], EMISSIONS, 1.0, 0.3)
    assert_mean(batches(scene, spp=1024, max_depth=1).mean(axis=(1, 2)), value, "radiance", WIDTH)
    params.requires_grad_only(EMISSION, extinction)
    adjoint = np.broadcast_to(W / SIZE**2, (SIZE, SIZE, 3)).astype(np.float32)
    found = {EMISSION: [], extinction: []}
    for seed in range(BATCHES):
        params.zero_grad()
        psdr.render_backward(scene, params, adjoint, integrator=psdr.PathIntegrator(max_depth=1), spp=2048, seed=seed)
        for name, values in found.items():
            values.append(params[name].grad.numpy().astype(np.float64))
    assert_mean(np.stack(found[EMISSION]).sum(axis=(2, 3)), by_emission * W, "by layers of emission", WIDTH)
    assert_mean(np.stack(found[extinction]), by_sigma[0] * W, "by extinction", WIDTH)


@pytest.mark.slow
def test_in_equilibrium_nothing_is_seen(scene):
    """With epsilon = sigma (1 - albedo) L all is L at any depth, and stays so along that constraint."""
    albedo = np.array([0.9, 0.5, 0.7])
    # Four layers of both, so that they are interpolated alike.
    coarse = np.array([0.2, 1.0, 0.0, 0.7])[:, None] * np.array([1.0, 0.8, 0.5])
    four = np.ones((4, 2, 3, 3)) * coarse[:, None, None, :]
    shining = {**grids(grid(four), tuple(albedo), g=0.4), "emission": grid(four * (1.0 - albedo))}
    view = camera([0, 0, 5], [0, 0, 0], up=(0, 1, 0), size=SIZE)
    warm = psdr.load_dict(whole(sensor=view, slab=cube(shining), sky=sky(1.0, 1.0, 1.0)))
    assert_mean(batches(warm, spp=256, max_depth=-1).mean(axis=(1, 2)), 1.0, "equilibrium", WIDTH)
    found = gradients(warm, -1, 512, np.ones(3))
    by_sigma, by_emission = (found[name].sum(axis=(2, 3)) for name in (SIGMA, EMISSION))
    by_albedo = found[ALBEDO].reshape(-1, 3)
    assert (np.abs(by_sigma.mean(axis=0)) > 0.01).any() and (by_emission.mean(axis=0) > 0.1).all()
    assert_mean(1.0 + by_sigma + (1.0 - albedo) * by_emission, 1.0, "layers along the constraint", WIDTH)
    assert_mean(1.0 + by_albedo - (coarse * by_emission).sum(axis=1), 1.0, "albedo along the constraint", WIDTH)


@pytest.mark.slow
def test_forward_and_reverse_mode_are_adjoint(scene):
    fill(scene, sigma=SIGMAS[:, None, None, :], emission=EMISSIONS[:, None, None, :], scale=1.5, sky=0.3)
    params = psdr.traverse(scene)
    params.requires_grad_only(*NAMES)
    w = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
    options = {"integrator": psdr.PathIntegrator(max_depth=4, rr_depth=3), "spp": 64, "seed": 2}
    psdr.render_backward(scene, params, w, **options)
    for name in NAMES:
        found = params[name].grad.numpy().astype(np.float64)
        v = np.random.default_rng(len(name)).normal(size=found.shape).astype(np.float32)
        image = psdr.render_forward(scene, params, dict.fromkeys(NAMES, 0.0) | {name: v}, **options).numpy()
        left, right = (image.astype(np.float64) * w).sum(), (found * v).sum()
        bound = ROUNDING * max(np.linalg.norm(image) * np.linalg.norm(w), np.linalg.norm(found) * np.linalg.norm(v))
        assert found.any() and abs(left - right) <= bound, (name, left, right, bound)


def test_a_constant_shines_in_the_box_of_the_extinction():
    empty = {"type": "constvolume", "value": rgb(0.0, 0.0, 0.0)}
    shining = {**grids(empty, (0.0, 0.0, 0.0), g=0.4), "emission": 0.7}
    scene = psdr.load_dict(
        whole(
            sensor=camera([0.5, 0.5, 5], [0.5, 0.5, 0], up=(0, 1, 0), size=SIZE), slab=cube(shining), sky=sky(0, 0, 0)
        )
    )
    image = psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=1), spp=16).numpy()
    np.testing.assert_allclose(image, 0.7, rtol=WIDTH)  # the unit cube, as Mitsuba places it

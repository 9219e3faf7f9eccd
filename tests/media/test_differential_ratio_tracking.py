"""Differential ratio tracking: the derivatives of replay, formulas where nothing is, both modes, what it refuses."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.media import scenes
from tests.media.scenes import camera, cube, grid, grids, medium, point, puffs, sky, whole
from tests.media.test_grid_gradients import BATCHES, NAMES, ROUNDING, W, gradients, mean_weights
from tests.media.test_grids import ALBEDO, COLUMN, DATA, SCALE, SIZE, WIDTH, set_values, slab
from tests.path.helpers import assert_mean, assert_same_mean

METHOD = psdr.interior.DifferentialRatioTracking()


@pytest.fixture(scope="module")
def scene():
    return psdr.load_dict(slab())


def test_where_nothing_is(scene):
    """Scattered once under a sky of 1, each layer's derivative is (a - 1) h where there is no density at all."""
    set_values(scene, data=0.0, albedo=0.6, scale=1.5)
    found = gradients(scene, mean_weights(), 2, 2048, interior=METHOD)
    expected = np.broadcast_to(1.5 * 0.4 * (0.6 - 1.0) * W, (5, 3))
    assert_mean(found[DATA].sum(axis=(2, 3)), expected, "no density", WIDTH)
    assert not found[ALBEDO].any() and not found[SCALE].any()


@pytest.mark.parametrize("column", ["layers", "plateau"])
def test_it_estimates_what_replay_does(scene, column):
    """By each layer and channel, with zeros in both, and where the density touches its majorant."""
    values = COLUMN if column == "layers" else np.full((5, 3), 0.4)
    set_values(scene, data=np.asarray(values)[:, None, None, :], albedo=0.7, scale=1.5)
    replay, ratio = (
        gradients(scene, mean_weights(), 3, 1024, interior=method) for method in (psdr.interior.Replay(), METHOD)
    )
    for name in NAMES:
        assert replay[name].any()
        shape = (BATCHES, 5, 3) if name == DATA else (BATCHES, -1)
        a, b = (
            found.sum(axis=(2, 3)).reshape(shape) if name == DATA else found.reshape(shape)
            for found in (ratio[name], replay[name])
        )
        assert_same_mean(a, b, f"{name}, {column}")


@pytest.mark.slow
@pytest.mark.parametrize("light", ["sky", "bulb"])
def test_voxels_of_smoke(light):
    """By blocks of voxels, under a sky and beside a point light."""
    lights = {"sky": sky(1.0, 0.8, 0.6)} if light == "sky" else {"bulb": point([2, -1.5, 2.5], (4, 4, 4))}
    parts = {"sensor": camera(*scenes.VIEW[:3], 16), "cube": cube(grids(grid(puffs(16)), 0.8, g=0.4, scale=4.0))}
    scene, name = psdr.load_dict(whole(**parts, **lights)), "cube.interior_medium.sigma_t.data"
    adjoint = np.full((16, 16, 3), 1.0 / 768.0, np.float32)
    found = [
        gradients(scene, adjoint, 5, 256, (name,), interior=method)[name]
        .reshape(BATCHES, 4, 4, 4, 4, 4, 4)
        .sum(axis=(2, 4, 6))
        for method in (METHOD, psdr.interior.Replay())
    ]
    assert_same_mean(*found, light)


@pytest.mark.slow
def test_forward_and_reverse_mode_are_adjoint(scene):
    set_values(scene, data=COLUMN[:, None, None, :], albedo=0.7, scale=1.5)
    params = psdr.traverse(scene)
    params.requires_grad_only(*NAMES)
    w = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
    v = {name: np.random.default_rng(i).normal(size=params[name].numpy().shape) for i, name in enumerate(NAMES)}
    integrator = psdr.PathIntegrator(max_depth=4, interior=METHOD)
    # The stretch is chosen by the adjoint, which the two modes have different ones of: they agree in the mean.
    left, right = [], []
    for seed in range(16):
        params.zero_grad()
        psdr.render_backward(scene, params, w, integrator=integrator, spp=256, seed=seed)
        right.append([sum((params[name].grad.numpy().astype(np.float64) * v[name]).sum() for name in NAMES)])
        tangents = {name: value.astype(np.float32) for name, value in v.items()}
        image = psdr.render_forward(scene, params, tangents, integrator=integrator, spp=256, seed=seed).numpy()
        left.append([(image.astype(np.float64) * w).sum()])
    assert_same_mean(np.array(left), np.array(right), "adjoint", ROUNDING)


def test_any_number_of_workers_gives_equal_bits(scene):
    set_values(scene, data=COLUMN[:, None, None, :], albedo=0.7, scale=1.5)
    first = gradients(scene, mean_weights(), 3, 32, interior=METHOD)
    before = psdr.set_workers(1)
    try:
        again = gradients(scene, mean_weights(), 3, 32, interior=METHOD)
    finally:
        psdr.set_workers(before)
    for name, found in first.items():
        assert found.any()
        np.testing.assert_array_equal(found, again[name])


def test_what_it_refuses_and_the_plan(scene):
    integrator = psdr.PathIntegrator(interior=METHOD)
    with pytest.raises(ValueError, match=r"draws points for the density.*Use interior.Replay\(\)"):
        psdr.plan(scene, names=[ALBEDO], integrator=integrator)
    homogeneous = psdr.load_dict(whole(sensor=camera([3, 2, 5], [0, 0, 0]), cube=cube(medium()), sky=sky(1, 1, 1)))
    with pytest.raises(ValueError, match="'heterogeneous' media"):
        psdr.plan(homogeneous, names=["cube.interior_medium.scale"], integrator=integrator)
    assert "differential ratio tracking" in str(psdr.plan(scene, names=[DATA], integrator=integrator))
    with pytest.raises(ValueError, match="block"):
        psdr.interior.DifferentialRatioTracking(block=0)

"""Error bars of gradients: they hold, they cost no bias, and what they do not go with is refused."""

import numpy as np
import pytest
from scipy import stats

import warp_psdr as psdr

SIZE = 12
LEVEL = 0.95


@pytest.fixture(scope="module")
def box():
    """The Cornell box with a moving box and colours asked for, and an adjoint."""
    description = psdr.cornell_box()
    description["sensor"]["film"] |= {"width": SIZE, "height": SIZE}
    scene = psdr.load_dict(description)
    params = psdr.traverse(scene)
    adjoint = np.random.default_rng(0).uniform(0.5, 1.5, (SIZE, SIZE, 3)).astype(np.float32)
    return scene, params, adjoint


def gradient(box, names, spp, seed, **more):
    scene, params, adjoint = box
    params.requires_grad_only(*names)
    params.zero_grad()
    psdr.render_backward(
        scene, params, adjoint, integrator=psdr.PathIntegrator(max_depth=3), spp=spp, seed=seed, **more
    )
    held = [params[n].grad.numpy().astype(float) for n in names]
    deviations = [params[n].std.numpy().astype(float) for n in names] if more.get("errors") else []
    return held, deviations


def test_bars_hold_the_mean_of_many(box):
    names = ["small-box.vertex_positions", "red.reflectance.value"]
    runs = [gradient(box, names, 32, seed, errors=True) for seed in range(24)]
    plain = [gradient(box, names, 32, 900 + seed)[0] for seed in range(24)]
    factor = stats.t.ppf(0.5 + 0.5 * LEVEL, 7)
    for i, name in enumerate(names):
        values, bars = np.array([r[0][i] for r in runs]), np.array([r[1][i] for r in runs])
        mean, other = values.mean(axis=0), np.mean([p[i] for p in plain], axis=0)
        told = bars.mean(axis=0) > 0.0
        assert np.any(told), name
        held = np.abs(values - mean)[:, told] < factor * bars[:, told] * np.sqrt(1.0 - 1.0 / len(runs))
        assert 0.90 < held.mean() < 0.99, name
        # No bias: both kinds of runs have one mean.
        deviation = np.sqrt((values.var(axis=0, ddof=1) + np.var([p[i] for p in plain], axis=0, ddof=1)) / 24.0)
        assert np.sqrt(np.mean(((mean - other)[told] / deviation[told]) ** 2)) < 1.8, name


def test_gradients_that_add_up_have_bars_that_do(box):
    scene, params, adjoint = box
    name, integrator = "red.reflectance.value", psdr.PathIntegrator(max_depth=3)
    one, first = gradient(box, [name], 16, 1, errors=True)
    again, second = gradient(box, [name], 16, 2, errors=True)
    params.zero_grad()
    assert np.all(params[name].std.numpy() == 0.0)
    for seed in (1, 2):
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=16, seed=seed, errors=True)
    np.testing.assert_allclose(params[name].grad.numpy(), one[0] + again[0], rtol=1e-5)
    np.testing.assert_allclose(params[name].std.numpy(), np.hypot(first[0], second[0]), rtol=1e-5)
    # What is added without bars leaves none that would hold.
    psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=16, seed=3)
    assert not hasattr(params[name], "std")
    with pytest.raises(ValueError, match="gradient without error bars; call params"):
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=16, seed=4, errors=True)
    params.zero_grad()
    psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=16, seed=4, errors=True)
    params.requires_grad_only()
    assert not hasattr(params[name], "std")


def test_what_bars_do_not_go_with_is_refused(box):
    scene, params, adjoint = box
    params.requires_grad_only("red.reflectance.value")
    for options, message in (
        ({"spp": 12}, "12 samples a pixel; they are split into 8 equal batches"),
        ({"spp": 16, "samples": (0, 8)}, "errors and samples exclude each other"),
        ({"time_budget": 1.0}, "errors"),
    ):
        with pytest.raises(ValueError, match=message):
            psdr.render_backward(scene, params, adjoint, errors=True, **options)


def test_arrows_of_noise_are_grey(box, tmp_path):
    from warp_psdr.view.fields import arrows

    rng = np.random.default_rng(1)
    places, vectors = rng.normal(size=(30, 3)), rng.normal(size=(30, 3))
    unsure = np.arange(30) % 2 == 0
    drawn = arrows(places, vectors, unsure=unsure, count=100)
    chosen = [int(np.argmin(np.abs(places - start).sum(axis=1))) for start in drawn.starts]
    np.testing.assert_array_equal(drawn.unsure, unsure[chosen])
    scene, params, _adjoint = box
    gradient(box, ["small-box.vertex_positions"], 16, 3, errors=True)
    psdr.view(
        scene, params, fields="small-box.vertex_positions", screenshot=tmp_path / "grey.png", window_size=(320, 240)
    )
    assert (tmp_path / "grey.png").stat().st_size > 1000

"""Least squares of many numbers: conjugate gradients take the steps of the normal equations, which nobody makes."""

from contextlib import nullcontext

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr.observe.krylov import Products
from warp_psdr.observe.problem import Problem, normal_equations

from .board import NEAR, POSE, SQUARES, TRUE, node

#: Float32 sums in another order.
SUMMATION = 1.0e-5
CORNERS = "board.vertex_positions"


def test_products_are_those_of_the_normal_equations(photo):
    scene = psdr.load_dict(node(NEAR))
    params = psdr.traverse(scene)
    observed = psdr.Photograph(photo, unknowns=["exposure"])
    problem = Problem(scene, params, observed, [psdr.unknowns.Rigid(POSE)], None)
    looks = [[problem.sides(seed, 8, each=each) for seed in (1, 2)] for each in (True, False)]
    robust = [np.linspace(0.2, 1.0, observed.weights[..., 0].size).reshape(*observed.shape, 1)]
    whole = normal_equations(*looks[0], robust, problem.size)
    products = Products(problem, *looks[1], robust, seed=0)
    np.testing.assert_allclose(products.g, whole.g, rtol=SUMMATION, atol=SUMMATION * np.abs(whole.g).max())
    size = np.sqrt(np.diag(whole.h))
    for i, row in enumerate(np.eye(problem.size)):
        found = products.product(row)
        np.testing.assert_allclose(found / size / size[i], whole.h[i] / size / size[i], atol=SUMMATION)
    # Both promise the same of a step, and conjugate gradients find nearly the best one.
    step = whole.step(0.0)
    assert products.promised(step) == pytest.approx(whole.promised(step), rel=1e-3)
    assert products.promised(products.step(1e-6)) > 0.95 * whole.promised(step)
    assert params.requested == [], "gradients are asked of parameters of its own"


def test_thousands_of_texels_come_to_the_photograph(photo):
    scene = psdr.load_dict(node(TRUE))
    params = psdr.traverse(scene)
    name = next(n for n in params if n.endswith("reflectance.data"))
    params[name] = np.full(params[name].shape, 0.4, np.float32)
    params.requires_grad(name)
    with pytest.warns(RuntimeWarning, match="4 steps were not enough"):
        found = psdr.solve(scene, params, psdr.Photograph(photo, exposure=0.7), spp=8, steps=4)
    assert len(found.values) == SQUARES.size == 2304
    first = found.steps[0]
    assert first.after < 0.05 * first.before
    # What the photograph's own noise is, and its eight bits.
    assert found.rms < 0.005
    seen = params[name].numpy()[8:16, 8:24] - (0.2 + 0.5 * SQUARES)[8:16, 8:24]
    assert abs(seen.mean()) < 0.01 and np.corrcoef(params[name].numpy().ravel(), SQUARES.ravel())[0, 1] > 0.8
    assert "2280 more" in str(found) and "no error bars" in str(found) and found.undetermined == ()
    for ask in (lambda: found.std, lambda: found.interval(), lambda: found.directions):
        with pytest.raises(ValueError, match="conjugate gradients give no error bars"):
            ask()


@wp.kernel
def bent(corners: wp.array(dtype=wp.vec3), numbers: wp.array(dtype=float), positions: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    x = numbers[3 * i]
    positions[i] = corners[i] + wp.vec3(wp.sin(x), numbers[3 * i + 1], wp.exp(numbers[3 * i + 2]) - 1.0)


def taped(params, start):
    corners = wp.clone(params[CORNERS])

    def place(numbers: wp.array) -> dict:
        positions = wp.zeros(len(corners), dtype=wp.vec3, device=numbers.device, requires_grad=True)
        wp.launch(bent, len(corners), [corners, numbers], [positions], device=numbers.device)
        return {CORNERS: positions}

    return psdr.unknowns.Taped(place, wp.array(np.float32(start), device=params[CORNERS].device))


def test_a_tape_is_the_transpose_of_its_differences():
    rng = np.random.default_rng(4)
    params = psdr.traverse(psdr.load_dict(node(NEAR)))
    unknown = taped(params, rng.uniform(0.3, 0.6, 12))
    direction, weights = rng.normal(size=12), rng.normal(size=(4, 3))
    forth = float((unknown.push(params, direction)[CORNERS] * weights).sum())
    back = float(unknown.pull(params, {CORNERS: np.float32(weights)}) @ direction)
    assert forth == pytest.approx(back, rel=1e-3) and abs(back) > 0.1
    assert len(unknown.tangents(params)) == 12 and unknown.push(params, 0.0 * direction) == {}
    with pytest.raises(ValueError, match="got 2 labels of 12 numbers"):
        psdr.unknowns.Taped(lambda x: {}, unknown.x, ["a", "b"])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["conjugate_gradients", "dense"])
def test_numbers_behind_a_kernel_come_back(photo, method):
    scene = psdr.load_dict(node(TRUE))
    params = psdr.traverse(scene)
    exact = params[CORNERS].numpy().astype(float)
    unknown = taped(params, np.zeros(12))
    unknown.restore(params, np.tile([0.02, -0.01, 0.1], 4))
    observed = psdr.Photograph(photo, exposure=0.7)
    # A board of another size further off looks the same: normal equations name that, conjugate gradients leave it.
    named = pytest.warns(RuntimeWarning, match="the pictures do not tell") if method == "dense" else nullcontext()
    with named:
        found = psdr.solve(scene, params, observed, unknowns=[unknown], spp=8, method=method)
    held = params[CORNERS].numpy()
    apart = held * ((held * exact).sum() / (held**2).sum()) - exact
    assert np.abs(apart).max() < 0.02 and np.sqrt((apart**2).mean()) < 0.01
    assert found.rms < 0.005

"""The direct and the indirect boundary: together the whole term, and each what finite differences say."""

import math
from dataclasses import replace

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.accuracy import quantity
from warp_psdr.estimate.boundary.drivers import launch_backward
from warp_psdr.estimate.boundary.terms import TERMS, Request, launches
from warp_psdr.estimate.gradient_sums import GradientSums
from warp_psdr.plan.motion import motion

from . import test_curves, test_horizon  # noqa: F401  register scenes
from .measure import BATCHES, SEED, SUMMATION, WEIGHT_SEED, Case, move, slope
from .scenes import SIZE, load
from .test_table import BOX, OCCLUDER, moved

EDGES, GUIDED = psdr.boundary.EdgeSampling(), psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree(max_leaves=256))
DEPTH = 4
#: Largest deviate of a z-test whose seed is fixed: one value in 15,000.
Z = 4.0


def adjoint():
    return np.random.default_rng(1).normal(1.0, 1.0, (SIZE, SIZE, 3)).astype(np.float32)


def gradient_of(scene_name, name, method="auto", depth=DEPTH):
    scene, params = load(scene_name)
    params.requires_grad_only(name)
    integrator = psdr.PathIntegrator(max_depth=depth, boundary=method)
    return quantity.gradient(scene, params, adjoint(), integrator=integrator, sensor=0)


def batch(what, name, term, spp, seed, *, depth=DEPTH, indirect=False):
    """One run of a boundary term at a seed of its own."""
    import warp as wp

    plan = replace(what.plan, max_depth=depth)
    request = Request(what.scene, plan, motion(what.scene, [name]), "reverse", 0, spp, seed, indirect)
    sums = GradientSums(what.scene, [name])
    launch_backward(what.scene, launches(term, request), wp.array(what.adjoint, dtype=wp.vec3), sums)
    record = what.scene.parameters[name]
    return sums.result().numpy()[record.offset : record.offset + record.size].astype(np.float64)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "name", "method", "term"),
    [
        ("sky", OCCLUDER, "auto", "secondary"),
        pytest.param("lamp", BOX, EDGES, "hard_shadows", marks=pytest.mark.slow),
        pytest.param("glowing box", "shape.vertex_positions", "auto", "intersection_curve", marks=pytest.mark.slow),
        pytest.param("ball and floor", "light.vertex_positions", "auto", "intersection_curve", marks=pytest.mark.slow),
        pytest.param("ball and floor", "light.vertex_positions", "auto", "geometric_horizon", marks=pytest.mark.slow),
    ],
)
def test_parts_add_up_sample_by_sample(scene, name, method, term) -> None:
    # With equal random numbers: where whole and parts draw the same segments, the parts add up to the last bits.
    what = gradient_of(scene, name, method)
    function = next(t for t in TERMS[type(what.plan.boundary)] if t.name == term)
    for seed in range(3):
        whole = batch(what, name, function, 32, seed)
        direct = batch(what, name, function, 32, seed, depth=2)
        indirect = batch(what, name, function, 32, seed, indirect=True)
        assert np.abs(direct).max() > 0.05 * np.abs(whole).max()
        np.testing.assert_allclose(direct + indirect, whole, atol=SUMMATION * np.abs(whole).max())
        if scene != "glowing box":  # whose light meets one surface only
            assert np.abs(indirect).max() > 0.01 * np.abs(whole).max()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "method", "batches"),
    [
        ("floating", "auto", 64),
        pytest.param("floating", GUIDED, 64, marks=pytest.mark.slow),
        pytest.param("floating", EDGES, 96, marks=pytest.mark.slow),
        pytest.param("lamp", "auto", 192, marks=pytest.mark.slow),
    ],
)
def test_means_add_up(scene, method, batches) -> None:
    # Independent batches: direct light draws its segments otherwise than the whole does.
    what = gradient_of(scene, BOX, method)
    function = next(t for t in TERMS[type(what.plan.boundary)] if t.name in ("secondary", "edge_sampling"))
    parts = [p for p in what.parts if p.name in ("direct boundary", "indirect boundary")]
    directions = np.random.default_rng(2).normal(size=(what.blocks[BOX].stop, 6))
    whole = np.array([batch(what, BOX, function, 64, 5000 + b) for b in range(batches)]) @ directions
    found = [np.array([p.run(64, 100_000 * i + b) for b in range(batches)]) @ directions for i, p in enumerate(parts)]
    assert len(found) == 2
    total = sum(found)
    error = np.sqrt((whole.var(axis=0, ddof=1) + total.var(axis=0, ddof=1)) / batches)
    assert (np.abs(whole.mean(axis=0) - total.mean(axis=0)) < Z * error).all()
    for part in found:  # neither could be left out unnoticed
        assert np.abs(part.mean(axis=0) / error).max() > 3.0 * Z


@pytest.mark.slow
def test_parts_are_independent_at_equal_seeds() -> None:
    # The pilot runs all terms with one seed a round, and takes the variance of their sum for the sum of variances.
    what = gradient_of("floating", BOX)
    direct, indirect = (p for p in what.parts if p.name in ("direct boundary", "indirect boundary"))
    a, b = (np.array([p.run(4, seed) for seed in range(200)]) for p in (direct, indirect))
    a, b = (x - x.mean(axis=0) for x in (a, b))
    correlation = (a * b).mean(axis=0) / np.sqrt((a**2).mean(axis=0) * (b**2).mean(axis=0))
    assert np.abs(correlation).max() < 5.0 / math.sqrt(200)


@pytest.mark.parametrize(
    ("depth", "method", "names"),
    [
        (1, "auto", ["interior", "primary boundary"]),
        (2, "auto", ["interior", "primary boundary", "direct boundary"]),
        (3, "auto", ["interior", "primary boundary", "direct boundary", "indirect boundary"]),
        (-1, EDGES, ["interior", "primary boundary", "direct boundary", "indirect boundary"]),
    ],
)
def test_parts_have_names(depth, method, names) -> None:
    assert [p.name for p in gradient_of("floating", BOX, method, depth).parts] == names


@pytest.mark.slow
def test_each_part_agrees_with_finite_differences() -> None:
    # Direct: images of depth 2. Indirect: of depth 4 less those of depth 2, as interior and primary terms are there.
    scene, params = load("floating")
    case = Case("floating", BOX, moved(1.0, -0.5, 0.2), 0.01, "a box moves", depth=DEPTH, spp=1024, difference_spp=4096)
    base = params[BOX].numpy().astype(np.float64)
    tangent = np.asarray(case.tangent(base), np.float64)

    def image(sign, depth, seed):
        move(params, {BOX: base + sign * case.step * tangent})
        integrator = psdr.PathIntegrator(max_depth=depth)
        return psdr.render(scene, integrator=integrator, spp=case.difference_spp, seed=seed).numpy().astype(np.float64)

    def difference(depth, seed):
        return (image(1.0, depth, seed) - image(-1.0, depth, seed)) / (2.0 * case.step)

    def both(seed):
        direct = difference(2, seed)
        return direct, difference(DEPTH, seed) - direct

    try:
        weights = [np.mean(pair, axis=0) for pair in zip(*(both(WEIGHT_SEED + b) for b in range(2)), strict=True)]
        differences = [both(SEED + b) for b in range(BATCHES)]
    finally:
        move(params, {BOX: base})
    terms = []
    for depth in (2, DEPTH):
        options = {"integrator": psdr.PathIntegrator(max_depth=depth), "sensor": 0}
        what = quantity.derivative(scene, params, {BOX: tangent.astype(np.float32)}, **options)
        # Equal seeds: what both depths share is subtracted path by path.
        terms.append([{p.name: p.run(case.spp, SEED + b) for p in what.parts} for b in range(BATCHES)])
    for part, weight in enumerate(weights):
        scale = np.abs(weight).max()
        expected = np.array([(weight * d[part]).sum() / scale for d in differences])
        found = []
        for two, four in zip(*terms, strict=True):
            rest = [sum(v for n, v in t.items() if "direct" not in n) for t in (two, four)]
            value = rest[0] + two["direct boundary"] if part == 0 else rest[1] - rest[0] + four["indirect boundary"]
            found.append(float((weight.reshape(-1) * value).sum() / scale))
        value, error = slope(np.array(found), expected)
        assert error < 0.03, f"too noisy to tell: slope {value:.3f} +- {error:.3f}"
        assert abs(value - 1.0) < 3.0 * error + 0.01, f"slope {value:.3f} +- {error:.3f}"
        # Without the boundary part the slope is another: it is what is tested.
        name = ("direct boundary", "indirect boundary")[part]
        alone = np.mean([(weight.reshape(-1) * t[name]).sum() / scale for t in terms[part]]) / expected.mean()
        assert abs(alone) > 10.0 * error

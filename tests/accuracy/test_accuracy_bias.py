"""Bias: named, and measured by what an unbiased method gives."""

import math

import numpy as np
import pytest

import warp_psdr as psdr
from tests.accuracy.test_accuracy import ALBEDO, INTEGRATOR, POSITIONS, Z, adjoint
from tests.boundary import scenes
from warp_psdr.accuracy import Report, bias, quantity


@pytest.fixture(scope="module")
def soft():
    scene, params = scenes.load("soft")
    params.requires_grad(POSITIONS, ALBEDO)
    return scene, params


@pytest.mark.slow
def test_textbook_replay_and_a_missing_term_are_named(soft):
    scene, params = soft
    integrator = psdr.PathIntegrator(max_depth=2, interior=psdr.interior.Textbook(), boundary=None)
    found = bias.named(quantity.gradient(scene, params, adjoint(), integrator=integrator, sensor=0))
    assert [text.partition(":")[0] for text in found[:2]] == ["textbook replay", "boundary=None"]


def bias_of(scene, params, name, integrator, spp):
    """Squared relative bias of one parameter's gradient, from two long runs with equal seeds."""
    long = []
    for method in (integrator, psdr.PathIntegrator(max_depth=integrator.max_depth)):
        params.zero_grad()
        psdr.render_backward(scene, params, adjoint(), integrator=method, spp=spp, seed=11)
        long.append(params[name].grad.numpy().astype(np.float64))
    return ((long[1] - long[0]) ** 2).sum() / (long[0] ** 2).sum()


@pytest.mark.slow
def test_bias_is_measured(soft):
    scene, params = soft
    params.requires_grad_only(POSITIONS)
    try:
        options = {"clock": "cpu", "seconds": 0.5, "tiles": False}
        without = psdr.PathIntegrator(max_depth=2, boundary=None)
        found = psdr.accuracy(scene, params, adjoint(), integrator=without, **options)
        expected = bias_of(scene, params, POSITIONS, without, 1024)
        squared, error = found.bias_squared
        assert abs(squared - expected) < Z * error + 0.1 * expected and error < 0.35 * expected
        assert f"Bias, measured: {math.sqrt(squared):.2g} ±" in str(found)
        assert psdr.accuracy(scene, params, adjoint(), integrator=INTEGRATOR, **options).bias_squared is None
    finally:
        params.requires_grad_only(POSITIONS, ALBEDO)


@pytest.mark.slow
def test_bias_of_textbook_replay_on_black_is_measured():
    # What a black surface would send on of light from other surfaces is lost; of lights, only what a direction meets.
    black = scenes.ball((0.0, 0.0, 0.5), 0.4, scenes.diffuse(0.0))
    scene = psdr.load_dict({"type": "scene", **scenes.room(), "box": black})
    params = psdr.traverse(scene)
    name = "box.bsdf.reflectance.value"
    params.requires_grad(name)
    for depth in (2, 3):
        textbook = psdr.PathIntegrator(max_depth=depth, interior=psdr.interior.Textbook())
        options = {"clock": "cpu", "seconds": 1.0, "tiles": False, "integrator": textbook}
        squared, error = psdr.accuracy(scene, params, adjoint(), **options).bias_squared
        expected = bias_of(scene, params, name, textbook, 1024)
        assert abs(squared - expected) < Z * error + 0.1 * expected
        assert expected < 1e-3 if depth == 2 else (expected > 0.01 and error < 0.2 * expected)


@pytest.mark.slow
@pytest.mark.slow
def test_measured_bias_is_written_and_drawn(soft, tmp_path):
    scene, params = soft
    without = psdr.PathIntegrator(max_depth=2, boundary=None)
    report = psdr.accuracy(scene, params, adjoint(), integrator=without, clock="cpu", seconds=0.2, spp=4, tiles=False)
    report.save(tmp_path / "a.json")
    assert Report.load(tmp_path / "a.json") == report
    labels = [line.get_label() for line in report.plot().axes[0].get_lines()]
    assert labels[:3] == ["predicted, best split", "bias, measured", "with the bias"]

"""Planted defects in gradients of a soft shadow and a silhouette are found, and right ones raise no alarm."""

from pathlib import Path

import numpy as np
import pytest

import warp_psdr as psdr
from tests.boundary.scenes import load
from tests.pool.children import LONGEST, program
from warp_psdr.certify import subject as subjects
from warp_psdr.certify.certificate import BIASED
from warp_psdr.estimate.boundary import terms
from warp_psdr.options.boundary import PathSpace

#: Seconds; a defect is found after a few of them.
BUDGET = 60.0
POSITIONS, ALBEDO = "occluder.vertex_positions", "floor.bsdf.reflectance.value"

pytestmark = pytest.mark.slow


def certificate(scene: str, name: str, boundary="auto", checks="slope") -> psdr.Certificate:
    loaded, params = load(scene)
    params.requires_grad_only(name)
    integrator = psdr.PathIntegrator(max_depth=2, boundary=boundary)
    return psdr.certify(loaded, params, integrator=integrator, budget=BUDGET, checks=checks)


def without(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Plant a defect: some terms of the boundary are left out."""
    left = tuple(t for t in terms.TERMS[PathSpace] if t.name not in names)
    assert len(left) < len(terms.TERMS[PathSpace])
    monkeypatch.setitem(terms.TERMS, PathSpace, left)


def changed(monkeypatch: pytest.MonkeyPatch, change) -> None:
    """Plant a defect: gradients are what a function makes of them."""
    right = subjects.SceneSubject.gradients

    def gradients(self, adjoints, seed):
        return {name: change(g) for name, g in right(self, adjoints, seed).items()}

    monkeypatch.setattr(subjects.SceneSubject, "gradients", gradients)


def test_right_gradients_raise_no_alarm() -> None:
    for name in (POSITIONS, ALBEDO):
        assert certificate("soft", name, checks="all").ok is not False


def test_what_is_seen_comes_first() -> None:
    found = certificate("sun", "light.to_world")  # a shift of the sun changes nothing
    assert found.ok is True and found.findings[0].what == "turn"


def test_a_missing_boundary_term() -> None:
    assert certificate("soft", POSITIONS, boundary=None).ok is False


@pytest.mark.parametrize("term", ["primary", "secondary"])
def test_a_missing_term_of_the_boundary(monkeypatch: pytest.MonkeyPatch, term: str) -> None:
    without(monkeypatch, term)
    assert certificate("soft", POSITIONS).ok is False


def test_a_missing_term_is_found_by_another_method(monkeypatch: pytest.MonkeyPatch) -> None:
    without(monkeypatch, "secondary")
    found = certificate("soft", POSITIONS, checks="estimators")
    against = [f for f in found.findings if f.what == "PathSpace against EdgeSampling"]
    assert found.ok is False and [f.verdict for f in against] == [BIASED]


def test_a_factor_on_an_albedo(monkeypatch: pytest.MonkeyPatch) -> None:
    changed(monkeypatch, lambda g: 0.95 * g)
    found = certificate("soft", ALBEDO)
    assert found.ok is False and abs(found[ALBEDO].slope.value - 0.95) < 0.01


def test_a_small_factor_on_gradients_of_reverse_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded, params = load("soft")
    params.requires_grad_only(POSITIONS)
    options = {"integrator": psdr.PathIntegrator(max_depth=2), "checks": "identities", "tolerance": 0.001}
    assert psdr.certify(loaded, params, budget=BUDGET, **options).ok is True
    changed(monkeypatch, lambda g: 0.995 * g)
    found = psdr.certify(loaded, params, budget=BUDGET, **options)
    assert found.ok is False and "forward" in found.findings[0].what


def test_a_channel_that_is_swapped(monkeypatch: pytest.MonkeyPatch) -> None:
    changed(monkeypatch, lambda g: g[..., ::-1])
    assert certificate("soft", ALBEDO).ok is False


def test_a_geometry_term_that_is_detached(monkeypatch: pytest.MonkeyPatch) -> None:
    # What the light gains as it moves is all in the interior term.
    loaded, params = load("soft")
    right = subjects.render_backward
    interior = psdr.PathIntegrator(max_depth=2, boundary=None)

    def boundary_alone(scene, params, adjoint, **options):
        right(scene, params, adjoint, **options)
        kept = {name: params[name].grad.numpy() for name in params.requested}
        params.zero_grad()
        right(scene, params, adjoint, **{**options, "integrator": interior})
        for name, total in kept.items():
            params[name].grad.assign((total - params[name].grad.numpy()).astype(np.float32))

    monkeypatch.setattr(subjects, "render_backward", boundary_alone)
    params.requires_grad_only("light.vertex_positions")
    options = {"integrator": psdr.PathIntegrator(max_depth=2), "budget": BUDGET, "checks": "slope"}
    assert psdr.certify(loaded, params, **options).ok is False


@pytest.mark.parametrize("defect", ["bsdf", "weight", "light"])
def test_a_defect_in_a_kernel(tmp_path: Path, defect: str) -> None:
    output = tmp_path / "output"
    with program(output, "tests.certify.planted", defect) as process:
        assert process.wait(LONGEST) == 0, output.read_text()
    assert output.read_text().splitlines()[-1] == "False"

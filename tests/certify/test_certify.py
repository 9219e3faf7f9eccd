"""Certificates of a small scene: right gradients, planted defects, what stays as it was, files, the command."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

import warp_psdr as psdr
from tests.fit.scenes import SKY, TEXTURE, write_scene
from warp_psdr.certify import subject as subjects
from warp_psdr.certify.certificate import BIASED, NOT_SEEN, UNDECIDED, WITHIN, Certificate, Finding
from warp_psdr.certify.statistics import Slope
from warp_psdr.cli import main

#: Seconds of a certificate of the scene: it is decided after a fraction of them.
BUDGET = 20.0


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path)
    return "scene.xml"


@pytest.fixture
def scene(file: str) -> tuple[psdr.Scene, psdr.Parameters]:
    loaded = psdr.load_file(file)
    params = psdr.traverse(loaded)
    params.requires_grad(SKY, TEXTURE)
    return loaded, params


def scaled(monkeypatch: pytest.MonkeyPatch, name: str, factor: float) -> None:
    """Plant a defect: the gradient of a parameter is wrong by a factor."""
    right = subjects.SceneSubject.gradients

    def gradients(self, adjoints, seed):
        found = right(self, adjoints, seed)
        return found | {name: factor * found[name]}

    monkeypatch.setattr(subjects.SceneSubject, "gradients", gradients)


def test_right_gradients_are_within_the_tolerance(scene) -> None:
    certificate = psdr.certify(*scene, budget=BUDGET, checks="slope")
    assert certificate.ok is True and list(certificate) == [SKY, TEXTURE]
    for name in certificate:
        assert certificate[name].verdict == WITHIN and certificate[name].slope is not None
    assert all(f.check == "slope" and f.p_value > 0.5 for f in certificate.findings)
    assert "gradients: 2 within" in str(certificate) and TEXTURE in certificate._repr_html_()
    assert certificate.seconds < BUDGET


def test_a_factor_on_one_gradient_is_found(scene, monkeypatch: pytest.MonkeyPatch) -> None:
    scaled(monkeypatch, TEXTURE, 0.9)
    certificate = psdr.certify(*scene, budget=BUDGET, checks="slope")
    assert certificate.ok is False
    assert certificate[TEXTURE].verdict == BIASED and certificate[SKY].verdict == WITHIN
    slope = certificate[TEXTURE].slope
    assert abs(slope.value - 0.9) < 5.0 * slope.error + slope.remainder


def test_the_scene_stays_as_it_was(scene) -> None:
    loaded, params = scene
    psdr.render_backward(loaded, params, np.ones((10, 12, 3)), spp=2)
    kept = object()
    loaded.__dict__["_guiding"] = {"a structure": kept}
    loaded.__dict__["_interior"] = choices = {"a choice": kept}
    ledger, counts = loaded.invalid, loaded.invalid.snapshot()
    before = loaded.state()
    gradients = {name: params[name].grad.numpy().copy() for name in params.requested}
    psdr.certify(loaded, params, budget=0.2, checks="slope")
    after = loaded.state()
    assert after.values.tobytes() == before.values.tobytes() and after.local.keys() == before.local.keys()
    assert params.requested == [SKY, TEXTURE]
    for name, gradient in gradients.items():
        assert params[name].grad.numpy().tobytes() == gradient.tobytes()
    assert loaded.__dict__["_guiding"] == {"a structure": kept} and loaded.__dict__["_interior"] is choices
    assert "_guides" not in loaded.__dict__ and "_chooses" not in loaded.__dict__
    assert loaded.invalid is ledger and ledger.snapshot() == counts


def test_the_scene_stays_as_it_was_when_the_work_is_interrupted(scene, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded, params = scene
    before = loaded.state().values.tobytes()

    def fails(*_arguments, **_options):
        raise KeyboardInterrupt

    monkeypatch.setattr(subjects, "render", fails)  # values are moved at that time
    with pytest.raises(KeyboardInterrupt):
        psdr.certify(loaded, params, budget=0.2)
    assert loaded.state().values.tobytes() == before and "_guides" not in loaded.__dict__


def test_an_adjoint_that_sees_nothing_says_so(scene) -> None:
    certificate = psdr.certify(*scene, np.zeros((10, 12, 3)), budget=0.5, checks="slope")
    assert certificate.ok is None and certificate[SKY].verdict == NOT_SEEN
    assert certificate[SKY].slope is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"budget": 0.0}, "budget: got 0.0"),
        ({"level": 1.0}, "level: got 1.0, expected a number between 0.5 and 1"),
        ({"tolerance": -0.1}, "tolerance: got -0.1"),
        ({"tolerance": None}, "tolerance: got None"),
        ({"checks": "slopes"}, "checks: got 'slopes', expected 'all' or some of 'slope'"),
        ({"adjoint": np.ones((3, 3, 3))}, "adjoint: got shape"),
        ({"sensor": 7}, "sensor 7"),
        ({"sensor": [0, 1]}, "expected the number or the id of one"),
    ],
)  # fmt: skip
def test_wrong_options_are_named(scene, options, message) -> None:
    with pytest.raises(ValueError, match=message):
        psdr.certify(*scene, **options)


def test_nothing_requested_and_values_that_are_none(scene) -> None:
    loaded, params = scene
    params[TEXTURE].fill_(math.nan)
    with pytest.raises(ValueError, match=f"{TEXTURE!r} holds NaN"):
        psdr.certify(loaded, params)
    params.requires_grad_only()
    with pytest.raises(ValueError, match="nothing to differentiate"):
        psdr.certify(loaded, params)


def finding(verdict: str, **more) -> Finding:
    slope = None if verdict == NOT_SEEN else Slope(1.0, 0.01, 0.97, 1.03)
    given = {"check": "slope", "parameter": "p", "what": "value", "slope": slope, "p_value": 1.0, "batches": (8, 8)}
    return Finding(verdict=verdict, **{**given, **more})


def certificate_of(*findings: Finding) -> Certificate:
    names = tuple(dict.fromkeys(f.parameter for f in findings))
    return Certificate(parameters=names, findings=findings, level=0.99, tolerance=0.02, budget=1.0, seconds=0.5)


@pytest.mark.parametrize(
    ("findings", "ok"),
    [
        ([finding(WITHIN), finding(WITHIN, parameter="q")], True),
        ([finding(WITHIN), finding(UNDECIDED)], True),  # too noisy to say anything
        ([finding(WITHIN), finding(UNDECIDED, leans=True)], None),
        ([finding(UNDECIDED), finding(WITHIN, check="estimators")], None),  # two methods may share an error
        ([finding(WITHIN), finding(BIASED, check="estimators")], False),
        ([finding(WITHIN), finding(NOT_SEEN, parameter="q")], None),
        ([finding(BIASED), finding(UNDECIDED, parameter="q")], False),
    ],
)
def test_verdicts(findings, ok) -> None:
    assert certificate_of(*findings).ok is ok


def test_files(tmp_path: Path) -> None:
    made = certificate_of(finding(WITHIN), finding(UNDECIDED, parameter="q", seconds=math.inf, p_value=0.2))
    made.save(tmp_path / "c.json")
    made.html(tmp_path / "c.html")
    told = json.loads((tmp_path / "c.json").read_text())
    assert told["format"] == "warp_psdr certificate" and told["ok"] is None
    assert told["verdicts"] == {"p": WITHIN, "q": UNDECIDED}
    assert told["findings"][0]["slope"] == {"value": 1.0, "error": 0.01, "low": 0.97, "high": 1.03, "remainder": 0.0}
    assert told["findings"][1]["seconds"] is None  # JSON has no infinity
    page = (tmp_path / "c.html").read_text()
    assert page.startswith("<!doctype html>") and "http" not in page and "undecided" in page
    with pytest.raises(KeyError, match="says nothing of 'r'"):
        made["r"]


@pytest.mark.parametrize(("factor", "budget", "status"), [(1.0, BUDGET, 0), (0.9, BUDGET, 3), (1.0, 1.0e-3, 4)])
def test_exit_status(file: str, monkeypatch: pytest.MonkeyPatch, capsys, factor, budget, status) -> None:
    scaled(monkeypatch, SKY, factor)
    arguments = ["certify", file, "--param", SKY, "--check", "slope", "--budget", str(budget)]
    arguments += ["--tolerance", "0.02" if status != 4 else "0.0001"]
    assert main([*arguments, "--json", "c.json", "--html", "c.html"]) == status
    printed = capsys.readouterr().out
    assert SKY in printed and "wrote c.json" in printed
    assert json.loads(Path("c.json").read_text())["ok"] is {0: True, 3: False, 4: None}[status]


def test_exit_status_of_what_cannot_be_examined(file: str, capsys) -> None:
    assert main(["certify", file, "--param", "nothing"]) == 2
    assert "no parameter 'nothing'" in capsys.readouterr().err
    assert main(["certify", file, "--param", SKY, "--html", "no/c.html"]) == 2
    assert "there is no folder 'no'" in capsys.readouterr().err

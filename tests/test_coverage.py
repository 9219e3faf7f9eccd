"""The table of what works with what: what it allows has a gradient, and what it refuses is refused in its words."""

import re
import warnings

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.coverage import NO, NONE, YES, described
from warp_psdr.coverage_scenes import EFFECTS, KINDS, REQUESTS
from warp_psdr.plan.transient import shape_of

ROWS = [(kind, "") for kind in KINDS] + [("mesh", effect) for effect in EFFECTS]
#: Cells of the fast set: few kernels, and one of each form of motion.
FAST = {("mesh", "", "pose"), ("mesh", "", "material"), ("exact sphere", "", "material"), ("sdfgrid", "", "material")}
#: Effects that leave one pixel, whose single sample may meet nothing that moves.
ONE_PIXEL = ("radiancemeter", "irradiancemeter")


def asked(kind, effect, request):
    """The scene of a cell, what is requested, and how."""
    parts, names = described(kind, effect, request)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", psdr.SceneWarning)
        scene = psdr.load_dict(parts)
    return scene, names, REQUESTS[request].integrator


def gradients(scene, names, integrator, seed=3):
    """The gradients of the sum of an image; without names the image itself is computed."""
    if not names:
        return {"": psdr.render(scene, integrator=integrator, spp=1, seed=seed).numpy()}
    params = psdr.traverse(scene)
    params.requires_grad_only(*names)
    adjoint = np.ones((*shape_of(scene, 0), 3), np.float32)
    psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=1, seed=seed)
    return {name: params[name].grad.numpy() for name in names}


def assert_refused(cell) -> None:
    with pytest.raises(ValueError, match=re.escape(cell.reason[:40])) as error:
        gradients(*asked(cell.kind, cell.effect, cell.request))
    assert " ".join(str(error.value).split()) == cell.reason


CELLS = [
    pytest.param(
        *row, request, marks=() if (*row, request) in FAST else pytest.mark.slow, id=f"{' '.join(row)}, {request}"
    )
    for row in ROWS
    for request in REQUESTS
]


@pytest.mark.parametrize(("kind", "effect", "request_"), CELLS)
def test_a_cell_says_what_a_gradient_does(kind: str, effect: str, request_: str) -> None:
    (cell,) = psdr.coverage(kind=kind, effect=effect or None, request=request_)
    if cell.answer == NO:
        assert_refused(cell)
    if cell.answer != YES:
        return
    scene, names, integrator = asked(kind, effect, request_)
    for name, found in gradients(scene, names, integrator).items():
        shape = (*shape_of(scene, 0), 3) if name == "" else psdr.traverse(scene)[name].numpy().shape
        assert found.shape == shape and np.isfinite(found).all()
        assert np.abs(found).max() > 0.0 or effect in ONE_PIXEL


@pytest.mark.parametrize(("kind", "effect"), ROWS)
def test_what_the_table_refuses_is_refused_in_its_words(kind: str, effect: str) -> None:
    for cell in psdr.coverage(kind=kind, effect=effect or None):
        assert bool(cell.reason) == (cell.answer == NO)
        if cell.answer == NONE:
            assert described(kind, effect, cell.request) is None
        if cell.answer == NO:
            assert_refused(cell)


def test_the_table_has_what_is_known_to_work_and_not_to() -> None:
    table = {kind: psdr.coverage(kind=kind, request="as glass")[0] for kind in KINDS}
    assert [kind for kind, cell in table.items() if cell.answer == NO] == ["linearcurve", "bsplinecurve"]
    assert {psdr.coverage(kind=kind, request="vertex normals")[0].answer for kind in KINDS} == {YES}
    (refused,) = psdr.coverage(kind="sdfgrid", request="as plastic")
    assert "the 'plastic' of 'shape'" in refused.short and "make it rough" in refused.short
    assert refused.short in refused.reason and "boundary=None" not in refused.short


def test_a_table_of_one_kind_beside_an_effect_prints() -> None:
    table = psdr.coverage(kind="linearcurve", effect="media")
    assert [cell.row for cell in table] == ["linearcurve, media"] * len(REQUESTS)
    lines = repr(table).splitlines()
    assert lines[0].split()[:2] == ["image", "pose"] and lines[1].startswith("linearcurve, media  yes    no (1)")
    assert lines[3].startswith("1: what moves beside media is not followed where there is 'shape', a 'linearcurve'")
    assert table.markdown().splitlines()[2:4] == ["| image | yes |", "| pose | no (1) |"]
    assert "<td" in table._repr_html_()
    for given in ({"kind": "torus"}, {"effect": "fog"}, {"request": "colour"}):
        with pytest.raises(ValueError, match=rf"{next(iter(given))}: got '\w+', expected one of '"):
            psdr.coverage(**given)

"""Every parameter, in every method, against finite differences; what a method refuses is asserted too."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.kernels.bsdf.dispatch import COMPOSITES, MODELS
from warp_psdr.kernels.bsdf.model import Measured, Rate, Table

from . import measure
from .configs import CASES, METHODS, TEXTBOOK_REFUSES, TOGETHER
from .scenes import SIZE, load

#: Forward mode of the fast subset: ``test_adjoint_identity.py``.
FAST_METHODS = ("reverse",)
#: Scenes of the fast subset; kernels of every scene take some twenty seconds to compile.
FAST_SCENES = ("plane", "gap")
#: Its rows are among the handful of ``-m smoke``.
SMOKE_SCENE = "dome"


def rows():
    for case in CASES:
        for method in METHODS:
            fast = method in FAST_METHODS and case.scene in FAST_SCENES and not case.slow
            marks = [pytest.mark.smoke] * (case.scene == SMOKE_SCENE) if fast else [pytest.mark.slow]
            yield pytest.param(case, method, id=f"{case}-{method}", marks=marks)


def requested(case):
    """The parameters of a case's scene that are requested together."""
    _scene, params = load(case.scene)
    params.requires_grad_only(*TOGETHER[case.scene])
    return params.requested


@pytest.mark.slow_rows(
    "gap-ceiling.emitter.radiance.to_uv-4-reverse",
    "plane-floor.to_world-scale-3-reverse",
    "plane-floor.to_world-in plane-3-reverse",
    "plane-sensor.principal_point_offset_y-3-reverse",
    "gap-floor.vertex_positions-bend-4-reverse",
    "gap-ceiling.to_world-along the normal-4-reverse",
)
@pytest.mark.parametrize(("case", "method"), list(rows()))
def test_derivative_equals_finite_differences(case, method):
    mode, block = METHODS[method]
    names = requested(case)
    if block == 0 and case.scene in TEXTBOOK_REFUSES:
        with pytest.raises(ValueError, match=r"interior\.Textbook\(\), textbook replay.*interior\.Replay\(\)"):
            measure.derivative(case, mode, block, names, 0.0, np.ones((SIZE, SIZE, 3), np.float32))
        # What does not move vertices is claimed there too.
        if measure.is_geometric(case.parameter):
            return
        names = [case.parameter]
    measure.assert_agrees(measure.compare(case, mode, block, names))


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_derivative_is_the_same_when_nothing_else_is_requested(case, mode):
    measure.assert_agrees(measure.compare(case, mode, 8, [case.parameter]))


def test_every_parameter_of_every_scene_has_a_row_or_a_reason():
    # Poses move vertices (gap, plane, room) in the same way everywhere, so not every scene repeats every row.
    elsewhere = {"vertex_positions", "vertex_normals", "vertex_texcoords", "to_world", "x_fov", "to_uv"}
    elsewhere |= {"principal_point_offset_x", "principal_point_offset_y", "scale", "data", "value", "beam_width"}
    covered = {c.parameter.rsplit(".", 1)[-1] for c in CASES}
    assert elsewhere <= covered
    for name in {c.scene for c in CASES}:
        _scene, params = load(name)
        rest = {p for p in params if p not in {c.parameter for c in CASES if c.scene == name}}
        assert {p.rsplit(".", 1)[-1] for p in rest} <= covered, rest


def test_every_number_that_a_model_declares_has_a_row():
    """But for what is not differentiated: rates of sampling, tables, and what is measured on the surface."""
    # In ``tests/path/test_turned_normals.py`` the scale of a bump map is, without noise.
    covered = {("bumpmap", "scale")}
    for name in {c.scene for c in CASES}:
        scene, _params = load(name)
        rows = [c.parameter for c in CASES if c.scene == name]
        for bsdf in (side for shape in scene.description.shapes for side in (shape.bsdf, shape.bsdf.back) if side):
            for value, texture in bsdf.textures.items():
                if any(row == texture.path or row.startswith(f"{texture.path}.") for row in rows):
                    covered.add((bsdf.model, value))
    for model in (*MODELS, *COMPOSITES):
        for parameter in model.parameters:
            if not isinstance(parameter, Rate | Table | Measured):
                for value in getattr(parameter, "values", ()):
                    assert (model.plugin, value.name) in covered


@pytest.mark.parametrize(
    ("scene", "parameter", "reason"),
    [
        ("gap", "floor.vertex_positions", "silhouettes and shadows"),
        ("plane", "floor.to_world", "silhouettes and shadows"),
        ("plane", "sensor.to_world", "silhouettes that the camera sees"),
        ("plane", "point.position", "hard shadows"),
        ("plane", "spot.to_world", "hard shadows"),
        ("plane", "sun.to_world", "hard shadows"),
        ("dome", "floor.vertex_texcoords", "texture with steps"),
        ("mirror", "room.vertex_normals", "smooth mirrors and glass"),
        ("glass", "ball.bsdf.eta", "through the interface"),
    ],
)
def test_a_moving_discontinuity_is_never_left_out_in_silence(scene, parameter, reason):
    loaded, params = load(scene)
    params.requires_grad_only(parameter)
    left_out = psdr.plan(loaded, params, integrator=measure.integrator(2))
    assert any(parameter in d and reason in d for d in left_out.discontinuities)
    auto = psdr.PathIntegrator(max_depth=2)
    ones = np.ones((SIZE, SIZE, 3), np.float32)
    try:
        covered = psdr.plan(loaded, params, integrator=auto).boundary
    except ValueError as error:
        assert parameter in str(error)
        return
    if covered is not None:
        return  # a method of the boundary term takes it
    for call in (
        lambda: psdr.render_backward(loaded, params, ones, integrator=auto, spp=1),
        lambda: psdr.render_forward(loaded, params, {parameter: 1.0}, integrator=auto, spp=1),
    ):
        with pytest.raises(ValueError, match="boundary=None") as refused:
            call()
        assert parameter in str(refused.value)

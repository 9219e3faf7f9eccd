"""Discontinuities seen through chains of smooth mirrors and glass: slopes on finite differences, modes, refusals."""

import pytest

import warp_psdr as psdr

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows, slope
from .mirrors import CASES, ETA, GLASSES, LAMP, NEAR, OCCLUDER, WALL
from .scenes import load
from .test_table import moved


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("case", [c for c in CASES if not c.slow], ids=str)
def test_the_table_can_tell_a_missing_boundary_term(case: Case) -> None:
    value, error = slope(derivatives(case, "forward", None), differences(case)[2])
    assert abs(value - 1.0) > 0.05 + 3.0 * error


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["unseen in a mirror", "unseen in its mirror"])
def test_the_camera_looks_through_hidden_lights(scene: str) -> None:
    case = Case(scene, NEAR, moved(0.0, 0.0, 1.0), 0.01, "light rises", spp=128, difference_spp=512, hidden=True)
    value, error = slope(derivatives(case, "reverse"), differences(case)[2])
    assert error < 0.03
    assert abs(value - 1.0) < 3.0 * error


@pytest.mark.parametrize(
    ("name", "names", "depth"),
    [
        pytest.param("slab", [GLASSES, ETA, LAMP, "sensor.to_world"], 4, marks=pytest.mark.slow),
        pytest.param("glass ball", [GLASSES, ETA, LAMP, "sensor.to_world"], 4, marks=pytest.mark.slow),
        pytest.param("caustic", [WALL, LAMP, OCCLUDER, "floor.vertex_positions"], 3, marks=pytest.mark.slow),
        pytest.param("point in a mirror", ["light.position", WALL, "floor.to_world"], 3, marks=pytest.mark.slow),
    ],
)
def test_the_modes_are_transposes_of_each_other(name, names, depth) -> None:
    scene, params = load(name)
    assert_transposes(scene, params, names, {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": 16, "seed": 3})


def test_a_path_without_end_is_refused() -> None:
    scene, _params = load("slab")
    for depth in (-1, 17):
        with pytest.raises(ValueError, match="set max_depth to 16"):
            psdr.plan(scene, names=[LAMP], integrator=psdr.PathIntegrator(max_depth=depth))
    assert psdr.plan(scene, names=[LAMP], integrator=psdr.PathIntegrator(max_depth=16)).boundary is not None


def test_the_plan_names_the_search() -> None:
    scene, _params = load("slab")
    assert "through mirrors and glass: line search" in str(
        psdr.plan(scene, names=[LAMP], integrator=psdr.PathIntegrator(max_depth=4))
    )
    plain, _params = load("soft")
    assert "line search" not in str(
        psdr.plan(plain, names=["occluder.vertex_positions"], integrator=psdr.PathIntegrator(max_depth=2))
    )

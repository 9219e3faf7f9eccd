"""boundary.EdgeSampling: its derivatives against finite differences, and what it refuses."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import Case, assert_agrees, assert_transposes, derivatives, differences, rows, slope
from .scenes import T, ball, load, under
from .test_cameras import parallel as _orthographic_scenes  # noqa: F401  registers the cameras' scenes
from .test_path_space import gradients, scene_of
from .test_table import ALONG, BOX, FLOOR, OCCLUDER, PANEL, RECEIVER, apart, moved, scaled, turned

METHOD = psdr.boundary.EdgeSampling()
CASES = [
    Case("soft", OCCLUDER, ALONG, 0.01, "occluder moves", difference_spp=2048, slow=False),
    Case("soft", FLOOR, moved(0.0, 0.0, 1.0), 0.02, RECEIVER, spp=1024, difference_spp=4096),
    Case("soft", PANEL, ALONG, 0.02, "light moves", spp=512),
    Case("soft", PANEL, scaled, 0.04, "light scales", spp=512),
    Case("soft", (OCCLUDER, PANEL, FLOOR), apart, 0.01, "all move", spp=512, difference_spp=2048),
    Case("sky", OCCLUDER, ALONG, 0.01, "occluder moves", spp=1024, difference_spp=8192),
    Case("envmap", OCCLUDER, ALONG, 0.01, "occluder moves", spp=512, difference_spp=8192),
    # A rough mirror below the occluder, roughness 0.2 and 0.3.
    Case("rough", OCCLUDER, ALONG, 0.01, "occluder moves", spp=1024, difference_spp=4096),
    Case("rough", FLOOR, moved(0.2, 0.1, 1.0), 0.01, RECEIVER, spp=1024, difference_spp=4096),
    Case("rough sky", OCCLUDER, ALONG, 0.01, "occluder moves", spp=512, difference_spp=8192),
    # The camera.
    Case("soft", "sensor.to_world", ALONG, 0.01, "camera moves", difference_spp=2048),
    Case("soft", "sensor.to_world", turned(0), 0.003, "camera turns", difference_spp=4096),
    Case("parallel", "sensor.to_world", ALONG, 0.01, "camera moves", difference_spp=4096),
    Case("lens", "sensor.to_world", ALONG, 0.01, "camera moves", difference_spp=4096),
    Case("lens", OCCLUDER, ALONG, 0.01, "occluder moves out of focus", spp=512, difference_spp=4096),
    # Hard shadows, sampled from the edge.
    Case("point", OCCLUDER, ALONG, 0.01, "occluder moves"),
    Case("point", "light.position", ALONG, 0.01, "light moves"),
    # Interreflection, without and with a contact, which a point light meets too.
    Case("floating", BOX, moved(1.0, -0.5, 0.0), 0.01, "a box moves", depth=3, spp=1024, difference_spp=8192),
    Case("room", BOX, moved(1.0, -0.5, 0.0), 0.01, "a box on the floor moves", depth=3, spp=2048, difference_spp=8192),
    Case("lamp", BOX, moved(1.0, -0.5, 0.0), 0.015, "a box on the floor moves", depth=3, spp=512, difference_spp=8192),
]


@pytest.mark.slow_rows("soft, occluder moves, depth 2-forward")
@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode, METHOD), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_candidates_without_trees(mode: str) -> None:
    case = Case("soft", OCCLUDER, ALONG, 0.01, "occluder moves", spp=512, difference_spp=2048)
    method = psdr.boundary.EdgeSampling(tree=False)
    assert_agrees(derivatives(case, mode, method), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [
        Case("soft", FLOOR, moved(0.2, 0.1, 1.0), 0.02, RECEIVER, spp=512),
        Case("rough", OCCLUDER, ALONG, 0.01, "occluder moves", spp=512),
        Case("floating", BOX, moved(1.0, -0.5, 0.0), 0.005, "a box moves", depth=3, spp=1024),
        Case("lamp", BOX, moved(1.0, -0.5, 0.0), 0.005, "a box moves", depth=3, spp=512),
    ],
    ids=str,
)
def test_both_methods_estimate_the_same(case: Case) -> None:
    ours, theirs = (derivatives(case, "forward", b) for b in (METHOD, psdr.boundary.PathSpace()))
    value, error = slope(ours, theirs)
    assert error < 0.03
    assert abs(value - 1.0) < 3.5 * error


@pytest.mark.slow
def test_the_modes_are_transposes_of_each_other() -> None:
    scene, params = load("soft")
    names = [OCCLUDER, FLOOR, PANEL, "sensor.to_world", "sensor.x_fov"]
    integrator = psdr.PathIntegrator(max_depth=3, boundary=METHOD)
    assert_transposes(scene, params, names, {"integrator": integrator, "spp": 16, "seed": 3})


@pytest.mark.slow
def test_lights_of_all_kinds_at_once_and_the_scene_stays_as_it_was() -> None:
    # Shadow edges of the sun are drawn with probabilities of their own.
    sun = {"type": "directional", "direction": [0.3, 0.2, -1.0], "irradiance": {"type": "rgb", "value": [2.0] * 3}}
    light = {"type": "constant", "radiance": {"type": "rgb", "value": [0.5] * 3}}
    scene, params = scene_of(**{k: v for k, v in (under(light) | {"sun": sun}).items() if k != "sensor"})
    image = psdr.render(scene, spp=16, seed=1).numpy()

    def gradient(method, spp: int, seed: int) -> float:
        integrator = psdr.PathIntegrator(max_depth=2, boundary=method)
        found = psdr.render_forward(scene, params, {OCCLUDER: 1.0}, integrator=integrator, spp=spp, seed=seed)
        return float(found.numpy()[:8].sum())

    ours = np.array([gradient(METHOD, 512, seed) for seed in range(8)])
    np.testing.assert_array_equal(psdr.render(scene, spp=16, seed=1).numpy(), image)
    theirs = np.array([gradient(psdr.boundary.PathSpace(), 512, seed) for seed in range(8)])
    error = np.sqrt((ours.var(ddof=1) + theirs.var(ddof=1)) / 8)
    assert error < 0.03 * abs(theirs.mean())
    assert abs(ours.mean() - theirs.mean()) < 3.5 * error


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_workers() -> None:
    scene, params = load("soft")
    options = {"integrator": psdr.PathIntegrator(max_depth=2, boundary=METHOD), "spp": 8, "seed": 5}
    results = []
    try:
        for workers in (1, 3):
            psdr.set_workers(workers)
            image = psdr.render_forward(scene, params, {OCCLUDER: 1.0}, **options).numpy()
            results.append((image, gradients(scene, params, [OCCLUDER], np.ones((16, 16, 3)), **options)[OCCLUDER]))
    finally:
        psdr.set_workers(None)
    np.testing.assert_array_equal(results[0][0], results[1][0])
    np.testing.assert_array_equal(results[0][1], results[1][1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"candidates": 0}, "candidates: got 0, expected an integer from 1 to 16"),
        ({"candidates": 17}, "candidates: got 17"),
        ({"candidates": 2000, "tree": False}, "candidates: got 2000"),
        ({"candidates": True}, "candidates: got True"),
        ({"tree": 1}, "tree: got 1"),
        ({"spp_secondary": 0}, "spp_secondary: got 0"),
    ],
)
def test_wrong_options_are_refused(options, message) -> None:
    with pytest.raises(ValueError, match=message):
        psdr.boundary.EdgeSampling(**options)


def test_the_plan_names_it() -> None:
    scene, _params = load("soft")
    plan = psdr.plan(scene, names=[OCCLUDER], integrator=psdr.PathIntegrator(max_depth=2, boundary=METHOD))
    assert plan.boundary == METHOD
    assert next(line for line in plan.lines if line[0] == "boundary term")[1] == "boundary.EdgeSampling"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"occluder": ball((0, 0, 1), 0.4, {"type": "conductor"})}, "smooth mirrors and glass"),
        ({"occluder": ball((0, 0, 1), 0.4, {"type": "dielectric"})}, "smooth mirrors and glass"),
        (
            {"light": {"type": "spot", "to_world": T.translate([0, 0, 3]), "cutoff_angle": 20.0, "beam_width": 20.0}},
            "hard edge",
        ),
    ],
)
def test_what_is_not_covered_is_refused_by_name(change, message) -> None:
    light = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0] * 3}}
    objects = {k: v for k, v in (under(light) | change).items() if k != "sensor"}
    scene, params = scene_of(**objects)
    integrator = psdr.PathIntegrator(max_depth=3, boundary=METHOD)
    with pytest.raises(ValueError, match=rf"boundary\.EdgeSampling\(\) cannot(.|\n)*{message}"):
        psdr.render_forward(scene, params, {OCCLUDER: 1.0}, integrator=integrator, spp=1)

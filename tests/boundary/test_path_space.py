"""boundary.PathSpace: its two modes agree, its results are reproducible, and what it does not cover it refuses."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import assert_transposes
from .scenes import T, camera, diffuse, floor, load, mesh, occluder, panel, under

OCCLUDER = "occluder.vertex_positions"


def scene_of(**objects):
    scene = psdr.load_dict({"type": "scene", "sensor": camera(), **objects})
    return scene, psdr.traverse(scene)


def gradients(scene, params, names, adjoint, **options):
    params.requires_grad_only(*names)
    params.zero_grad()
    psdr.render_backward(scene, params, adjoint, **options)
    return {n: params[n].grad.numpy().copy() for n in names}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "names"),
    [
        ("soft", [OCCLUDER, "floor.to_world", "light.vertex_positions", "sensor.to_world", "sensor.x_fov"]),
        pytest.param("spot", [OCCLUDER, "light.to_world"], marks=pytest.mark.slow),
        pytest.param("sun", [OCCLUDER, "light.to_world"], marks=pytest.mark.slow),
        pytest.param("smooth", ["shape.vertex_positions", "sensor.to_world"], marks=pytest.mark.slow),
    ],
)
def test_the_modes_are_transposes_of_each_other(name, names) -> None:
    scene, params = load(name)
    assert_transposes(scene, params, names, {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 16, "seed": 3})


@pytest.mark.slow
def test_edges_close_to_a_light() -> None:
    # Half of the points of lights nearer than a hundredth of the scene seemed hidden by the light itself: slope 0.7.
    scene, params = load("close")
    found = []
    for method in (psdr.boundary.PathSpace(spp_secondary=4096), psdr.boundary.EdgeSampling(spp_secondary=256)):
        options = {"integrator": psdr.PathIntegrator(max_depth=2, boundary=method), "spp": 16}
        along = {OCCLUDER: np.tile(np.float32([0.0, -1.0, 0.0]), (4, 1))}
        images = [psdr.render_forward(scene, params, along, seed=s, **options).numpy() for s in range(8)]
        found.append(np.array(images, np.float64).sum(axis=(1, 2, 3)))
    mean, error = np.mean(found, axis=1), np.std(found, axis=1, ddof=1) / np.sqrt(8)
    assert (error < 0.03 * abs(mean)).all()
    assert abs(mean[0] - mean[1]) < 4.0 * np.hypot(*error)


@pytest.mark.slow
def test_lights_close_behind_others_stay_hidden() -> None:
    # A lamp fifty times as bright a thousandth above another: it was seen through it, and the sum 15 times as large.
    found = []
    for gap in (0.01, 0.001, 0.0003):
        lights = {"front": panel((0.0, 0.0, 2.0), 0.5, 1.0), "back": panel((0.0, 0.0, 2.0 + gap), 0.45, 50.0)}
        scene, params = scene_of(floor=floor(), occluder=occluder(), **lights)
        method = psdr.boundary.PathSpace(spp_secondary=256)
        options = {"integrator": psdr.PathIntegrator(max_depth=2, boundary=method), "spp": 16, "seed": 1}
        image = psdr.render_forward(scene, params, {OCCLUDER: 1.0}, **options).numpy()
        options["integrator"] = psdr.PathIntegrator(max_depth=2, boundary=None)
        found.append(image - psdr.render_forward(scene, params, {OCCLUDER: 1.0}, **options).numpy())
    for other in found[1:]:
        assert np.abs(found[0]).max() > 0.0
        np.testing.assert_allclose(other, found[0], atol=0.05 * np.abs(found[0]).max())


def test_results_do_not_depend_on_the_number_of_workers() -> None:
    scene, params = load("soft")
    options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 8, "seed": 5}
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
    other = psdr.render_forward(scene, params, {OCCLUDER: 1.0}, **{**options, "seed": 6}).numpy()
    assert np.abs(other - results[0][0]).max() > 0.0


def test_progress_is_that_of_interior_and_boundary() -> None:
    scene, params = load("soft")
    adjoint = np.ones(psdr.render(scene, integrator="direct", spp=1).numpy().shape, np.float32)
    options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 2}
    seen: list[float] = []
    gradients(scene, params, [OCCLUDER], adjoint, progress=seen.append, **options)
    # Half of the samples, those of shadow edges, are as many as the interior term's; edges in sight come on top.
    assert seen == sorted(seen) and seen[-1] == pytest.approx(1.0)
    assert 3 <= sum(fraction <= 0.5 for fraction in seen) < len(seen) - 3
    seen.clear()
    psdr.render_forward(scene, params, {OCCLUDER: 1.0}, progress=seen.append, **options)
    assert seen == sorted(seen) and seen[-1] == pytest.approx(1.0) and seen[0] < 0.5


def test_sample_counts_of_its_own() -> None:
    scene, params = load("soft")

    def noise(**counts):
        integrator = psdr.PathIntegrator(max_depth=2, boundary=psdr.boundary.PathSpace(**counts))
        images = [
            psdr.render_forward(scene, params, {OCCLUDER: 1.0}, integrator=integrator, spp=64, seed=s).numpy()
            for s in range(4)
        ]
        return float(np.std(images, axis=0).mean())

    # Sixteen times the samples: a quarter of the noise of the boundary term, beside which the interior's is small.
    assert noise(spp_primary=64, spp_secondary=64) < 0.5 * noise(spp_primary=4, spp_secondary=4)


@pytest.mark.parametrize("value", [0, -3, 1.5, True])
def test_wrong_sample_counts_are_refused(value) -> None:
    for name in ("spp_primary", "spp_secondary"):
        with pytest.raises(ValueError, match=name):
            psdr.boundary.PathSpace(**{name: value})


def test_the_plan_says_which_method_it_chose() -> None:
    scene, params = load("soft")
    params.requires_grad_only(OCCLUDER)
    plan = psdr.plan(scene, params, integrator=psdr.PathIntegrator(max_depth=2))
    assert plan.boundary == psdr.boundary.PathSpace()
    line = next(line for line in plan.lines if line[0] == "boundary term")
    assert line[1] == "boundary.PathSpace" and OCCLUDER in line[2]
    params.requires_grad_only("floor.bsdf.reflectance.value")
    assert psdr.plan(scene, params, integrator=psdr.PathIntegrator()).boundary is None


UNCOVERED = {
    "cone": (
        under({"type": "spot", "to_world": T.translate([0, 0, 3]), "cutoff_angle": 20.0, "beam_width": 20.0}),
        2,
        "hard edge",
    ),
}


@pytest.mark.parametrize("case", UNCOVERED)
def test_what_is_not_covered_is_refused_with_a_remedy(case) -> None:
    objects, depth, message = UNCOVERED[case]
    scene, params = scene_of(**{k: v for k, v in objects.items() if k != "sensor"})
    integrator = psdr.PathIntegrator(max_depth=depth)
    with pytest.raises(ValueError, match=message) as error:
        psdr.render_forward(scene, params, {OCCLUDER: 1.0}, integrator=integrator, spp=1)
    assert "boundary=None" in str(error.value)
    params.requires_grad_only(OCCLUDER)
    with pytest.raises(ValueError, match=message):
        psdr.render_backward(scene, params, np.ones((16, 16, 3)), integrator=integrator, spp=1)


@pytest.mark.slow
def test_emission_alone_has_a_primary_boundary() -> None:
    light = panel((0.0, 0.0, 0.5), 0.4, 2.0)
    light["faces"] = light["faces"][:, ::-1]  # it faces up, towards the camera
    scene, params = scene_of(light=light, veil=mesh([[9, 9, 9], [9, 10, 9], [10, 9, 9]], [[0, 1, 2]], diffuse(0.5)))
    integrator = psdr.PathIntegrator(max_depth=1)
    size = psdr.render_forward(
        scene, params, {"light.vertex_positions": params["light.vertex_positions"].numpy() - [0, 0, 0.5]},
        integrator=integrator, spp=256,
    ).numpy().sum()  # fmt: skip
    # A flat light of constant radiance seen by a pinhole: its image grows as the square of its size. Absorbs the
    # perspective of a tilted square and the samples' noise.
    primal = psdr.render(scene, integrator=integrator, spp=256).numpy().sum()
    assert size == pytest.approx(2.0 * primal, rel=0.02)

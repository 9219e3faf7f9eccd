"""Sensors side by side on one film: the bits of each alone, Mitsuba's layout, names, gradients, what cannot be."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.path.helpers import assert_same_mean, batches, blocks
from tests.peer import MITSUBA_ROUNDING, for_mitsuba
from warp_psdr.scene import describe_dict

T = psdr.Transform
WIDTH, HEIGHT = 24, 16
ONE = psdr.PathIntegrator(max_depth=2, boundary=None)


def film(width, rfilter="tent"):
    return {"type": "hdrfilm", "width": width, "height": HEIGHT, "rfilter": {"type": rfilter}}


def cameras():
    seen = T.look_at((0, -4, 2), (0, 0, 0), (0, 0, 1))
    wide = {"type": "perspective", "fov": 60.0, "fov_axis": "y", "to_world": seen, "film": film(12)}
    long = {"type": "perspective", "fov": 30.0, "to_world": T.look_at((3, -2, 2), (0, 0, 0), (0, 0, 1))}
    return {"wide": wide, "long": {**long, "film": film(12)}}


def parts(sensors):
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        **sensors,
        "cube": {"type": "cube", "to_world": T.scale(0.7), "bsdf": {"type": "diffuse", "reflectance": 0.6}},
        "lamp": {"type": "point", "position": [2.0, -3.0, 4.0], "intensity": 30.0},
    }


def batch(rfilter="tent"):
    sampler = {"type": "independent", "sample_count": 8}
    return {"type": "batch", "film": film(WIDTH, rfilter), "sampler": sampler, **cameras()}


@pytest.fixture(scope="module")
def together():
    return psdr.load_dict(parts({"rig": batch()}))


@pytest.fixture(scope="module")
def alone():
    sampler = {"type": "independent", "sample_count": 8}
    return psdr.load_dict(parts({name: {**camera, "sampler": sampler} for name, camera in cameras().items()}))


def test_images_and_derivatives_have_the_bits_of_each_sensor_alone(together, alone):
    image = psdr.render(together, integrator=ONE, seed=3).numpy()
    each = [psdr.render(alone, sensor=name, integrator=ONE, seed=3).numpy() for name in ("wide", "long")]
    assert image.shape == (HEIGHT, WIDTH, 3) and image.any()
    np.testing.assert_array_equal(image, np.concatenate(each, axis=1))
    np.testing.assert_array_equal(psdr.render(together, sensor="rig.long", integrator=ONE, seed=3).numpy(), each[1])

    adjoint = np.random.default_rng(0).random(image.shape).astype(np.float32)
    gradients = []
    for scene, calls in (
        (together, [("rig", slice(0, 24))]),
        (alone, [("wide", slice(0, 12)), ("long", slice(12, 24))]),
    ):
        params = psdr.traverse(scene)
        params.requires_grad_only("cube.bsdf.reflectance.value", "*.to_world", "lamp.position")
        params.zero_grad()
        for sensor, columns in calls:
            part = np.ascontiguousarray(adjoint[:, columns])
            psdr.render_backward(scene, params, part, sensor=sensor, integrator=ONE, seed=3)
        gradients.append({n.removeprefix("rig."): params[n].grad.numpy().copy() for n in params.requested})
    assert gradients[0].keys() == gradients[1].keys() and {"wide.to_world", "long.to_world"} <= gradients[0].keys()
    for name, gradient in gradients[0].items():
        assert gradient.any(), name
        np.testing.assert_array_equal(gradient, gradients[1][name], err_msg=name)


@pytest.mark.slow
def test_forward_mode_too(together, alone):
    tangents = {"cube.bsdf.reflectance.value": 1.0}
    forward = psdr.render_forward(together, psdr.traverse(together), tangents, integrator=ONE, seed=3).numpy()
    other = psdr.render_forward(alone, psdr.traverse(alone), tangents, sensor="long", integrator=ONE, seed=3).numpy()
    np.testing.assert_array_equal(forward[:, 12:], other)


@pytest.mark.slow
def test_a_tape_records_the_whole_film(together):
    params = psdr.traverse(together)
    params.requires_grad_only("cube.bsdf.reflectance.value")
    params.zero_grad()
    adjoint = np.ones((HEIGHT, WIDTH, 3), np.float32)
    psdr.render_backward(together, params, adjoint, integrator=ONE, seed=5)
    expected = params["cube.bsdf.reflectance.value"].grad.numpy().copy()
    params.zero_grad()
    with wp.Tape() as tape:
        image = psdr.render(together, params, integrator=ONE, seed=5)
    tape.backward(grads={image: wp.array(adjoint, dtype=wp.vec3)})
    np.testing.assert_array_equal(params["cube.bsdf.reflectance.value"].grad.numpy(), expected)
    assert expected.any()


@pytest.mark.slow
def test_properties_of_surfaces_stand_side_by_side_too(together):
    depth = psdr.render_aov(together, ["depth"], spp=4)["depth"].numpy()
    assert depth.shape == (HEIGHT, WIDTH) and depth[:, :12].any() and depth[:, 12:].any()


@pytest.mark.slow
def test_equals_mitsuba():
    """With a box filter: under wider ones Mitsuba's sensors splat into each other at the seams."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    scene = parts({"rig": batch("box")})
    theirs = mi.load_dict(for_mitsuba(mi, scene))
    theirs = np.stack([np.array(mi.render(theirs, spp=64, seed=i)) for i in range(16)]).astype(np.float64)
    ours = batches(psdr.load_dict(scene), spp=64)
    assert_same_mean(blocks(ours, 2), blocks(theirs, 2), "batch", MITSUBA_ROUNDING)


def test_names_are_those_of_mitsuba(together):
    names = [name for name in psdr.traverse(together) if name.startswith("rig")]
    assert {"rig.wide.to_world", "rig.wide.x_fov", "rig.long.to_world", "rig.long.x_fov"} <= set(names)
    text = """<scene version="3.0.0"><sensor type="batch" id="rig">
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="4"/></film>
    <sensor type="perspective" id="a"/><sensor type="perspective" id="b"/></sensor><shape type="cube"/>
    <emitter type="constant"/></scene>"""
    assert [s.path for s in psdr.load_string(text).description.sensors] == ["rig", "rig.a", "rig.b"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"wide": None, "long": None}, "without sensors.*nest one"),
        ({"film": {"type": "hdrfilm", "width": 25, "height": 4}}, r"25 pixels wide for 2 sensors.*2 divides"),
        ({"film": {**film(24), "crop_width": 12}}, "crop window.*leave the crop out"),
        ({"long": {"type": "radiancemeter"}}, "'radiancemeter' in a 'batch'.*perspective"),
        ({"long": {"type": "ref", "id": "other"}}, "a reference in a 'batch'.*nest the sensor itself"),
    ],
)
def test_what_cannot_be_is_named(changes, words):
    rig = {name: value for name, value in {**batch(), **changes}.items() if value is not None}
    with pytest.raises(ValueError, match=words):
        describe_dict(parts({"other": cameras()["long"], "rig": rig}))


@pytest.fixture(scope="module")
def stacked():
    """The cameras of the batch under a box filter, and one of another size."""
    sampler = {"type": "independent", "sample_count": 8}
    box = {name: {**camera, "film": film(12, "box"), "sampler": sampler} for name, camera in cameras().items()}
    return psdr.load_dict(parts({**box, "small": {**box["wide"], "film": film(8, "box")}}))


def test_a_list_of_sensors_is_a_stack_and_the_sum_of_gradients(stacked):
    each = [psdr.render(stacked, sensor=name, integrator=ONE, seed=3).numpy() for name in ("long", "wide")]
    image = psdr.render(stacked, sensor=["long", 0], integrator=ONE, seed=3)
    assert image.shape == (2, HEIGHT, 12) and image._repr_png_()[:4] == b"\x89PNG"
    np.testing.assert_array_equal(image.numpy(), np.stack(each))
    params = psdr.traverse(stacked)
    params.requires_grad_only("cube.bsdf.reflectance.value")
    adjoint = np.random.default_rng(0).random((2, HEIGHT, 12, 3)).astype(np.float32)
    gradients = []
    for calls in ([(["long", "wide"], adjoint)], [("long", adjoint[0]), ("wide", adjoint[1])]):
        params.zero_grad()
        for sensor, part in calls:
            psdr.render_backward(stacked, params, part, sensor=sensor, integrator=ONE, seed=3)
        gradients.append(params["cube.bsdf.reflectance.value"].grad.numpy().copy())
    assert gradients[0].any()
    np.testing.assert_array_equal(*gradients)


def test_budgets_and_reports_of_several_sensors_are_of_the_whole(stacked):
    """The gradient within an error, its report, the plan of each, second moments, an image within a time."""
    several = {"sensor": ["wide", "long"], "integrator": ONE}
    params = psdr.traverse(stacked)
    name = "cube.bsdf.reflectance.value"
    params.requires_grad_only(name)
    adjoint = np.ones((2, HEIGHT, 12, 3), np.float32)
    params.zero_grad()
    psdr.render_backward(stacked, params, adjoint, spp=256, **several)
    expected = params[name].grad.numpy().copy()
    report = psdr.accuracy(stacked, params, adjoint, spp=4, seconds=0.05, **several)
    pixels = 2 * HEIGHT * 12
    assert [(term.name, term.samples) for term in report.terms] == [("interior", 4 * pixels)]
    assert abs(np.sqrt(report.norm2[name]) - np.abs(expected).sum()) < 0.1 * np.abs(expected).sum()
    params.zero_grad()
    reached = psdr.render_backward(stacked, params, adjoint, target_error=0.02, report=report, seed=1, **several)
    assert reached.error <= 0.03
    np.testing.assert_allclose(params[name].grad.numpy(), expected, rtol=0.1)  # five times the error, and more
    image = psdr.render(stacked, spp=256, **several).numpy()
    within = psdr.render(stacked, target_error=0.01, seed=1, **several).numpy()
    assert np.linalg.norm(within - image) < 0.05 * np.linalg.norm(image)
    derivative = psdr.render_forward(stacked, params, {name: 1.0}, target_error=0.02, **several).numpy()
    assert abs(derivative.sum() - expected.sum()) < 0.1 * abs(expected.sum())
    first, squares = psdr.render_moment(stacked, spp=4, **several)
    assert first.shape == squares.shape == (2, HEIGHT, 12) and (squares.numpy() >= first.numpy() ** 2 - 1e-4).all()
    plans = psdr.plan(stacked, params, **several)
    assert list(plans) == ["wide", "long"] and "interior" in str(plans) and "wide, long" in plans._repr_html_()
    assert psdr.compile(stacked, params, **several).compiled == ()


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        ([], "empty list"),
        (["wide", 0], "names a sensor twice"),
        (["wide", "small"], "one size.*'wide' 12 x 16, 'small' 8 x 16"),
        (["wide", "none"], "sensor 'none': the scene has sensors 0 to 2"),
    ],
)
def test_a_list_that_is_no_stack_is_named(stacked, sensor, words):
    with pytest.raises(ValueError, match=words):
        psdr.render(stacked, sensor=sensor, integrator=ONE, spp=1)


def test_who_takes_one_sensor_names_those_of_the_batch(together):
    calls = (
        lambda: psdr.trace_sample(together, pixel=(0, 0), sample=0),
        lambda: psdr.render(together, sensor=["rig"]),
        lambda: psdr.render_parts(together, psdr.traverse(together), {"lamp.position": 1.0}),
    )
    for call in calls:
        with pytest.raises(ValueError, match=r"'rig' is a 'batch'.*give its sensors.*'rig.wide', 'rig.long'"):
            call()

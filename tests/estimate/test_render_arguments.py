"""Arguments of the drivers: what is out of range is named, in every entry point alike."""

import copy
import pickle

import numpy as np
import pytest

import warp_psdr as psdr

NAME, SKY = "card.bsdf.reflectance.value", "sky.radiance.value"
IMAGE = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 2}
ENTRY_POINTS = ["render", "render_backward", "render_forward"]


@pytest.fixture(scope="module")
def scene():
    camera = {
        "type": "perspective",
        "to_world": psdr.Transform.look_at((0, 0, 4), (0, 0, 0)),
        "film": {"type": "hdrfilm", "width": 4, "height": 3, "rfilter": {"type": "box"}},
        "sampler": {"type": "sobol", "sample_count": 2},
    }
    card = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.5, 0.5]}}}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    return psdr.load_dict({"type": "scene", "camera": camera, "card": card, "sky": sky})


def call(entry_point: str, scene, integrator=None, **options) -> np.ndarray:
    """Return the image, or the gradient, of the card's reflectance."""
    params = psdr.traverse(scene)
    params.requires_grad(NAME, SKY)  # as PyTorch's tests do
    integrator = integrator or psdr.PathIntegrator(max_depth=2)
    if entry_point == "render":
        return psdr.render(scene, params, integrator=integrator, **options).numpy()
    if entry_point == "render_forward":
        return psdr.render_forward(scene, params, {NAME: 1.0, SKY: 0.0}, integrator=integrator, **options).numpy()
    psdr.render_backward(scene, params, np.ones((3, 4, 3)), integrator=integrator, **options)
    return params[NAME].grad.numpy()


@pytest.mark.parametrize("entry_point", ENTRY_POINTS)
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sensor": 1}, r"sensor 1: the scene has sensors 0 to 0"),
        ({"sensor": -2}, r"sensor -2: the scene has"),
        ({"sensor": "lens"}, r"sensor 'lens': the scene has .* with the ids 'camera'"),
        ({"sensor": 0.0}, r"sensor 0\.0"),
        ({"sensor": True}, r"sensor True"),
        ({"spp": 0}, r"spp: got 0, expected a positive integer"),
        ({"spp": -4}, r"spp: got -4"),
        ({"spp": 1.5}, r"spp: got 1\.5"),
        ({"spp": True}, r"spp: got True"),
        ({"seed": -1}, r"seed: got -1, expected a non-negative integer"),
        ({"seed": 0.5}, r"seed: got 0\.5"),
        ({"seed": None}, r"seed: got None"),
        ({"seed": True}, r"seed: got True"),
    ],
)
def test_what_is_out_of_range_is_named(scene, entry_point: str, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(entry_point, scene, **options)


def test_spp_of_the_gradient_is_checked_before_anything_is_rendered(scene) -> None:
    finished: list[float] = []
    with pytest.raises(ValueError, match="spp_grad: got 0"):
        call("render", scene, spp_grad=0, progress=finished.append)
    assert finished == []


def test_plan_names_a_sensor_that_is_not_there(scene) -> None:
    with pytest.raises(ValueError, match="sensor 3: the scene has sensors 0 to 0"):
        psdr.plan(scene, sensor=3)


@pytest.mark.parametrize("entry_point", ENTRY_POINTS)
def test_numpy_integers_and_negative_sensors_count_as_in_python(scene, entry_point: str) -> None:
    plain = call(entry_point, scene, sensor=0, spp=2, seed=7)
    same = call(entry_point, scene, sensor=np.int64(-1), spp=np.int32(2), seed=np.uint32(7))
    assert np.any(plain != 0.0)
    np.testing.assert_array_equal(plain, same)


def test_derivatives_add_up_to_the_gradient(scene) -> None:
    """Of all of the image, in equal random numbers: the modes are each other's transposes."""
    derivative, gradient = (
        call(entry_point, scene, spp=16, seed=7) for entry_point in ("render_forward", "render_backward")
    )
    assert derivative.sum() > 1.0
    np.testing.assert_allclose(gradient.sum(), derivative.sum(), rtol=1e-5)


@pytest.mark.parametrize("entry_point", ENTRY_POINTS)
def test_samples_default_to_the_sensors(scene, entry_point: str) -> None:
    np.testing.assert_array_equal(call(entry_point, scene), call(entry_point, scene, spp=2))


def test_wide_seeds_are_used_whole(scene) -> None:
    assert not np.array_equal(call("render", scene, seed=1), call("render", scene, seed=1 + (1 << 40)))


@pytest.mark.slow_rows("render_forward", "render_backward")
@pytest.mark.parametrize("entry_point", ENTRY_POINTS)
def test_sensors_have_ids_and_integrators_mitsubas_form(scene, entry_point: str) -> None:
    expected = call(entry_point, scene, seed=3)
    direct = {"type": "path", "max_depth": 2}
    np.testing.assert_array_equal(call(entry_point, scene, direct, sensor="camera", seed=3), expected)
    np.testing.assert_array_equal(call(entry_point, scene, "direct", seed=3), expected)
    assert not np.array_equal(call(entry_point, scene, {**direct, "max_depth": 1}, seed=3), expected)


@pytest.mark.parametrize("entry_point", ENTRY_POINTS)
@pytest.mark.parametrize(
    ("integrator", "kind", "message"),
    [
        (3, TypeError, r"integrator: got 3, expected a psdr\.PathIntegrator or AovIntegrator, a dictionary"),
        ("path_tracer", ValueError, "'path_tracer'"),
        ("diffuse", ValueError, "'diffuse' is a bsdf"),
        ({"type": "path", "max_depth": -3}, ValueError, "max_depth"),
        ({"max_depth": 3}, ValueError, "type"),
    ],
)
def test_what_is_no_integrator_is_refused(scene, entry_point: str, integrator, kind, message: str) -> None:
    with pytest.raises(kind, match=message):
        call(entry_point, scene, integrator=integrator)


def test_what_an_integrators_dictionary_ignores_is_said(scene) -> None:
    with pytest.warns(psdr.SceneWarning, match="'samples_per_pass' is ignored"):
        psdr.plan(scene, integrator={"type": "path", "samples_per_pass": 4})


def test_what_is_no_name_is_refused(scene) -> None:
    with pytest.raises(TypeError, match=r"requires_grad: got \['a'\], expected names"):
        psdr.traverse(scene).requires_grad(["a"])
    with pytest.raises(TypeError, match="expected a list of names"):
        psdr.plan(scene, names=NAME)


def test_numbers_of_numpy_are_depths() -> None:
    assert psdr.PathIntegrator(max_depth=np.int64(3)) == psdr.PathIntegrator(max_depth=3)
    with pytest.raises(ValueError, match="hide_emitters: got 'no'"):
        psdr.PathIntegrator(hide_emitters="no")


def test_what_methods_have_in_common_is_none() -> None:
    with pytest.raises(TypeError, match=r"boundary\.Method is what methods have in common"):
        psdr.boundary.Method()


def test_copies_and_pickles_render_alike(scene) -> None:
    """With the values, poses and requests of the original; an image, too."""
    params = psdr.traverse(scene)
    params.requires_grad_only(NAME)
    before = params["card.to_world"].numpy().copy()
    params["card.to_world"] = psdr.Transform.translate((0.25, 0.0, 0.0)).matrix @ before
    image = psdr.render(scene, **IMAGE)
    again, named, picture = pickle.loads(pickle.dumps((scene, params, image)))
    assert named.scene is again and named.requested == [NAME]
    np.testing.assert_array_equal(picture.numpy(), image.numpy())
    for other in (again, copy.deepcopy(scene)):
        np.testing.assert_array_equal(psdr.render(other, **IMAGE).numpy(), image.numpy())
        moved = psdr.traverse(other)
        np.testing.assert_array_equal(moved["card.to_world"].numpy(), params["card.to_world"].numpy())
        moved["card.to_world"] = before
    # Copies are scenes of their own.
    np.testing.assert_array_equal(psdr.render(scene, **IMAGE).numpy(), image.numpy())
    params["card.to_world"] = before
    expected = psdr.render(scene, **IMAGE).numpy()
    assert not np.array_equal(expected, image.numpy())
    np.testing.assert_array_equal(psdr.render(other, **IMAGE).numpy(), expected)


@pytest.mark.parametrize("how", ["assigned", "in place"])
def test_edits_act_without_update(scene, how: str) -> None:
    """Places as colours do."""
    params = psdr.traverse(scene)
    values = params["card.vertex_positions"].numpy() + np.float32([0.5, 0.0, 0.0])
    if how == "assigned":
        params["card.vertex_positions"] = values
    else:
        params["card.vertex_positions"].assign(values)
    found = psdr.render(scene, **IMAGE).numpy()
    params.update()
    np.testing.assert_array_equal(psdr.render(scene, **IMAGE).numpy(), found)
    params["card.vertex_positions"] = values - np.float32([0.5, 0.0, 0.0])
    assert not np.array_equal(psdr.render(scene, **IMAGE).numpy(), found)


def test_what_is_no_parameters_is_named(scene) -> None:
    with pytest.raises(TypeError, match=r"params: got int, expected what psdr\.traverse\(scene\) returns"):
        psdr.render(scene, 16)


@pytest.mark.parametrize("ratio", [-1.0, np.nan, np.inf])
def test_strips_at_contacts_have_a_width(scene, ratio: float) -> None:
    with pytest.raises(ValueError, match="contact_ratio: got"):
        scene.contact_ratio = ratio


@pytest.mark.parametrize(
    ("got", "message"),
    [
        (psdr.cornell_box(), r"scene: got dict, expected what psdr\.load_dict\(\.\.\.\) returns"),
        ("box.xml", r"scene: got str, expected what psdr\.load_file"),
        (None, r"scene: got NoneType"),
    ],
)
@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        (psdr.traverse, ()),
        (psdr.plan, ()),
        (psdr.compile, ()),
        (psdr.accuracy, ()),
        (psdr.render, ()),
        (psdr.render_aov, ()),
        (psdr.render_moment, ()),
        (psdr.render_parts, (None, {})),
        (psdr.render_forward, (None, {})),
        (psdr.render_backward, (None, None)),
    ],
)
def test_what_is_no_scene_is_refused(function, arguments: tuple, got, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        function(got, *arguments)

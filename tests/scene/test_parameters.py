"""Parameters: names, reading and writing, what an edit refreshes, and what is differentiated."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.gradients import measure, scenes
from warp_psdr.scene.acceleration import Accelerator
from warp_psdr.scene.lights.selection import Lights

SIZE = scenes.SIZE
ALBEDO, RADIANCE = "floor.bsdf.reflectance.value", "ceiling.emitter.radiance.value"
INTEGRATOR = measure.integrator(3)


def node():
    """A dome with one albedo and computed normals under a shining rectangle."""
    scene = scenes.gap_scene({"type": "diffuse", "reflectance": scenes.rgb(0.5, 0.4, 0.3)})
    del scene["floor"]["vertex_color"]
    scene["ceiling"]["emitter"]["radiance"] = scenes.rgb(1.0, 2.0, 3.0)
    return scene


def fresh(**more):
    scene = psdr.load_dict({"type": "scene", **node(), **more})
    return scene, psdr.traverse(scene)


@pytest.fixture
def loaded():
    return fresh()


def image(scene, **options):
    return psdr.render(scene, integrator=INTEGRATOR, **{"spp": 4, "seed": 1, **options}).numpy().copy()


# -- names and values --------------------------------------------------------------------------------------------------


def test_names_shapes_and_types(loaded):
    _scene, params = loaded
    shapes = {name: (params[name].shape, params[name].dtype) for name in params}
    expected = {
        "floor.vertex_positions": ((25,), wp.vec3),
        "floor.vertex_normals": ((25,), wp.vec3),
        "floor.vertex_texcoords": ((25,), wp.vec2),
        ALBEDO: ((3,), wp.float32),
        "ceiling.vertex_positions": ((4,), wp.vec3),
        "ceiling.to_world": ((4, 4), wp.float32),
        "ceiling.bsdf.reflectance.value": ((3,), wp.float32),
        RADIANCE: ((3,), wp.float32),
        "sensor.to_world": ((4, 4), wp.float32),
        "sensor.x_fov": ((1,), wp.float32),
        "sensor.principal_point_offset_x": ((1,), wp.float32),
    }
    assert {n: shapes.get(n) for n in expected} == expected
    assert len(params) == len(list(params)) and set(params) == set(shapes)
    assert all(name in repr(params) for name in params)


@pytest.mark.parametrize(
    ("scene", "names"),
    [
        ("plane", ["floor.bsdf.reflectance.data", "floor.bsdf.reflectance.to_uv", "env.data", "env.scale"]),
        ("plane", ["point.position", "point.intensity.value", "spot.cutoff_angle", "spot.beam_width", "spot.to_world"]),
        ("plane", ["sun.irradiance.value", "sun.to_world"]),
        ("dome", ["floor.face_color", "sky.radiance.value"]),
        ("brushed", ["floor.bsdf.alpha_u.value", "floor.bsdf.alpha_v.value", "floor.bsdf.eta.value"]),
        ("mirror", ["room.vertex_radiance", "room.bsdf.k.value"]),
        ("glass", ["ball.bsdf.eta", "ball.bsdf.specular_transmittance.value"]),
    ],
)
def test_names_follow_mitsuba(scene, names):
    _scene, params = scenes.load(scene)
    assert set(names) <= set(params)


def test_values_read_back_whatever_they_were_written_from(loaded):
    _scene, params = loaded
    np.testing.assert_allclose(params[ALBEDO].numpy(), [0.5, 0.4, 0.3])
    for values in ([0.1, 0.2, 0.3], np.array([0.1, 0.2, 0.3]), wp.array([0.1, 0.2, 0.3], dtype=wp.float32)):
        params[ALBEDO] = 0.9
        np.testing.assert_allclose(params[ALBEDO].numpy(), 0.9)
        params[ALBEDO] = values
        np.testing.assert_allclose(params[ALBEDO].numpy(), [0.1, 0.2, 0.3])
    positions = params["floor.vertex_positions"].numpy() + 1.0
    params["floor.vertex_positions"] = positions.reshape(-1)  # the size counts
    np.testing.assert_array_equal(params["floor.vertex_positions"].numpy(), positions)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        (ALBEDO, [0.1, 0.2], r"got shape \(2,\), expected \(3,\)"),
        ("floor.vertex_positions", np.zeros((24, 3)), r"got shape \(24, 3\), expected \(25, 3\)"),
        ("floor.vertex_positions", np.zeros((3, 25)), r"got shape \(3, 25\), expected \(25, 3\)"),
        (ALBEDO, [0.1, np.nan, 0.3], "1 numbers are NaN or infinite"),
        (ALBEDO, np.inf, "3 numbers are NaN or infinite"),
        (ALBEDO, "red", "expected numbers of shape"),
        (ALBEDO, [[0.1], [0.2, 0.3]], "expected numbers of shape"),
        (ALBEDO, [-0.1, 0.2, 0.3], r"1 of 3 values out of range \(from -0.1 to 0.3\); give values between 0 and 1"),
        (RADIANCE, -1.0, "3 of 3 values out of range .*; give values at least 0"),
        ("sensor.x_fov", 180.0, "give values between 0.001 and 179"),
    ],
)
def test_bad_values_are_refused_and_nothing_changes(loaded, name, values, message):
    _scene, params = loaded
    before = params[name].numpy().copy()
    with pytest.raises(ValueError, match=message) as error:
        params[name] = values
    assert name in str(error.value)
    np.testing.assert_array_equal(params[name].numpy(), before)


def test_unknown_names_come_with_a_suggestion(loaded):
    _scene, params = loaded
    wrong = "floor.bsdf.reflectance.valu"
    for call in (
        lambda: params[wrong],
        lambda: params.__setitem__(wrong, 1.0),
        lambda: params.update(wrong),
        lambda: params.requires_grad(wrong),
        lambda: params.bounds(wrong),
    ):
        with pytest.raises(KeyError, match=f"did you mean '{ALBEDO}'"):
            call()
    with pytest.raises(KeyError, match="lists them all"):
        params["☃"]


def test_bounds(loaded):
    _scene, params = loaded
    assert params.bounds(ALBEDO) == (0.0, 1.0)
    assert params.bounds(RADIANCE) == (0.0, np.inf)
    assert params.bounds("floor.vertex_positions") == (-np.inf, np.inf)


# -- edits -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def counted(monkeypatch):
    """Count how often each part of a scene is recomputed."""
    counts = dict.fromkeys(("rays", "areas", "environment", "selection"), 0)
    for owner, method, key in (
        (Accelerator, "update", "rays"),
        (Lights, "update_areas", "areas"),
        (Lights, "update_environment", "environment"),
        (Lights, "update_selection", "selection"),
    ):
        original = getattr(owner, method)

        def wrapped(self, *args, original=original, key=key):
            counts[key] += 1
            return original(self, *args)

        monkeypatch.setattr(owner, method, wrapped)
    return counts


@pytest.mark.parametrize(
    ("name", "refreshed"),
    [
        (ALBEDO, set()),
        ("sensor.to_world", set()),
        ("floor.vertex_texcoords", set()),
        (RADIANCE, {"selection"}),
        ("env.data", {"environment", "selection"}),
        ("floor.vertex_positions", {"rays", "selection"}),  # the environment's power depends on the scene's size
        ("ceiling.to_world", {"rays", "areas", "selection"}),
        ("ceiling.vertex_positions", {"rays", "areas", "selection"}),
    ],
)
def test_update_refreshes_what_changed_and_nothing_else(counted, name, refreshed):
    _scene, params = fresh(env=scenes.environment())
    for key in counted:
        counted[key] = 0
    params[name] = params[name].numpy()
    assert not any(counted.values())
    params.update()
    assert {key for key, count in counted.items() if count} == refreshed
    assert max(counted.values(), default=0) <= 1
    params.update()  # nothing is left to do
    assert {key for key, count in counted.items() if count} == refreshed
    assert max(counted.values(), default=0) <= 1


@pytest.mark.parametrize(
    ("name", "values"),
    [
        (ALBEDO, [0.1, 0.9, 0.2]),
        (RADIANCE, [3.0, 1.0, 0.5]),
        ("floor.vertex_positions", None),
        ("ceiling.to_world", None),
        ("sensor.x_fov", 30.0),
    ],
)
def test_an_edited_scene_equals_one_that_was_loaded_so(loaded, name, values):
    scene, params = loaded
    edited = node()
    if name == ALBEDO:
        edited["floor"]["bsdf"]["reflectance"] = scenes.rgb(*values)
    elif name == RADIANCE:
        edited["ceiling"]["emitter"]["radiance"] = scenes.rgb(*values)
    elif name == "floor.vertex_positions":
        x = edited["floor"]["vertices"]
        values = x + np.stack([0.0 * x[:, 0], 0.0 * x[:, 0], 0.1 * np.sin(x[:, 0])], axis=1).astype(np.float32)
        edited["floor"]["vertices"] = values
    elif name == "ceiling.to_world":
        moved = psdr.Transform.translate([0.1, 0.2, 0.3]) @ edited["ceiling"]["to_world"]
        values, edited["ceiling"]["to_world"] = moved.matrix, moved
    else:
        edited["sensor"]["fov"] = values
    before = image(scene)
    params[name] = values
    params.update()
    after = image(scene)
    expected = image(psdr.load_dict({"type": "scene", **edited}))
    assert np.abs(after - before).max() > 1e-2
    # Normals, matrices and power are computed in float64 on loading and in float32 afterwards.
    np.testing.assert_allclose(after, expected, rtol=0.0, atol=2e-4 * expected.max())


def test_computed_normals_follow_positions_and_given_ones_stay(loaded):
    _scene, params = loaded
    before = params["floor.vertex_normals"].numpy().copy()
    x = params["floor.vertex_positions"].numpy().copy()
    params["floor.vertex_positions"] = x @ psdr.Transform.rotate([0, 1, 0], 20).matrix[:3, :3].T
    params.update()
    turned = before @ psdr.Transform.rotate([0, 1, 0], 20).matrix[:3, :3].T
    np.testing.assert_allclose(params["floor.vertex_normals"].numpy(), turned, atol=1e-5)
    given = {**node()["floor"], "normals": before}
    _scene, params = fresh(floor=given)
    params["floor.vertex_positions"] = x @ psdr.Transform.rotate([0, 1, 0], 20).matrix[:3, :3].T
    params.update()
    np.testing.assert_allclose(params["floor.vertex_normals"].numpy(), before, atol=1e-6)
    # Normals that are written together with the positions are taken.
    _scene, params = fresh()
    params["floor.vertex_positions"], params["floor.vertex_normals"] = x, turned
    params.update()
    np.testing.assert_array_equal(params["floor.vertex_normals"].numpy(), turned.astype(np.float32))


def test_poses_move_vertices_and_normals(loaded):
    _scene, params = loaded
    turn = psdr.Transform.rotate([0, 1, 0], 30).matrix
    corners, pose = params["ceiling.vertex_positions"].numpy().copy(), params["ceiling.to_world"].numpy().copy()
    params["ceiling.to_world"] = turn @ pose
    params.update()
    np.testing.assert_allclose(params["ceiling.vertex_positions"].numpy(), corners @ turn[:3, :3].T, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("together", [True, False])
def test_poses_move_what_was_edited(loaded, together):
    """Whether vertices are edited before a pose, or with it: then they are kept, and move from there."""
    scene, params = loaded
    first, turn = psdr.Transform.scale([1.0, 2.0, 3.0]).matrix, psdr.Transform.rotate([0, 1, 0], 30).matrix
    pose = params["ceiling.to_world"].numpy().copy()
    edited = params["ceiling.vertex_positions"].numpy() + np.float32([[0.1, 0.2, 0.3], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    params["ceiling.vertex_positions"] = edited
    if together:
        pose = first @ pose
        params["ceiling.to_world"] = pose
    params.update()
    np.testing.assert_array_equal(params["ceiling.vertex_positions"].numpy(), edited)
    np.testing.assert_allclose(params["ceiling.to_world"].numpy(), pose, atol=1e-6)
    # The pose's gradient is that of the vertices, carried by where they are now.
    params.requires_grad("ceiling.vertex_positions", "ceiling.to_world")
    adjoint = np.random.default_rng(2).normal(size=image(scene).shape)
    psdr.render_backward(scene, params, adjoint, integrator=psdr.PathIntegrator(max_depth=2), spp=64)
    local = np.linalg.solve(pose[:3, :3], (edited - pose[:3, 3]).T)
    found = params["ceiling.to_world"].grad.numpy()[:3]
    expected = params["ceiling.vertex_positions"].grad.numpy().T @ np.vstack([local, np.ones(local.shape[1])]).T
    assert np.abs(expected).max() > 0.0
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
    params["ceiling.to_world"] = turn @ pose
    params.update()
    np.testing.assert_allclose(params["ceiling.vertex_positions"].numpy(), edited @ turn[:3, :3].T, atol=1e-6)


def test_poses_keep_normals_that_are_edited_with_them():
    ball = {"type": "sphere", "radius": 0.5, "bsdf": {"type": "diffuse"}}
    _scene, params = fresh(ball=ball)
    turn = psdr.Transform.rotate([0, 1, 0], 30).matrix
    normals = np.roll(params["ball.vertex_normals"].numpy(), 1, axis=0)
    params["ball.to_world"], params["ball.vertex_normals"] = turn @ params["ball.to_world"].numpy(), normals
    params.update()
    np.testing.assert_array_equal(params["ball.vertex_normals"].numpy(), normals)
    params["ball.to_world"] = turn @ params["ball.to_world"].numpy()
    params.update()
    np.testing.assert_allclose(params["ball.vertex_normals"].numpy(), normals @ turn[:3, :3].T, atol=1e-5)


def test_vertices_under_a_pose_without_inverse_are_refused(loaded):
    _scene, params = loaded
    params["ceiling.to_world"] = np.diag([1.0, 0.0, 1.0, 1.0])
    params.update()
    params["ceiling.vertex_positions"] = params["ceiling.vertex_positions"].numpy() + np.float32(0.1)
    with pytest.raises(ValueError, match=r"ceiling\.to_world has no inverse.*set a pose"):
        params.update()


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("name", ["floor.vertex_positions", "ceiling.to_world", RADIANCE])
def test_values_that_kernels_wrote_are_refreshed(loaded, name, named):
    """Also beside others that were assigned, and asked for derivatives."""
    scene, params = loaded
    params.requires_grad(ALBEDO)
    before = image(scene)
    written = params[name].numpy() * np.float32(1.5)
    params[name] = written
    params[ALBEDO] = params[ALBEDO].numpy()
    params.update()
    expected = image(scene)
    assert np.abs(expected - before).max() > 1e-2
    scene, params = fresh()
    params.requires_grad(ALBEDO)
    params[name].assign(written)
    params[ALBEDO] = params[ALBEDO].numpy()
    params.update(*([name] if named else []))
    np.testing.assert_array_equal(image(scene), expected)


@pytest.mark.parametrize("assigned", [True, False])
def test_values_that_go_back_and_forth_are_followed(loaded, counted, assigned):
    """A kernel writes A, B and A again; the scene has looked at A in between, when nothing had changed."""
    _scene, params = loaded
    values = params[RADIANCE].numpy() * np.float32([[2.0], [3.0]])
    params[RADIANCE].assign(values[0])
    for _nothing_the_second_time in range(2):
        params.update()
    if assigned:
        params[RADIANCE] = values[1]
    else:
        params[RADIANCE].assign(values[1])
    params.update()
    before = counted["selection"]
    params[RADIANCE].assign(values[0])
    params.update()
    assert counted["selection"] == before + 1


def test_what_has_been_refreshed_is_not_refreshed_again(loaded, counted):
    _scene, params = loaded
    params["ceiling.to_world"].assign(params["ceiling.to_world"].numpy() * np.float32(1.1))
    params["floor.vertex_positions"].assign(params["floor.vertex_positions"].numpy() * np.float32(1.1))
    for expected in (1, 1):
        params.update()
        assert counted["rays"] == expected


@pytest.mark.parametrize("names", [["floor.vertex_positions"], []])
def test_positions_that_are_not_finite_are_caught(loaded, names):
    _scene, params = loaded
    params["floor.vertex_positions"].fill_(np.nan)
    for _attempt in range(2):
        with pytest.raises(ValueError, match="lower its learning rate"):
            params.update(*names)


def test_a_scene_that_could_not_follow_is_not_rendered(loaded):
    scene, params = loaded
    good = params["floor.vertex_positions"].numpy().copy()
    params.update("floor.vertex_positions")  # computes normals, as the updates below do
    expected = image(scene)
    params["floor.vertex_positions"].fill_(np.nan)
    with pytest.raises(ValueError, match="lower its learning rate"):
        params.update("floor.vertex_positions")
    with pytest.raises(ValueError, match=r"could not follow 'floor\.vertex_positions'"):
        scene.data()
    with pytest.raises(ValueError, match="lower its learning rate"):
        image(scene)
    with pytest.raises(ValueError, match="lower its learning rate"):  # what failed is not forgotten
        params.update(ALBEDO)
    params["floor.vertex_positions"] = good
    params.update()
    np.testing.assert_array_equal(image(scene), expected)


# -- gradients ---------------------------------------------------------------------------------------------------------


def test_patterns_name_what_is_differentiated(loaded):
    _scene, params = loaded
    params.requires_grad("*.value")
    assert params.requested == [ALBEDO, "ceiling.bsdf.reflectance.value", RADIANCE]
    params.requires_grad_only(RADIANCE, "*.value")
    assert params.requested == [RADIANCE, ALBEDO, "ceiling.bsdf.reflectance.value"]
    assert params[ALBEDO].grad is not None
    params.requires_grad_only("sensor.x_fov")
    assert params.requested == ["sensor.x_fov"]
    assert params[ALBEDO].grad is None
    assert "x_fov" in next(line for line in repr(params).splitlines() if "gradient requested" in line)
    with pytest.raises(KeyError):
        params.requires_grad("*.colour")
    params.requires_grad_only()
    assert params.requested == []


def test_requests_add_up(loaded):
    _scene, params = loaded
    params.requires_grad(ALBEDO)
    params[ALBEDO].grad.fill_(1.0)
    params.requires_grad(RADIANCE, ALBEDO)
    assert params.requested == [ALBEDO, RADIANCE]
    assert params[ALBEDO].grad.numpy().all(), "asking for more lost a gradient"
    params.requires_grad()
    assert params.requested == [ALBEDO, RADIANCE]
    with pytest.raises(KeyError):
        params.requires_grad_only("*.colour")
    assert params.requested == [ALBEDO, RADIANCE]
    params.requires_grad_only(RADIANCE)
    assert params.requested == [RADIANCE] and params[ALBEDO].grad is None


def test_zero_grad_and_accumulation(loaded):
    scene, params = loaded
    params.requires_grad(ALBEDO)
    ones = np.ones((SIZE, SIZE, 3), np.float32)
    psdr.render_backward(scene, params, ones, integrator=INTEGRATOR, spp=2)
    once = params[ALBEDO].grad.numpy().copy()
    psdr.render_backward(scene, params, ones, integrator=INTEGRATOR, spp=2)
    np.testing.assert_allclose(params[ALBEDO].grad.numpy(), 2.0 * once, rtol=1e-6)
    assert (once > 0.0).all()
    params.zero_grad()
    np.testing.assert_array_equal(params[ALBEDO].grad.numpy(), 0.0)


@pytest.mark.parametrize(
    ("adjoint", "message"),
    [
        (np.ones((SIZE, SIZE)), "adjoint: got shape"),
        (np.ones((SIZE, SIZE + 1, 3)), "adjoint: got shape"),
        (np.full((SIZE, SIZE, 3), np.nan), "NaN or infinite"),
        (np.full((SIZE, SIZE, 3), np.inf), "NaN or infinite"),
    ],
)
def test_bad_adjoints_are_refused(loaded, adjoint, message):
    scene, params = loaded
    params.requires_grad(ALBEDO)
    with pytest.raises(ValueError, match=message):
        psdr.render_backward(scene, params, adjoint, integrator=INTEGRATOR, spp=1)
    np.testing.assert_array_equal(params[ALBEDO].grad.numpy(), 0.0)


def test_warp_adjoints_of_a_wrong_shape_are_refused(loaded):
    scene, params = loaded
    params.requires_grad(ALBEDO)
    for shape in ((SIZE, SIZE + 1), (SIZE - 1, SIZE)):
        with pytest.raises(ValueError, match="adjoint: got shape"):
            psdr.render_backward(scene, params, wp.zeros(shape, dtype=wp.vec3), integrator=INTEGRATOR, spp=1)


@pytest.mark.parametrize(
    ("tangents", "error", "message"),
    [
        ({}, ValueError, "at least one tangent"),
        ({ALBEDO: [1.0, 2.0]}, ValueError, "tangent of .* got shape"),
        ({ALBEDO: np.nan}, ValueError, "NaN or infinite"),
        ({"floor.albedo": 1.0}, KeyError, "no parameter"),
        ({ALBEDO: None}, ValueError, "tangent of"),
    ],
)
def test_bad_tangents_are_refused(loaded, tangents, error, message):
    scene, params = loaded
    with pytest.raises(error, match=message):
        psdr.render_forward(scene, params, tangents, integrator=INTEGRATOR, spp=1)


def test_parameters_of_another_scene_are_refused(loaded):
    _scene, params = loaded
    params.requires_grad(ALBEDO)
    other, _own = fresh()
    ones = np.ones((SIZE, SIZE, 3), np.float32)
    calls = [
        lambda p: psdr.render_backward(other, p, ones, integrator=INTEGRATOR, spp=1),
        lambda p: psdr.render_backward(other, p, ones, integrator=INTEGRATOR, time_budget=0.1),
        lambda p: psdr.render_forward(other, p, {ALBEDO: 1.0}, integrator=INTEGRATOR, spp=1),
        lambda p: psdr.render(other, p, integrator=INTEGRATOR, spp=1, tape=wp.Tape()),
        lambda p: psdr.plan(other, p, integrator=INTEGRATOR),
    ]
    for call in calls:
        with pytest.raises(ValueError, match="another scene"):
            call(params)
    for call in calls[:3]:
        with pytest.raises(TypeError, match=r"psdr\.traverse"):
            call(None)


def test_nothing_requested_is_an_error(loaded):
    scene, params = loaded
    with pytest.raises(ValueError, match="nothing to differentiate"):
        psdr.render_backward(scene, params, np.ones((SIZE, SIZE, 3), np.float32), spp=1)
    with pytest.raises(ValueError, match="requires_grad"):
        psdr.render(scene, params, spp=1, tape=wp.Tape())
    with pytest.raises(ValueError, match="requires_grad"):
        psdr.render(scene, spp=1, tape=wp.Tape())

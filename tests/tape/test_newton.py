"""Scenes of Newton's models: shapes, cloths and soft bodies, and gradients through its solvers."""

import itertools

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.gradients import measure
from tests.tape.test_frames import INTEGRATOR, SIZE, node, weights

newton = pytest.importorskip("newton")

STEPS, DT = 60, 1.0 / 600.0
BALLS = "particles.vertex_positions"
#: A card that faces z.
CORNERS, SIDES = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.int32([0, 1, 2, 0, 2, 3])
AT = wp.transform(wp.vec3(0.8, 0.6, 0.0), wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), 0.5))


@pytest.fixture(scope="module")
def model():
    """A cloth, a box with a capsule on it, a soft block and the ground; nothing touches."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y)
    cloth = {"tri_ke": 50.0, "tri_ka": 50.0, "tri_kd": 0.2, "tri_lift": 0.0, "tri_drag": 0.0}
    turned = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 1.3)
    still = wp.vec3(0.0, 0.0, 0.0)
    size = {"dim_x": 3, "dim_y": 3, "cell_x": 0.25, "cell_y": 0.25, "mass": 0.1}
    builder.add_cloth_grid(pos=wp.vec3(-0.4, 1.2, -0.4), vel=still, rot=turned, **size, **cloth)
    body = builder.add_body(xform=AT)
    builder.add_shape_box(body, hx=0.2, hy=0.1, hz=0.3, label="crate/side")
    above = wp.transform(wp.vec3(0.0, 0.3, 0.0), wp.quat_identity())
    builder.add_shape_capsule(body, xform=above, radius=0.08, half_height=0.2, label="handle")
    block = {"dim_x": 1, "dim_y": 1, "dim_z": 1, "cell_x": 0.2, "cell_y": 0.2, "cell_z": 0.2}
    springs = {"density": 100.0, "k_mu": 100.0, "k_lambda": 100.0, "k_damp": 0.0}
    builder.add_soft_grid(pos=wp.vec3(-1.2, 0.5, 0.0), vel=still, rot=wp.quat_identity(), **block, **springs)
    builder.add_ground_plane()
    return builder.finalize(requires_grad=True, device="cpu")


def scene_of(model, **more):
    base = node()
    return psdr.from_newton(model, sensor=base["sensor"], emitters=[base["lamp"]], **more)


def rolled_out(model, push):
    """Return the states of a simulation that begins with a push along x."""
    solver = newton.solvers.SolverSemiImplicit(model)
    states = [model.state(requires_grad=True) for _ in range(STEPS + 1)]
    control = model.control()
    wp.launch(pushed, model.particle_count, [push], [states[0].particle_qd], device="cpu")
    wp.launch(thrown, model.body_count, [push], [states[0].body_qd], device="cpu")
    for before, after in itertools.pairwise(states):
        before.clear_forces()
        solver.step(before, after, control, None, DT)
    return states


@wp.kernel
def pushed(push: wp.array(dtype=float), qd: wp.array(dtype=wp.vec3)):
    """Velocity of particles."""
    qd[wp.tid()] = wp.vec3(push[0], 0.0, 0.0)


@wp.kernel
def thrown(push: wp.array(dtype=float), qd: wp.array(dtype=wp.spatial_vector)):
    """Velocity of bodies, which also spin."""
    qd[wp.tid()] = wp.spatial_vector(push[0], 0.0, 0.0, 0.0, 2.0 * push[0], 0.0)


def test_a_model_becomes_a_scene_that_follows_its_states(model):
    red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.1, 0.1]}}
    scene = scene_of(model, bsdfs={"soft0": red})
    params = psdr.traverse(scene)
    assert {"crate_side.to_world", "handle.to_world", "ground_plane.to_world", "soft1.vertex_positions"} <= set(params)
    np.testing.assert_allclose(params["soft0.bsdf.reflectance.value"].numpy(), [0.8, 0.1, 0.1], rtol=1e-6)
    box = params["crate_side.vertex_positions"].numpy()
    corner = np.array(wp.transform_point(AT, wp.vec3(0.2, 0.1, 0.3)))
    assert np.abs(box - corner).sum(axis=1).min() < 1e-6
    soft = params["soft1.vertex_positions"].numpy()
    assert soft.shape == (8, 3) and np.isclose(np.ptp(soft, axis=0), 0.2).all()
    tape, push = wp.Tape(), wp.array([1.0], dtype=wp.float32, device="cpu", requires_grad=True)
    with tape:
        states = rolled_out(model, push)
        psdr.bind(params, states[-1])
        image = psdr.render(scene, params, integrator=measure.integrator(2), spp=4)
    moved = states[-1].particle_q.numpy()
    np.testing.assert_array_equal(params["soft0.vertex_positions"].numpy(), moved[:16])
    np.testing.assert_array_equal(params["soft1.vertex_positions"].numpy(), moved[16:])
    assert {"crate_side.to_world", "soft0.vertex_positions"} <= set(params.requested)
    assert not any(name.startswith("ground_plane") for name in params.requested)
    tape.backward(grads={image: weights()})
    assert push.grad.numpy().all()
    tape.zero()
    assert image.shape == (SIZE, SIZE)


def test_what_is_wrong_or_left_out_is_told(model):
    with pytest.raises(ValueError, match=r"nothing is named clot; expected some of \['crate_side'"):
        scene_of(model, bsdfs={"clot": {"type": "diffuse"}})
    with pytest.raises(TypeError, match=r"expected a newton\.Model"):
        psdr.from_newton(object(), sensor={})
    with pytest.raises(TypeError, match=r"a newton\.State is for a scene of"):
        psdr.bind(psdr.traverse(psdr.load_dict(node())), model.state())
    builder = newton.ModelBuilder()
    far = newton.Mesh(CORNERS, SIDES, uvs=CORNERS[:, :2], texture="https://example.org/wood.png")
    builder.add_shape_mesh(-1, mesh=far, label="crate")
    with pytest.warns(psdr.SceneWarning, match=r"the texture of crate \(https://example"):
        scene_of(builder.finalize(device="cpu"))


def test_a_mesh_keeps_its_material():
    builder = newton.ModelBuilder()
    texels = np.zeros((2, 2, 4), np.uint8)
    texels[0, :, 0] = 255  # the upper half is red
    look = {"uvs": CORNERS[:, :2], "texture": texels, "roughness": 0.3, "metallic": 0.7}
    builder.add_shape_mesh(-1, mesh=newton.Mesh(CORNERS, SIDES, **look), label="card")
    params = psdr.traverse(scene_of(builder.finalize(device="cpu")))
    for key, value in (("roughness", 0.3), ("metallic", 0.7)):
        np.testing.assert_allclose(params[f"card.bsdf.brdf_0.{key}.value"].numpy(), value, rtol=1e-6)
    held = params["card.bsdf.brdf_0.base_color.data"].numpy().reshape(2, 2, 3)
    np.testing.assert_allclose(held[0, 0], [1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(held[1, 0], 0.0, atol=1e-6)


def test_free_particles_are_balls_that_move_with_them():
    builder = newton.ModelBuilder()
    for x in (-0.5, 0.5):
        builder.add_particle(pos=wp.vec3(x, 1.0, 0.0), vel=wp.vec3(0.0, 0.0, 0.0), mass=1.0, radius=0.2)
    builder.add_ground_plane()
    model = builder.finalize(requires_grad=True, device="cpu")
    scene = scene_of(model)
    params = psdr.traverse(scene)
    state = model.state(requires_grad=True)
    state.particle_q.assign(np.float32([[-0.5, 1.0, 0.0], [0.5, 1.5, 0.0]]))
    tape = wp.Tape()
    with tape:
        psdr.bind(params, state)
        image = psdr.render(scene, params, integrator=INTEGRATOR, spp=64)
    places = params[BALLS].numpy().reshape(2, -1, 3)
    np.testing.assert_allclose(places.mean(axis=1), state.particle_q.numpy(), atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(places - state.particle_q.numpy()[:, None], axis=2), 0.2, rtol=1e-5)
    tape.backward(grads={image: wp.array(weights(0), dtype=wp.vec3, device="cpu")})
    params.bind(BALLS, None)
    params.requires_grad_only(BALLS)
    psdr.render_backward(scene, params, weights(0), integrator=INTEGRATOR, spp=64)
    vertices = params[BALLS].grad.numpy().reshape(2, -1, 3).sum(axis=1)
    assert np.abs(vertices).max(axis=1).min() > 0.1
    np.testing.assert_allclose(state.particle_q.grad.numpy(), vertices, rtol=1e-3)


@pytest.mark.slow
def test_gradients_through_a_solver_are_right(model):
    """The slope of two frames by the initial velocity, silhouettes and shadows included, against differences."""
    white = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": 0.9}}
    scene = scene_of(model, bsdfs=dict.fromkeys(("soft0", "soft1", "crate_side", "handle"), white))
    params = psdr.traverse(scene)
    integrator = psdr.PathIntegrator(max_depth=2)
    ramp = np.zeros((SIZE, SIZE, 3), np.float32)
    ramp += np.linspace(-1.0, 1.0, SIZE, dtype=np.float32)[:, None]
    ramps = wp.array(ramp, dtype=wp.vec3, device="cpu")

    def frames(value, seed):
        push, tape, images = wp.array([value], dtype=wp.float32, device="cpu", requires_grad=True), wp.Tape(), []
        with tape:
            states = rolled_out(model, push)
            for state in (states[STEPS // 2], states[-1]):
                psdr.bind(params, state)
                images.append(psdr.render(scene, params, integrator=integrator, spp=4096, seed=seed))
        return push, tape, images

    slopes, gaps, h = [], [], 0.5
    with measure.shared_random_numbers():
        for seed in range(8):
            push, tape, images = frames(3.0, seed)
            tape.backward(grads=dict.fromkeys(images, ramps))
            slopes.append(float(push.grad.numpy()[0]))
            tape.zero()  # the model's arrays have gradients, too
            ends = [sum((i.numpy() * ramp).sum() for i in frames(v, seed)[2]) for v in (3.0 + h, 3.0 - h)]
            gaps.append(slopes[-1] - (ends[0] - ends[1]) / (2.0 * h))
    error = np.std(gaps, ddof=1) / np.sqrt(len(gaps))
    assert abs(np.mean(slopes)) > 10.0 * error and abs(np.mean(gaps)) < 4.0 * error

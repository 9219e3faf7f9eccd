"""The tape: a user's kernels before and behind a rendering."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.gradients import measure
from tests.scene.test_parameters import ALBEDO, INTEGRATOR, RADIANCE, SIZE, fresh


@pytest.fixture
def loaded():
    return fresh()


@wp.kernel
def colour_model(theta: wp.array(dtype=wp.float32), albedo_out: wp.array(dtype=wp.float32)):
    """A user's model: the albedo from one number."""
    i = wp.tid()
    albedo_out[i] = 0.5 + 0.3 * wp.sin(theta[0] * (1.0 + wp.float32(i)))


@wp.kernel
def squared_error(
    image: wp.array2d(dtype=wp.vec3), target: wp.array2d(dtype=wp.vec3), loss: wp.array(dtype=wp.float32)
):
    """A user's loss."""
    i, j = wp.tid()
    d = image[i, j] - target[i, j]
    wp.atomic_add(loss, 0, wp.dot(d, d))


def test_the_tape_chains_a_users_model_and_loss(loaded):
    scene, params = loaded
    params.requires_grad(ALBEDO)
    target = wp.full((SIZE, SIZE), wp.vec3(0.3, 0.3, 0.3), dtype=wp.vec3, device="cpu")
    spp, theta_0 = 64, 0.4

    def run(theta_value, tape):
        theta = wp.array([theta_value], dtype=wp.float32, device="cpu", requires_grad=True)
        loss = wp.zeros(1, dtype=wp.float32, device="cpu", requires_grad=True)
        with tape:
            wp.launch(colour_model, dim=3, inputs=[theta], outputs=[params[ALBEDO]], device="cpu")
            params.update()
            rendered = psdr.render(scene, params, integrator=INTEGRATOR, spp=spp, seed=4, tape=tape)
            wp.launch(squared_error, dim=(SIZE, SIZE), inputs=[rendered, target], outputs=[loss], device="cpu")
        return theta, loss

    with measure.shared_random_numbers():  # so that the difference has the noise of the derivative
        tape = wp.Tape()
        theta, loss = run(theta_0, tape)
        tape.backward(loss)
        gradient = float(theta.grad.numpy()[0])
        h = 1e-2
        high, low = (float(run(theta_0 + s * h, wp.Tape())[1].numpy()[0]) for s in (1, -1))
    difference = (high - low) / (2.0 * h)
    assert abs(difference) > 0.1
    # The remainder of the difference, h^2 / 6 times a third derivative of order 10, and float32.
    assert gradient == pytest.approx(difference, rel=5e-3)
    assert np.isfinite(params[ALBEDO].grad.numpy()).all()


def test_rendering_in_a_tapes_block_records_itself(loaded):
    scene, params = loaded
    params.requires_grad(ALBEDO)
    adjoint = wp.full((SIZE, SIZE), wp.vec3(1.0, 2.0, 3.0), dtype=wp.vec3, device="cpu")
    options = {"integrator": INTEGRATOR, "spp": 4, "seed": 5}
    psdr.render_backward(scene, params, adjoint, **options)
    expected = params[ALBEDO].grad.numpy().copy()
    assert expected.all()
    params.zero_grad()
    tape = wp.Tape()
    with tape:
        rendered = psdr.render(scene, params, **options)
        target = psdr.render(scene, **options)
    assert not target.requires_grad, "nothing was requested of it"
    tape.backward(grads={rendered: adjoint})
    np.testing.assert_array_equal(params[ALBEDO].grad.numpy(), expected)
    assert not psdr.render(scene, params, **options).requires_grad, "no tape is active any more"
    with tape, pytest.raises(ValueError, match="a recorded image takes spp"):
        psdr.render(scene, params, integrator=INTEGRATOR, time_budget=0.1)


@pytest.mark.parametrize("edit", ["nothing", "values", "in place", "several"])
def test_the_tape_goes_back_to_the_values_that_were_rendered(loaded, edit):
    scene, params = loaded
    params.requires_grad(ALBEDO)
    ones = wp.full((SIZE, SIZE), wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3, device="cpu")
    options = {"integrator": INTEGRATOR, "spp": 1, "seed": 3}
    psdr.render_backward(scene, params, ones, **options)
    expected = params[ALBEDO].grad.numpy().copy()
    params.zero_grad()
    tape = wp.Tape()
    rendered = psdr.render(scene, params, tape=tape, **options)
    if edit in ("values", "several"):
        params[RADIANCE] = 5.0
        params.update()
    if edit in ("in place", "several"):
        params[ALBEDO].fill_(0.25)
    if edit == "several":
        params["floor.vertex_positions"] = params["floor.vertex_positions"].numpy() + np.float32([0.0, 0.0, 0.3])
    after = psdr.render(scene, **options).numpy()
    now = {name: params[name].numpy().copy() for name in params}
    tape.backward(grads={rendered: ones})
    np.testing.assert_array_equal(params[ALBEDO].grad.numpy(), expected)
    for name, values in now.items():
        np.testing.assert_array_equal(params[name].numpy(), values)
    np.testing.assert_array_equal(psdr.render(scene, **options).numpy(), after)


def test_a_request_that_is_taken_back_has_no_gradient(loaded):
    scene, params = loaded
    params.requires_grad(ALBEDO)
    tape = wp.Tape()
    psdr.render(scene, params, integrator=INTEGRATOR, spp=1, tape=tape)
    params.requires_grad_only(RADIANCE)
    with pytest.raises(RuntimeError, match="has no gradient any more"):
        tape.backward()


def test_the_tape_uses_its_own_sample_count_and_seed(loaded, monkeypatch):
    import sys

    scene, params = loaded
    params.requires_grad(ALBEDO)
    seen = {}
    render = sys.modules["warp_psdr.render"]
    original = render._add_gradient

    def spy(*args, **kwargs):
        seen.update(kwargs)
        return original(*args, **kwargs)

    monkeypatch.setattr(render, "_add_gradient", spy)
    tape = wp.Tape()
    with tape:
        rendered = psdr.render(scene, params, integrator=INTEGRATOR, spp=2, spp_grad=5, seed=6, tape=tape)
    assert not params[ALBEDO].grad.numpy().any() and not seen
    rendered.grad.fill_(wp.vec3(1.0, 1.0, 1.0))
    tape.backward()
    assert (seen["spp"], seen["seed"]) == (5, 6)
    assert (params[ALBEDO].grad.numpy() > 0.0).all()
    for bad in (0, -3, 2.5):
        with pytest.raises(ValueError, match="spp_grad"):
            psdr.render(scene, params, integrator=INTEGRATOR, spp=2, spp_grad=bad, tape=wp.Tape())

"""Stretches of a simulation that are recorded one after the other, against one tape over all of it."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.tape.test_frames import FLOOR, OPTIONS, PLACES, SHEET, SIZE, node

FRAMES = 7


@wp.kernel
def swing(x: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3), k: wp.array(dtype=float),
          x_out: wp.array(dtype=wp.vec3), v_out: wp.array(dtype=wp.vec3)):  # fmt: skip
    """A step of springs that pull to the floor."""
    i = wp.tid()
    after = v[i] - 0.05 * k[0] * wp.vec3(0.0, x[i][1], 0.0)
    v_out[i] = after
    x_out[i] = x[i] + 0.05 * after


def vectors(values=None):
    values = np.zeros_like(PLACES) if values is None else values
    return wp.array(values, dtype=wp.vec3, device="cpu", requires_grad=True)


class Springs:
    """A simulation of a sheet on springs, and its film."""

    def __init__(self):
        self.scene = psdr.load_dict(node())
        self.params = psdr.traverse(self.scene)
        self.params.requires_grad(FLOOR)
        self.stiffness = wp.array([3.0], dtype=wp.float32, device="cpu", requires_grad=True)
        self.black = wp.zeros((SIZE, SIZE), dtype=wp.vec3, device="cpu")

    def step(self, state, _frame):
        after = [vectors(), vectors()]
        wp.launch(swing, len(PLACES), [*state, self.stiffness], after, device="cpu")
        return after

    def show(self, state, frame):
        self.params.bind(SHEET, state[0])
        image = psdr.render(self.scene, self.params, seed=frame, **OPTIONS)
        return psdr.losses.l2(image, self.black)

    def gradients(self, start):
        return [self.stiffness.grad.numpy(), self.params[FLOOR].grad.numpy(), *(a.grad.numpy() for a in start)]


@pytest.mark.parametrize("every", [None, 1, 4, 10])
def test_stretches_have_the_bits_of_one_tape(every):
    springs, start = Springs(), [vectors(PLACES), vectors()]
    tape, state, losses = wp.Tape(), start, []
    with tape:
        for k in range(FRAMES):
            state = springs.step(state, k)
            losses.append(springs.show(state, k))
    for loss in losses:
        loss.grad.fill_(1.0)
    tape.backward()
    expected = springs.gradients(start)
    assert all(np.abs(gradient).max() > 0.0 for gradient in expected)
    again, begin = Springs(), [vectors(PLACES), vectors()]
    found = psdr.rollout(again.step, again.show, FRAMES, state=begin, every=every)
    np.testing.assert_array_equal(found.losses, [float(loss.numpy()[0]) for loss in losses])
    np.testing.assert_array_equal(found.last[0].numpy(), state[0].numpy())
    for gradient, right in zip(again.gradients(begin), expected, strict=True):
        np.testing.assert_array_equal(gradient, right)


def test_bad_rollouts_are_refused():
    springs = Springs()
    with pytest.raises(ValueError, match="expected positive numbers"):
        psdr.rollout(springs.step, springs.show, 0, state=[vectors()])
    with pytest.raises(ValueError, match="expected one float32 with a gradient"):
        psdr.rollout(springs.step, lambda state, _k: state[0], 2, state=[vectors(PLACES), vectors()])
    with wp.Tape(), pytest.raises(ValueError, match="tapes of its own"):
        psdr.rollout(springs.step, springs.show, 2, state=[vectors()])

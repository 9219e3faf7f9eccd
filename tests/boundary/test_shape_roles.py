"""Parameters of shapes without triangles in every role: tapes, PyTorch, accuracy, the plan, any number of workers."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.media.test_roles import assert_same, sum_of_squares

from . import test_side_by_side
from .scenes import load

OPTIONS = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 2, "seed": 3}
#: (a registered scene, its parameters, words of its plan)
SCENES = {
    "ball, grid and tube, lamp": (["body.grid", "shape.to_world", "hair.control_points"], ["sphere", "distance grids"]),
    "pipe, cubic and cones, lamp": (["body.grid", "shape.to_world", "hair.control_points"], ["cylinder", "cubic"]),
}
assert test_side_by_side.CASES  # it registers the scenes


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_every_role_has_one_derivative(name: str) -> None:
    names, words = SCENES[name]
    scene, params = load(name)
    said = str(psdr.plan(scene, names=names, integrator=OPTIONS["integrator"]))
    assert all(word in said for word in words)
    image = psdr.render(scene, **OPTIONS).numpy()
    found = []
    try:
        for workers in (1, 3):
            psdr.set_workers(workers)
            params.requires_grad_only(*names)
            params.zero_grad()
            psdr.render_backward(scene, params, 2.0 * image, **OPTIONS)
            found.append({n: params[n].grad.numpy().copy() for n in names})
    finally:
        psdr.set_workers(None)
    expected = found[0]
    for n in names:
        assert np.abs(expected[n]).max() > 0.0
        np.testing.assert_array_equal(found[1][n], expected[n])
    params.zero_grad()
    loss, tape = wp.zeros(1, dtype=wp.float32, requires_grad=True), wp.Tape()
    with tape:
        drawn = psdr.render(scene, params, tape=tape, **OPTIONS)
        wp.launch(sum_of_squares, dim=drawn.shape, inputs=[drawn], outputs=[loss])
    tape.backward(loss)
    np.testing.assert_array_equal(drawn.numpy(), image)
    assert_same({n: params[n].grad.numpy() for n in names}, expected)
    torch = pytest.importorskip("torch")
    tensors = {n: torch.tensor(params[n].numpy(), requires_grad=True) for n in names}
    shown = psdr.torch.render(scene, tensors, **OPTIONS)
    (shown * shown).sum().backward()
    assert_same({n: t.grad.numpy() for n, t in tensors.items()}, expected)
    params.requires_grad_only(*names)
    options = {"integrator": OPTIONS["integrator"], "seconds": 0.2, "spp": 2}
    report = psdr.accuracy(scene, params, np.ones(image.shape, np.float32), **options)
    assert len(report.terms) > 2 and all(sum(t.variance[n] for t in report.terms) > 0.0 for n in names)

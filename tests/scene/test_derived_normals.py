"""Normals that follow positions: a cube turned vertex by vertex, and a pose requested beside its positions."""

from __future__ import annotations

import numpy as np
import pytest

import warp_psdr as psdr

#: Float32 rounding of sums over some thousand samples.
ROUNDING = 2e-4


def scene():
    """A cube under a constant sky."""
    return psdr.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 30,
                "to_world": psdr.Transform().look_at([3, 4, 6], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
            },
            "box": {"type": "cube", "bsdf": {"type": "diffuse"}},
            "lamp": {"type": "point", "position": [2, 5, 3], "intensity": {"type": "rgb", "value": [9, 8, 7]}},
        }
    )


def test_turned_cube_turns_its_normals():
    s = scene()
    params = psdr.traverse(s)
    turn = psdr.Transform().rotate([0, 1, 0], 30).matrix[:3, :3]
    before = params["box.vertex_normals"].numpy().copy()
    params["box.vertex_positions"] = params["box.vertex_positions"].numpy() @ turn.T
    params.update()
    np.testing.assert_allclose(params["box.vertex_normals"].numpy(), before @ turn.T, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "names", [("box.vertex_positions",), ("box.to_world",), ("box.vertex_positions", "box.to_world")]
)
def test_reverse_agrees_with_forward(names):
    s = scene()
    params = psdr.traverse(s)
    params.requires_grad(*names)
    rng = np.random.default_rng(1)
    tangents = {n: rng.normal(size=params[n].numpy().shape).astype(np.float32) for n in names}
    adjoint = rng.normal(size=(16, 16, 3)).astype(np.float32)
    integrator = psdr.PathIntegrator(max_depth=3, boundary=None)
    psdr.render_backward(s, params, adjoint, integrator=integrator, spp=16)
    image = psdr.render_forward(s, params, tangents, integrator=integrator, spp=16).numpy()
    forward = float(np.sum(image.astype(np.float64) * adjoint))
    reverse = sum(float(np.sum(params[n].grad.numpy().astype(np.float64) * tangents[n])) for n in names)
    assert abs(forward) > 1e-3
    assert reverse == pytest.approx(forward, rel=ROUNDING, abs=ROUNDING * float(np.abs(image * adjoint).sum()))

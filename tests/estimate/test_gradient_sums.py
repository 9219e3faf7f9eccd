"""Sums of gradients: as exact for many samples as for few."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr.scene.derived_values import pull_derived

#: Of gradients that are sums of equal terms, relative: they are rounded once to float32, and so is every term.
SUMMATION = 3e-7
#: An adjoint that is no power of two, so that a float32 sum of it is rounded.
ADJOINT = 0.7
SIZE = 16


@pytest.mark.parametrize("spp", [16, 128, 1000, 4096])
@pytest.mark.parametrize("method", [psdr.interior.Replay(), psdr.interior.Textbook()], ids=["replay", "textbook"])
def test_a_radiance_seen_directly(spp, method) -> None:
    """A square that glows and fills the film: its image is its radiance, so the gradient is the sum of the adjoint."""
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "orthographic",
                "to_world": psdr.Transform.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0)),
                "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
            },
            "light": {
                "type": "rectangle",
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1, 2, 3]}},
            },
        }
    )
    params = psdr.traverse(scene)
    params.requires_grad("light.emitter.radiance.value")
    adjoint = np.full((SIZE, SIZE, 3), ADJOINT, np.float32)
    integrator = psdr.PathIntegrator(max_depth=1, interior=method)
    psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=spp)
    gradient = params["light.emitter.radiance.value"].grad.numpy().astype(np.float64)
    np.testing.assert_allclose(gradient, SIZE * SIZE * float(np.float32(ADJOINT)), rtol=SUMMATION)


def test_a_pose_of_many_vertices() -> None:
    """A translation moves every vertex alike, so its gradient is the sum of theirs."""
    ball = {"type": "sphere", "emitter": {"type": "area"}}
    scene = psdr.load_dict({"type": "scene", "camera": {"type": "perspective"}, "ball": ball})
    flat = np.zeros(scene.values.shape[0], np.float32)
    positions = scene.parameters["ball.vertex_positions"]
    flat[positions.offset : positions.offset + positions.size] = ADJOINT
    grad = wp.array(flat, device=scene.device)
    pull_derived(scene, ["ball.to_world"], grad)
    pose = scene.parameters["ball.to_world"].offset
    translation = grad.numpy()[pose : pose + 16].reshape(4, 4)[:3, 3].astype(np.float64)
    assert positions.size > 3 * 1000
    np.testing.assert_allclose(translation, positions.size / 3 * float(np.float32(ADJOINT)), rtol=SUMMATION)

"""Shapes that run through each other in media along a curve that moves: a pyramid rises through a floor that shines."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.boundary.measure import slope
from tests.boundary.scenes import T, camera, diffuse, mesh
from tests.media.scenes import cube, medium, whole
from warp_psdr.estimate.boundary import terms

BATCHES, STEP, PEG = 8, 0.01, "peg.vertex_positions"
#: Up, with a little to the side.
RISES = np.array([0.1, 0.05, 1.0])


def scene(**more):
    """The camera sees fog and a wall above the floor, and neither of the two that run through each other."""
    corners = [(-1, -1, -0.3), (1, -1, -0.3), (1, 1, -0.3), (-1, 1, -0.3), (0, 0, 0.15)]
    faces = [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4), (0, 2, 1), (0, 3, 2)]
    light = {"type": "area", "radiance": {"type": "rgb", "value": [5.0, 4.0, 3.0]}}
    wall = T.translate([0, 1.5, 1.3]) @ T.rotate([1, 0, 0], 90) @ T.scale([1.2, 1.0, 1])
    return psdr.load_dict(
        whole(
            sensor=camera((0.0, -4.0, 1.5), (0.0, 0.0, 1.5), fov=20.0),
            fog=cube(medium(0.6, 0.9), scale=1.7, translate=(0, 0, 1.1)),
            floor={"type": "rectangle", "to_world": T.scale([0.9, 0.9, 1]), "bsdf": diffuse(0.0), "emitter": light},
            wall={"type": "rectangle", "to_world": wall, "bsdf": {"type": "twosided", "b": diffuse(0.6)}},
            peg=mesh(corners, faces, diffuse(0.3), face_normals=True),
            **more,
        )
    )


@pytest.mark.slow
@pytest.mark.parametrize("depth", [2, 3])
def test_its_derivative_equals_finite_differences(depth, monkeypatch) -> None:
    """Nearly all of it is that of the curve."""
    found = scene()
    params, integrator = psdr.traverse(found), psdr.PathIntegrator(max_depth=depth)
    base = params[PEG].numpy().astype(np.float64)
    given = {PEG: np.float32(np.broadcast_to(RISES, base.shape))}

    def image(side, seed):
        params[PEG] = np.float32(base + side * STEP * RISES)
        params.update()
        return psdr.render(found, integrator=integrator, spp=1024, seed=seed).numpy().sum(dtype=np.float64)

    differences = np.array([(image(1.0, b) - image(-1.0, b)) / (2.0 * STEP) for b in range(BATCHES)])
    params[PEG] = np.float32(base)
    params.update()
    options = {"integrator": integrator, "spp": 256}
    images = [psdr.render_forward(found, params, given, seed=b, **options).numpy() for b in range(BATCHES)]
    value, error = slope(np.sum(images, axis=(1, 2, 3), dtype=np.float64), differences)
    assert error < 0.02 and abs(value - 1.0) < 3.0 * error + 0.01, f"slope {value:.4f} +- {error:.4f}"
    params.requires_grad_only(PEG)
    params.zero_grad()
    psdr.render_backward(found, params, np.ones_like(images[0]), seed=0, **options)
    reverse = (params[PEG].grad.numpy().astype(np.float64) * RISES).sum()
    np.testing.assert_allclose(reverse, images[0].sum(dtype=np.float64), rtol=1e-3)
    launches = terms.launches
    monkeypatch.setattr(
        terms, "launches", lambda term, r: [] if term.name == "media_intersection_curve" else launches(term, r)
    )
    without = psdr.render_forward(found, params, given, seed=0, **options).numpy().sum()
    assert abs(without) < 0.1 * abs(differences.mean())


def test_beside_glass_it_is_refused() -> None:
    psdr.plan(scene(), names=[PEG])
    glass = {"type": "sphere", "center": [0, 0, 1.5], "radius": 0.2, "bsdf": {"type": "dielectric"}}
    with pytest.raises(ValueError, match="run through each other, along a curve that moves, beside mirrors or glass"):
        psdr.plan(scene(glass=glass), names=[PEG])

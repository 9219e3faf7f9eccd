"""Tubes that the viewer draws: where their triangles are, and gradients by control points on them."""

import numpy as np
import pytest

from warp_psdr.scene.kinds.bsplinecurve import BSplineCurve, coefficients
from warp_psdr.scene.kinds.curve import Curves
from warp_psdr.scene.kinds.linearcurve import LinearCurve
from warp_psdr.view.tubes import RINGS, SIDES, tube_field, tube_mesh

#: Rounding of float64 arithmetic.
ROUNDING = 1e-9


def curves(cubic: bool) -> Curves:
    """Two curves that bend and taper."""
    rng = np.random.default_rng(1)
    parts = [np.cumsum(rng.normal([0.0, 0.0, 0.4], 0.1, (6, 3)), axis=0) for _curve in range(2)]
    parts[1][:, 0] += 2.0
    points = np.column_stack([np.concatenate(parts), rng.uniform(0.05, 0.1, 12)])
    count = 3 if cubic else 5
    firsts = np.concatenate([np.arange(count), 6 + np.arange(count)]).astype(np.int32)
    return (BSplineCurve if cubic else LinearCurve)(points, firsts)


def pose() -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = [[0.0, -2.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    matrix[:3, 3] = [1.0, 2.0, 3.0]
    return matrix


@pytest.mark.parametrize("cubic", [True, False])
def test_vertices_are_on_the_tubes_and_faces_look_outwards(cubic: bool) -> None:
    body = curves(cubic)
    vertices, faces, out = tube_mesh(body, body.points, pose())
    assert len(vertices) == len(body.firsts) * (RINGS[cubic] + 1) * SIDES
    world = np.column_stack([body.points[:, :3] @ pose()[:3, :3].T + pose()[:3, 3], body.points[:, 3]])
    v = np.linspace(0.0, 1.0, RINGS[cubic] + 1)[:, None, None]
    if cubic:
        a = coefficients(world, body.firsts)
        axis = a[0] + v * (a[1] + v * (a[2] + v * a[3]))
    else:
        axis = (1.0 - v) * world[body.firsts] + v * world[body.firsts + 1]
    centers = np.repeat(np.moveaxis(axis, 0, 1).reshape(-1, 4), SIDES, axis=0)
    np.testing.assert_allclose(centers[:, :3] + centers[:, 3:] * out, vertices, atol=ROUNDING)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normals * out[faces].mean(axis=1)).sum(axis=1) > 0.0).all()


@pytest.mark.parametrize("cubic", [True, False])
def test_a_gradient_is_how_a_value_grows_as_the_surface_moves_outwards(cubic: bool) -> None:
    body = curves(cubic)
    gradient = np.zeros_like(body.points)
    gradient[:, 3] = 2.0
    field, vectors, out = tube_field(body, body.points, pose(), gradient)
    np.testing.assert_allclose(field.values, 2.0, atol=ROUNDING)
    assert not vectors.any()
    # A value that is x of the curves' own coordinates is half of y in the world.
    gradient[:] = [1.0, 0.0, 0.0, 0.0]
    field, vectors, out = tube_field(body, body.points, pose(), gradient)
    np.testing.assert_allclose(vectors, np.tile([0.0, 0.5, 0.0], (len(out), 1)), atol=ROUNDING)
    np.testing.assert_allclose(field.values, 0.5 * out[:, 1], atol=ROUNDING)

"""Grids of signed distances: made of meshes, made into meshes, blended, and made distances again."""

import numpy as np
import pytest
import trimesh

import warp_psdr as psdr
from tests.path.test_sdfgrid import nodes, sphere
from tests.rays.test_sdfgrid_cubic import spline
from warp_psdr.scene.kinds.sdfgrid import is_passed

RADIUS = 0.3


def distorted(count: int) -> np.ndarray:
    """A sphere's distances times a factor that varies."""
    x, y, z = nodes(count)
    return (sphere(count, RADIUS)[..., 0] * (1.2 + 0.7 * np.sin(7.0 * x) * np.cos(5.0 * y + z))).astype(np.float32)


@pytest.mark.parametrize("cubic", [False, True])
def test_redistance_keeps_the_surface_and_gives_distances(cubic: bool) -> None:
    values, exact = distorted(25), sphere(25, RADIUS)[..., 0]
    found = psdr.sdf.redistance(values[..., None], cubic=cubic, device="cpu")[..., 0]
    assert found.dtype == np.float32 and ((found < 0.0) == (values < 0.0)).all()
    kept = np.zeros(values.shape, bool)
    for corner in np.argwhere(is_passed(values, cubic)):
        kept[tuple(slice(max(a - cubic, 0), a + 2 + cubic) for a in corner)] = True
    np.testing.assert_array_equal(found[kept], values[kept])
    # The scheme is of first order: less than a voxel.
    assert np.abs(found - exact)[~kept].max() < 1.0 / 24.0 < 0.2 < np.abs(values - exact)[~kept].max()
    slopes = np.stack(np.gradient(found.astype(np.float64), 1.0 / 24.0))
    steep = np.linalg.norm(slopes, axis=0)[1:-1, 1:-1, 1:-1]
    outside = (exact > 0.25)[1:-1, 1:-1, 1:-1]
    assert np.abs(steep[outside] - 1.0).max() < 0.08


def test_redistance_in_boxes_of_other_shapes() -> None:
    """From a plane, whose distances are exact."""
    z, y, x = np.meshgrid(np.linspace(0.0, 1.0, 9), np.linspace(0.0, 2.0, 7), np.linspace(0.0, 3.0, 11), indexing="ij")
    plane = (x - 1.4).astype(np.float32)
    found = psdr.sdf.redistance(np.where(np.abs(plane) < 0.5, plane, 9.0 * plane), (3.0, 2.0, 1.0), device="cpu")
    np.testing.assert_allclose(found, plane, atol=1e-5)
    assert (y + z).shape == plane.shape


def test_meshes_and_back() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.8)
    vertices = np.asarray(ball.vertices) * [1.0, 1.0, 1.5] + [3.0, -2.0, 1.0]
    values, pose = psdr.sdf.from_mesh(vertices, np.asarray(ball.faces), nodes=33, device="cpu")
    assert values.shape == (33, 25, 25, 1)
    spacing = np.diag(pose)[:3] / (np.array(values.shape[2::-1]) - 1)
    np.testing.assert_allclose(spacing, spacing[0])
    at = [np.linspace(0.0, 1.0, n) for n in values.shape[:3]]
    q = np.stack(np.meshgrid(*at, indexing="ij")[::-1], axis=-1) @ pose[:3, :3].T + pose[:3, 3]
    r = (q - [3.0, -2.0, 1.0]) / [1.0, 1.0, 1.5]
    inside = np.linalg.norm(r, axis=-1) < 0.79
    assert (values[..., 0][inside] < 0.0).all() and (values[..., 0][np.linalg.norm(r, axis=-1) > 0.81] > 0.0).all()
    # Along z the distance from the tip.
    assert values.min() == pytest.approx(-0.8, abs=0.05)
    points, faces = psdr.sdf.to_mesh(values, pose, device="cpu")
    back = trimesh.Trimesh(points, faces)
    assert back.is_watertight and back.volume == pytest.approx(4.0 / 3.0 * np.pi * 0.8**3 * 1.5, rel=0.03)
    mirrored, turned = psdr.sdf.to_mesh(values, psdr.Transform.scale([-1.0, 1.0, 1.0]), device="cpu")
    assert trimesh.Trimesh(mirrored, turned).volume > 0.0


def test_coefficients_pass_through_the_values() -> None:
    values = distorted(9)
    c = psdr.sdf.coefficients(values).astype(np.float64)
    x, y, z = nodes(9)
    np.testing.assert_allclose(spline(c, np.stack([x, y, z], axis=-1)), values, atol=1e-6)
    points, _faces = psdr.sdf.to_mesh(psdr.sdf.coefficients(sphere(33, RADIUS)), cubic=True, device="cpu")
    assert np.abs(np.linalg.norm(points - 0.5, axis=1) - RADIUS).max() < 1e-3


def test_smooth_unions() -> None:
    a, b = np.array([0.3, 1.0, 0.1]), np.array([0.3, 0.1, 1.0])
    np.testing.assert_allclose(psdr.sdf.smooth_union(a, b, 0.05), [0.3 - 0.05 * np.log(2.0), 0.1, 0.1], atol=1e-6)
    np.testing.assert_array_equal(psdr.sdf.smooth_union(a, b, 0.0), np.minimum(a, b).astype(np.float32))


def test_what_is_no_grid_or_mesh_is_refused() -> None:
    with pytest.raises(ValueError, match="no two neighbours differ in sign"):
        psdr.sdf.redistance(np.ones((3, 3, 3)))
    with pytest.raises(ValueError, match="three positive lengths"):
        psdr.sdf.redistance(distorted(5), (1.0, 0.0, 1.0))
    with pytest.raises(ValueError, match=r"values of the shape \(3, 3\)"):
        psdr.sdf.to_mesh(np.ones((3, 3)))
    with pytest.raises(ValueError, match="not finite"):
        psdr.sdf.coefficients(np.full((3, 3, 3), np.nan))
    with pytest.raises(ValueError, match=r"3 edges have one face alone: .*close its holes"):
        psdr.sdf.from_mesh(np.eye(3), np.array([[0, 1, 2]]))
    with pytest.raises(ValueError, match="width=-1"):
        psdr.sdf.smooth_union(np.ones(3), np.ones(3), -1.0)
    assert len(psdr.sdf.to_mesh(np.ones((3, 3, 3)))[1]) == 0

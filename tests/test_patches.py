"""Radii of smooth patches against closed forms (``warp_psdr.patches``)."""

import numpy as np
import pytest
import trimesh

import warp_psdr as psdr
from warp_psdr.patches import patch_radii, spreads


def radii(*meshes: trimesh.Trimesh) -> list[np.ndarray]:
    """Return the radii of the triangles of each mesh of a scene."""
    shapes = {
        f"shape{i}": {"type": "mesh", "vertices": np.float32(m.vertices), "faces": np.int32(m.faces)}
        for i, m in enumerate(meshes)
    }
    found = patch_radii(psdr.load_dict({"type": "scene", "sensor": {"type": "perspective"}, **shapes})).numpy()
    return np.split(found, np.cumsum([len(m.faces) for m in meshes])[:-1])


def box(*extents: float) -> trimesh.Trimesh:
    return trimesh.creation.box(extents=extents)


def turned(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A copy in a direction of no axis."""
    copy = mesh.copy()
    copy.apply_transform(trimesh.transformations.rotation_matrix(0.7, [0.3, -0.5, 0.8], [0.1, 0.0, 0.2]))
    return copy


def split(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Every triangle with corners of its own."""
    return trimesh.Trimesh(
        mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(mesh.faces.size).reshape(-1, 3), process=False
    )


@pytest.mark.parametrize("change", [lambda m: m, turned, split], ids=["as it is", "turned", "split"])
def test_closed_forms(change) -> None:
    ball, cube, slab = radii(
        *(change(m) for m in (trimesh.creation.icosphere(subdivisions=3, radius=2.0), box(2, 2, 2), box(2, 2, 0.02)))
    )
    assert ball == pytest.approx(2.0 * np.sqrt(3.0), rel=0.01)
    assert cube == pytest.approx(np.sqrt(3.0), rel=1e-5)
    # The two squares of the slab, and its rim.
    assert sorted(slab) == pytest.approx([0.01 * np.sqrt(3.0)] * 8 + [np.sqrt(3.0)] * 4, rel=1e-4)


def test_what_is_thin_counts_as_thin_with_rounded_edges_too() -> None:
    pill = trimesh.creation.icosphere(subdivisions=4)
    flat, whole = radii(trimesh.Trimesh(pill.vertices * [1.0, 1.0, 0.05], pill.faces), pill)
    assert flat.max() < 0.1 * whole.min()


def test_a_waved_sheet_counts_as_a_sheet() -> None:
    x, y = np.meshgrid(*2 * [np.linspace(-1.0, 1.0, 33)])
    number = np.arange(33 * 33).reshape(33, 33)
    a, b, c, d = (number[i : 32 + i, j : 32 + j].reshape(-1) for i, j in ((0, 0), (0, 1), (1, 1), (1, 0)))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    points = np.stack([x, y, 0.02 * np.sin(6.0 * x) * np.cos(5.0 * y)], axis=2).reshape(-1, 3)
    assert radii(trimesh.Trimesh(points, faces, process=False))[0] == pytest.approx(np.sqrt(3.0), rel=0.02)


def test_two_shapes_in_one_mesh_count_as_two_and_winding_does_not_matter() -> None:
    cube, slab = box(2, 2, 2), box(1, 1, 0.1)
    slab.apply_translation([0.0, 0.0, 1.3])
    one = trimesh.util.concatenate([cube, slab])
    one.faces[::3] = one.faces[::3, ::-1]
    assert np.concatenate(radii(cube, slab)) == pytest.approx(radii(one)[0], rel=1e-5)


def test_moved_vertices_count() -> None:
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    mesh = {"type": "mesh", "vertices": square, "faces": np.int32([[0, 1, 2], [0, 2, 3]])}
    scene = psdr.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "a": mesh})
    assert patch_radii(scene).numpy() == pytest.approx(2 * [np.sqrt(3.0)], rel=1e-5)
    params = psdr.traverse(scene)
    params["a.vertex_positions"] = 0.5 * square
    params.update()
    assert patch_radii(scene).numpy() == pytest.approx(2 * [0.5 * np.sqrt(3.0)], rel=1e-5)


def test_a_patch_without_area_has_no_radius() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], np.float32)
    assert spreads(points, np.array([[0, 1, 2], [1, 1, 1]]), np.array([0, 1])) == pytest.approx([0.0, 0.0])

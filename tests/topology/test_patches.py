"""Radii of smooth patches against closed forms (``warp_psdr.topology.patches``)."""

import numpy as np
import pytest
import trimesh

import warp_psdr as psdr
from warp_psdr.topology.patches import patch_radii

#: There is no light.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")

SIDE = np.sqrt(3.0)  # of a square of side 2


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


def prism(profile, half: float) -> trimesh.Trimesh:
    """A polygon in the plane y = 0, drawn out to y = -half and half, without caps."""
    n = len(profile)
    vertices = [[x, y, z] for x, z in profile for y in (-half, half)]
    faces = [t for k in range(n) for a, b in [(2 * k, 2 * ((k + 1) % n))] for t in ([a, a + 1, b + 1], [a, b + 1, b])]
    return trimesh.Trimesh(vertices, faces, process=False)


def grid(n: int, height=lambda x, y: 0.0 * x) -> trimesh.Trimesh:
    """A height field over a square of side 2."""
    x, y = np.meshgrid(*2 * [np.linspace(-1.0, 1.0, n + 1)])
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = (number[i : n + i, j : n + j].reshape(-1) for i, j in ((0, 0), (0, 1), (1, 1), (1, 0)))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return trimesh.Trimesh(np.stack([x, y, height(x, y)], axis=2).reshape(-1, 3), faces, process=False)


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
def test_flat_faces(change) -> None:
    cube, slab, fine = radii(*(change(m) for m in (box(2, 2, 2), box(2, 2, 0.02), grid(8))))
    assert cube == pytest.approx(SIDE, rel=1e-5)
    assert fine == pytest.approx(SIDE, rel=1e-5)
    # The two squares of the slab, and its rim: 2 * area / circumference.
    assert sorted(slab) == pytest.approx([SIDE * 2 * 2 * 0.02 / 4.04] * 8 + [SIDE] * 4, rel=1e-4)


def test_curvature() -> None:
    ball, fine, tube = radii(
        trimesh.creation.icosphere(subdivisions=2, radius=2.0),
        trimesh.creation.icosphere(subdivisions=4, radius=2.0),
        trimesh.creation.cylinder(radius=0.5, height=20.0, sections=24, cap=False),
    )
    for found in (ball, fine):
        assert 1.3 * 2.0 < found.min() and found.max() < 2.0 * 2.0
    assert 1.3 * 0.5 < tube.min() and tube.max() < 2.2 * 0.5


def test_a_frame_is_as_wide_as_its_bars() -> None:
    corners = [[s * a, t * a, 0] for a in (1.0, 0.98) for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    faces = [t for k in range(4) for t in ([k, (k + 1) % 4, 4 + (k + 1) % 4], [k, 4 + (k + 1) % 4, 4 + k])]
    assert radii(trimesh.Trimesh(corners, faces, process=False))[0] == pytest.approx(0.02 * SIDE, rel=1e-4)


@pytest.mark.parametrize("steps", [1, 4, 32], ids=["bevelled", "rounded", "finely rounded"])
def test_rounded_edges_count_by_their_radius_and_faces_by_their_width(steps) -> None:
    radius = 0.01
    turns = np.linspace(0.0, 0.5 * np.pi, steps + 1)
    centers = ((1, 0.2), (-1, 0.2), (-1, -0.2), (1, -0.2))
    profile = [
        (x + radius * np.cos(k * 0.5 * np.pi + t), z + radius * np.sin(k * 0.5 * np.pi + t))
        for k, (x, z) in enumerate(centers)
        for t in turns
    ]
    (found,) = radii(prism(profile, 4.0))
    edge = found.reshape(4, steps + 1, 2)
    assert edge[:, :steps].max() < 8.0 * radius and edge[:, :steps].min() > radius
    # The faces between them, of widths 0.4 and 2, and 8 long.
    expected = [SIDE * 2 * 8 * w / (16 + 2 * w) for w in (2.0, 0.4)]
    assert edge[:2, steps] == pytest.approx(np.repeat(expected, 2).reshape(2, 2), rel=1e-3)


def test_a_sheet_with_flat_waves_counts_as_wide() -> None:
    (found,) = radii(grid(32, lambda x, y: 0.002 * np.sin(6.0 * x) * np.cos(5.0 * y)))
    assert found.min() > 0.5 * SIDE


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
    assert patch_radii(scene).numpy() == pytest.approx(2 * [SIDE], rel=1e-5)
    params = psdr.traverse(scene)
    params["a.vertex_positions"] = 0.5 * square
    params.update()
    assert patch_radii(scene).numpy() == pytest.approx(2 * [0.5 * SIDE], rel=1e-5)

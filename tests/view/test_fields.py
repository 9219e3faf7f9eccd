"""Fields and arrows as plain arrays."""

import numpy as np
import pytest
import trimesh

from warp_psdr.view.fields import arrows, environment_field, mesh_field, texture_field, vertex_normals

QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
SQUARE_UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
#: How far area-weighted normals of the sphere below stray from the exact ones, as its triangles are not all alike.
TILT = 0.02


def sphere(radius: float = 1.0, subdivisions: int = 3) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions, radius)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)


def test_vertex_normals_of_a_sphere_point_outwards() -> None:
    vertices, faces = sphere(2.0)
    assert np.abs(vertex_normals(vertices, faces) - vertices / 2.0).max() < TILT


@pytest.mark.parametrize("scale", [3.0, -2.0])
def test_vectors_become_their_component_along_the_normal(scale: float) -> None:
    vertices, faces = sphere()
    tangent = np.cross(vertices, [0.3, 0.2, 0.9])
    field = mesh_field(vertices, faces, scale * vertices + tangent, vectors=True)
    assert field.on == "vertex"
    assert np.abs(field.values - scale).max() < TILT * (abs(scale) + 1.0)
    assert np.abs(mesh_field(vertices, faces, tangent, vectors=True, normals=vertices).values).max() < 1e-6


def test_colours_become_one_signed_value() -> None:
    vertices, faces = sphere()
    colors = np.zeros((len(faces), 3))
    colors[:, 1] = -3.0
    field = mesh_field(vertices, faces, colors, on="face")
    assert (field.on, field.quantity) == ("face", "mean of RGB")
    assert np.allclose(field.values, -1.0)
    assert np.allclose(mesh_field(vertices, faces, colors, on="face", reduce="luminance").values, -3.0 * 0.7152)
    assert mesh_field(vertices, faces, colors[:, :1], on="face").quantity == ""


@pytest.mark.parametrize(
    ("values", "options"),
    [((5, 3), {}), ((7, 3), {"on": "vertex"}), ((4, 2), {"vectors": True}), ((4,), {"vectors": True}), ((4, 4), {})],
)
def test_values_that_do_not_fit_the_mesh_are_refused(values: tuple[int, ...], options: dict) -> None:
    with pytest.raises(ValueError, match="expected"):
        mesh_field(np.zeros((4, 3)), QUAD, np.zeros(values), **options)


def test_texture_coordinates_are_transformed() -> None:
    to_uv = np.array([[2.0, 0.0, 0.25], [0.0, -1.0, 1.0], [0.0, 0.0, 1.0]])
    field = texture_field(np.zeros((4, 3)), QUAD, SQUARE_UV, np.ones((2, 2, 3)), to_uv=to_uv)
    assert np.allclose(field.uvs, [[0.25, 1.0], [2.25, 1.0], [2.25, 0.0], [0.25, 0.0]])


def test_barycentrics_stand_in_for_texture_coordinates() -> None:
    vertices = np.arange(12.0).reshape(4, 3)
    field = texture_field(vertices, QUAD, None, np.ones((2, 2)))
    assert np.array_equal(field.vertices[field.faces], vertices[QUAD])
    assert np.array_equal(field.uvs[field.faces], np.broadcast_to([[0, 0], [1, 0], [0, 1]], (2, 3, 2)))


@pytest.mark.parametrize(("uvs", "image"), [((3, 2), (2, 2)), ((4, 3), (2, 2)), ((4, 2), (5,)), ((4, 2), (0, 2, 3))])
def test_textures_that_do_not_fit_are_refused(uvs: tuple[int, ...], image: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="expected"):
        texture_field(np.zeros((4, 3)), QUAD, np.zeros(uvs), np.zeros(image))


def test_environment_directions_meet_their_texels() -> None:
    height, width = 16, 32
    angle = 0.7
    turn = np.eye(4)
    turn[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    center = np.array([1.0, 2.0, 3.0])
    field = environment_field(np.zeros((height, width, 3)), turn, center=center, radius=4.0)
    local = (field.vertices - center) / 4.0 @ turn[:3, :3]
    assert np.allclose(np.linalg.norm(local, axis=1), 1.0)
    # Column i lies at the azimuth 2 pi (i + 1/2) / W from -z towards +x, row j at the angle pi j / (H - 1) from +y.
    column, row = field.uvs[:, 0] * width - 0.5, field.uvs[:, 1] * height - 0.5
    theta = np.pi * row / (height - 1)
    phi = 2.0 * np.pi * (column + 0.5) / width
    assert np.abs(np.cos(theta) - local[:, 1]).max() < 1e-6
    assert np.abs(np.sin(theta) * np.sin(phi) - local[:, 0]).max() < 1e-6
    assert np.abs(-np.sin(theta) * np.cos(phi) - local[:, 2]).max() < 1e-6
    corners = field.vertices[field.faces] - center
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ij,ij->i", normals, corners.mean(axis=1)) < 1e-12).all()  # the front is inside


def test_arrows_are_few_spread_out_and_no_longer_than_asked() -> None:
    vertices, _ = sphere(subdivisions=5)
    vectors = 1e-4 * vertices * (1.0 + vertices[:, :1])
    drawn = arrows(vertices, vectors, count=100, length=0.3)
    assert 50 <= len(drawn.starts) <= 200
    lengths = np.linalg.norm(drawn.vectors, axis=1)
    assert lengths.max() == pytest.approx(0.3, rel=1e-6)
    assert set((drawn.starts > 0).dot([1, 2, 4])) == set(range(8)), "some octant of the sphere has no arrow"
    again = arrows(vertices, vectors, count=100, length=0.3)
    assert np.array_equal(drawn.starts, again.starts)
    # Each is one of the given vectors, in its direction and, below the limit, in proportion to its length.
    picked = [int(np.argmin(np.linalg.norm(vertices - start, axis=1))) for start in drawn.starts]
    cosine = np.einsum("ij,ij->i", drawn.vectors, vectors[picked]) / lengths / np.linalg.norm(vectors[picked], axis=1)
    assert cosine.min() > 1.0 - 1e-6
    free = lengths < 0.299
    ratio = lengths[free] / np.linalg.norm(vectors[picked], axis=1)[free]
    assert ratio.max() / ratio.min() == pytest.approx(1.0, rel=1e-6)


def test_an_arrow_against_its_normal_ends_on_the_surface() -> None:
    vertices, _ = sphere()
    drawn = arrows(vertices, -vertices, normals=vertices, length=0.2)
    assert np.allclose(np.linalg.norm(drawn.starts, axis=1), 1.2, atol=1e-5)
    assert np.allclose(np.linalg.norm(drawn.starts + drawn.vectors, axis=1), 1.0, atol=1e-5)


def test_arrows_leave_out_what_is_zero_or_not_finite() -> None:
    vertices, _ = sphere()
    vectors = np.zeros_like(vertices)
    assert len(arrows(vertices, vectors).starts) == 0
    vectors[:5] = np.nan
    vectors[7] = [0.0, 2.0, 0.0]
    drawn = arrows(vertices, vectors, length=0.5)
    assert np.allclose(drawn.starts, vertices[7:8])
    assert np.allclose(drawn.vectors, [[0.0, 0.5, 0.0]])
    with pytest.raises(ValueError, match="got vertices"):
        arrows(vertices, vectors[:-1])
    with pytest.raises(ValueError, match="count"):
        arrows(vertices, vectors, count=0)

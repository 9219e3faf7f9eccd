"""What kernels measure on the host, against the same arithmetic in NumPy; and what is kept while vertices move."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.scene.shapes.shading import normals_at_corners, normals_at_vertices
from warp_psdr.topology import contacts, film_edges, patches
from warp_psdr.topology.camera_view import CameraView
from warp_psdr.topology.edges import COPLANAR, NEEDLE, TILT, moving_edges, normal_columns, scene_adjacency, upload
from warp_psdr.topology.interpolated_normals import TERMINATOR_FLOOR, bend, terminator_faces

from .test_edges import cube, mesh, scene_with
from .test_lists import bumpy


def balls():
    """A smooth bumpy ball with a hole, and a flat box beside it."""
    vertices, faces = bumpy()
    return scene_with(ball=mesh(vertices, faces), box=mesh(cube()[0] + [3.0, 0.0, 0.0], cube()[1], face_normals=True))


def view_of(parallel: bool, radius: float) -> CameraView:
    pose = psdr.Transform.look_at([0.3, -0.5, -4.0], [0.0, 0.1, 0.0], [0.0, 1.0, 0.0]).matrix.astype(np.float64)
    eye = -pose[:3, 2] if parallel else pose[:3, 3]
    return CameraView(None, pose, eye, 0.0 if parallel else 1.0, radius, 1.0, np.ones(2), np.zeros(2))


def test_edges_have_the_wedges_of_their_triangles() -> None:
    scene = balls()
    edges, points, triangles = scene_adjacency(scene), scene.points.astype(np.float64), scene.builder.indices
    normals = normal_columns(points, triangles).T
    a, b, c = (points[triangles[:, k]] for k in range(3))
    np.testing.assert_array_equal(normals, np.cross(b - a, c - a))
    two = edges.count == 2
    faces = edges.faces[edges.first[:-1]], edges.faces[edges.first[:-1] + two]
    begin, along = edges.points[:, 0], edges.points[:, 1] - edges.points[:, 0]
    along = along / edges.length[:, None]
    into = [points[triangles[f]].sum(axis=1) / 3.0 - begin for f in faces]
    x, y = (v - (v * along).sum(axis=1)[:, None] * along for v in into)
    angle = np.arctan2(np.linalg.norm(np.cross(x, y), axis=1), (x * y).sum(axis=1))
    wedge = np.where(two, np.pi - angle, np.pi)
    tall = np.minimum(*(np.linalg.norm(normals[f], axis=1) for f in faces)) / edges.length
    tilt = np.where(tall < NEEDLE * edges.length, TILT * scene.steps.far[0] / tall, 0.0)
    wedge[wedge < np.maximum(COPLANAR, tilt)] = 0.0
    # Absorbs roundings of the sums.
    np.testing.assert_allclose(edges.wedge, wedge, atol=1e-12)


@pytest.mark.parametrize("radius", [0.0, 0.4])
@pytest.mark.parametrize("parallel", [False, True])
def test_faces_on_either_side_of_an_edge(parallel: bool, radius: float) -> None:
    scene, view = balls(), view_of(parallel, radius)
    edges, points = scene_adjacency(scene), scene.points.astype(np.float64)
    some = np.random.default_rng(5).permutation(np.flatnonzero(edges.count == 2))[:500]
    width = np.random.default_rng(6).uniform(0.0, 0.01, len(some))
    begin = edges.points[some, 0]
    along = edges.points[some, 1] - begin
    plane = np.cross(along, -view.towards(begin))
    scale = np.linalg.norm(plane, axis=1) * (edges.length[some] * COPLANAR + width)
    sides = []
    for k in range(2):
        into = (points[scene.builder.indices[edges.faces[edges.first[some] + k]]] - begin[:, None]).sum(axis=1)
        side = (into * plane).sum(axis=1)
        sides.append(np.where(np.abs(side) > scale + view.spread(np.cross(into, along)), side, 0.0))
    expected = sides[0] * sides[1] < 0.0
    assert 0.2 < expected.mean() < 0.98
    np.testing.assert_array_equal(film_edges._apart(scene, view, edges, some, width), expected)


def test_bent_triangles_and_their_terminators() -> None:
    scene = balls()
    expected = np.zeros(scene.face_count)
    for rows, normal, at in normals_at_corners(scene):
        expected[rows] = np.max([np.linalg.norm(np.cross(corner.T, normal.T), axis=1) for corner in at], axis=0)
    np.testing.assert_allclose(bend(scene), expected, atol=1e-15)
    cdf, faces = (a.numpy() for a in terminator_faces(scene, 0, {0, 1}, camera_moves=False))
    np.testing.assert_array_equal(faces, np.flatnonzero(expected > COPLANAR))
    corners = scene.points.astype(np.float64)[scene.builder.indices[faces]]
    eye = np.array([0.0, 0.0, 6.0])
    facing = (normals_at_vertices(scene).astype(np.float64)[scene.builder.indices[faces]] * (eye - corners)).sum(axis=2)
    size = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    size /= np.linalg.norm(eye - corners.mean(axis=1), axis=1)
    weight = np.where((facing.min(axis=1) <= 0.0) & (facing.max(axis=1) >= 0.0), size, TERMINATOR_FLOOR * size)
    assert 0 < (weight == size).sum() < len(faces)
    # Absorbs that cumulative values are multiples of 2^-24.
    np.testing.assert_allclose(np.diff(cdf), weight / weight.sum(), atol=2.0**-23)


def test_edges_are_taken_out_of_the_list() -> None:
    scene = balls()
    edges = scene_adjacency(scene)
    keep = np.random.default_rng(7).permutation(len(edges.length))[:200]
    found = upload(scene, edges, keep, np.ones(200), np.zeros(200), np.ones(200))
    for name in ("points", "ends", "twins"):
        values = getattr(edges, name)[keep]
        np.testing.assert_array_equal(getattr(found, name).numpy(), values.astype(values.dtype.kind + "4"))
    faces = [edges.faces[edges.first[k] : edges.first[k + 1]] for k in keep]
    np.testing.assert_array_equal(found.faces.numpy(), np.concatenate(faces))
    np.testing.assert_array_equal(np.diff(found.first.numpy()), [len(f) for f in faces])


def test_what_is_kept_follows_the_vertices() -> None:
    vertices, faces = cube(split=True)
    scene = scene_with(a=mesh(vertices, faces), b=mesh(vertices + np.array([5.0, 0.0, 0.0]), faces))
    params = psdr.traverse(scene)

    def check(move) -> None:
        x = move(vertices).astype(np.float32)
        params["a.vertex_positions"] = x
        params.update()
        fresh = scene_with(a=mesh(x, faces), b=mesh(vertices + np.array([5.0, 0.0, 0.0]), faces))
        edges, other = scene_adjacency(scene), scene_adjacency(fresh)
        # Edges come in the order of the scene that was loaded, so both are compared by their middles.
        orders = [np.lexsort(np.round(e.points.mean(axis=1), 4).T) for e in (edges, other)]
        for find in (
            lambda s, e: moving_edges(s, e, {0}),
            film_edges._inner,
            film_edges._shape,
            lambda _s, e: e.wedge,
        ):
            a, b = (find(s, e)[order] for s, e, order in zip((scene, fresh), (edges, other), orders, strict=True))
            np.testing.assert_allclose(a, b, atol=1e-6)
        radii = [patches.patch_radii(s).numpy() for s in (scene, fresh)]
        np.testing.assert_allclose(*radii, rtol=1e-5)

    check(lambda x: 1.2 * x)
    check(lambda x: x + 0.2 * x[:, ::-1] * x[:, 1:2])  # faces bend: patches and flat polygons are others
    check(lambda x: x + np.array([3.0, 0.0, 0.0]))  # the cubes are welded
    check(lambda x: x * np.where(np.arange(len(x)) < 3, 1.1, 1.0)[:, None])  # a corner is torn off
    check(lambda x: x)


def test_triangles_near_other_shapes() -> None:
    rng = np.random.default_rng(8)
    vertices, faces = bumpy(2)
    shapes = {f"ball{i}": mesh(0.4 * vertices + rng.uniform(-1.0, 1.0, 3), faces) for i in range(6)}
    scene = scene_with(**shapes, box=mesh(3.0 * cube()[0], cube()[1]))
    tolerance, shape = 0.01, scene.builder.face_shape
    corners = scene.points[scene.builder.indices].astype(np.float64)
    low, high = corners.min(axis=1) - tolerance, corners.max(axis=1) + tolerance
    expected = np.zeros(len(shape), bool)
    for other in range(7):
        own = shape == other
        meets = ((low <= high[own].max(axis=0)) & (high >= low[own].min(axis=0))).all(axis=1)
        expected |= meets & ~own
    # The balls lie in the box, which meets none of them: its triangles do.
    assert 10 < expected.sum() < len(shape)
    np.testing.assert_array_equal(contacts._near_others(scene, tolerance), np.flatnonzero(expected))

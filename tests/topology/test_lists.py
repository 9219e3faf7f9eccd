"""Lists of edges: those of a straightforward search, in stretches of any length; and the line about them."""

from collections import defaultdict

import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial import cKDTree

from warp_psdr import columns
from warp_psdr.topology import edges as of_edges
from warp_psdr.topology.edges import adjacency, scene_adjacency, sides_of
from warp_psdr.topology.film_edges import crease_edges, film_edges, flat_crease_edges, primary_edges
from warp_psdr.topology.interpolated_normals import bend, terminator_faces
from warp_psdr.topology.intersection_curves import scene_curves
from warp_psdr.topology.welding import components, stable_order, weld

from .test_edges import cube, mesh, scene_with

TOLERANCE = 1e-3


def bumpy(subdivisions: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """A bumpy sphere with a hole, its triangles shuffled."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = np.asarray(ball.vertices)
    vertices = vertices * (1.0 + 0.1 * np.sin(7.0 * vertices[:, :1]) * np.cos(5.0 * vertices[:, 1:2]))
    faces = np.asarray(ball.faces)[np.random.default_rng(0).permutation(len(ball.faces))]
    return vertices, faces[20:]


def split(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give every triangle corners of its own."""
    return vertices[faces.reshape(-1)], np.arange(faces.size).reshape(-1, 3)


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_keys_are_counted_into_a_stable_order(count: int) -> None:
    keys = np.random.default_rng(count).integers(0, 37, count)
    np.testing.assert_array_equal(stable_order(keys, 37), np.argsort(keys, kind="stable"))


def welded(points: np.ndarray) -> np.ndarray:
    """Weld by ``numpy.unique`` and a tree."""
    unique, group = np.unique(points, axis=0, return_inverse=True)
    pairs = cKDTree(unique).query_pairs(TOLERANCE, output_type="ndarray")
    return components(len(unique), *pairs.T)[group.reshape(-1)]


@pytest.mark.parametrize("scale", [1.0, 0.02], ids=["apart", "crowded"])
def test_welding_is_that_of_a_tree(scale: float) -> None:
    rng = np.random.default_rng(1)
    points = scale * np.repeat(rng.uniform(-1.0, 1.0, (2000, 3)), 2, axis=0)
    points[::3] += rng.uniform(-TOLERANCE, TOLERANCE, points[::3].shape)
    expected = welded(points)
    assert expected.max() < 4000 - 500
    for order in (None, np.lexsort(points.T[::-1]), np.arange(len(points))):
        np.testing.assert_array_equal(weld(points, TOLERANCE, order), expected)


@pytest.mark.parametrize("change", [lambda *m: m, split], ids=["shared", "split"])
def test_edges_are_those_of_a_dictionary(change) -> None:
    vertices, faces = change(*bumpy())
    found = adjacency(vertices, faces)
    # Positions in the order of their coordinates.
    _points, group = np.unique(vertices, axis=0, return_inverse=True)
    np.testing.assert_array_equal(found.group, group.reshape(-1))
    sides = defaultdict(list)
    for number, face in enumerate(faces.tolist()):
        for a, b in zip(face, face[1:] + face[:1], strict=True):
            ends = sorted((a, b), key=lambda v: found.group[v])
            sides[tuple(found.group[ends].tolist())].append((number, ends))
    rows = [sides[key] for key in sorted(sides)]
    assert {len(row) for row in rows} == {1, 2}
    np.testing.assert_array_equal(found.faces, [number for row in rows for number, _ends in row])
    np.testing.assert_array_equal(found.count, [len(row) for row in rows])
    np.testing.assert_array_equal(found.ends, [row[0][1] for row in rows])
    np.testing.assert_array_equal(found.twins, [row[-1][1] for row in rows])
    points = vertices[found.ends]
    np.testing.assert_array_equal(found.length, np.linalg.norm(points[:, 1] - points[:, 0], axis=1))


def test_arithmetic_by_component_has_the_bits_of_that_on_rows() -> None:
    a, b = np.random.default_rng(2).standard_normal((2, 999, 3))
    x, y = columns.of(a), columns.of(b)
    np.testing.assert_array_equal(columns.dot(x, y), (a * b).sum(axis=1))
    np.testing.assert_array_equal(columns.cross(x, y).T, np.cross(a, b))
    np.testing.assert_array_equal(columns.length(x), np.linalg.norm(a, axis=1))


def lists(faces: np.ndarray, vertices: np.ndarray, **more) -> list[np.ndarray]:
    """Return lists of a scene in which a shape is sunk into a box."""
    scene = scene_with(ball=mesh(vertices, faces, **more), box=mesh(*cube(), face_normals=True))
    found = scene_adjacency(scene)
    film = film_edges(scene, 0, {0, 1}, camera_moves=True)
    creases = crease_edges(scene, film)
    uploaded = [primary_edges(scene, film), flat_crease_edges(scene, film), creases and creases[0]]
    arrays = [e.cdf for e in uploaded if e is not None]
    arrays += terminator_faces(scene, 0, {0}, camera_moves=True) or ()
    curves = scene_curves(scene)
    assert len(curves.length)
    hosted = [found.wedge, found.length, sides_of(scene, found), bend(scene), curves.faces, curves.points]
    return [a.numpy() for a in arrays] + hosted


@pytest.mark.parametrize("more", [{}, {"face_normals": True}], ids=["smooth", "flat"])
def test_lists_do_not_depend_on_the_length_of_stretches(monkeypatch, more) -> None:
    vertices, faces = bumpy()
    whole = lists(faces, 1.5 * vertices, **more)
    monkeypatch.setattr(columns, "CHUNK", 37)
    for a, b in zip(whole, lists(faces, 1.5 * vertices, **more), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_line_says_that_large_meshes_are_looked_through(monkeypatch, capsys) -> None:
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_INFO)
    scene_adjacency(scene_with(box=mesh(*cube())))
    assert capsys.readouterr().err == ""  # small
    monkeypatch.setattr(of_edges, "SECONDS_A_TRIANGLE", 0.25)
    scene = scene_with(box=mesh(*cube()))
    for _ in range(2):
        scene_adjacency(scene)
    line = "warp_psdr: listing the edges of 12 triangles (first use; kept until they move), about 3 s\n"
    assert capsys.readouterr() == ("", line)
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_WARNING)
    scene_adjacency(scene_with(box=mesh(*cube())))
    assert capsys.readouterr() == ("", "")

"""Edges: adjacency on welded vertices, the angle in which an edge is a silhouette, and the candidate sets."""

import numpy as np
import pytest
import trimesh

import warp_psdr as psdr
from warp_psdr.topology.edges import COPLANAR, adjacency, scene_adjacency, weld
from warp_psdr.topology.film_edges import film_edges, flat_crease_edges, primary_edges
from warp_psdr.topology.interpolated_normals import interpolated_faces
from warp_psdr.topology.secondary_edges import secondary_edges


def cube(split: bool = False):
    m = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
    vertices, faces = np.asarray(m.vertices), np.asarray(m.faces)
    if split:
        vertices, faces = vertices[faces.reshape(-1)], np.arange(faces.size).reshape(-1, 3)
    return vertices, faces


def scene_with(**shapes):
    camera = {
        "type": "perspective",
        "fov": 45.0,
        "to_world": psdr.Transform.look_at([0, 0, 6], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
    }
    return psdr.load_dict({"type": "scene", "sensor": camera, "sky": {"type": "constant"}, **shapes})


def mesh(vertices, faces, **more):
    return {
        "type": "mesh",
        "vertices": np.asarray(vertices, np.float32),
        "faces": np.asarray(faces, np.int32),
        "bsdf": {"type": "diffuse"},
        **more,
    }


@pytest.mark.parametrize("split", [False, True])
def test_a_cube_has_twelve_right_edges_and_six_flat_ones(split: bool) -> None:
    edges = adjacency(*cube(split))
    assert len(edges.length) == 18 and (edges.count == 2).all()
    sharp = edges.wedge > 0.0
    assert sharp.sum() == 12
    # Absorbs float64 rounding of an arc tangent.
    np.testing.assert_allclose(edges.wedge[sharp], np.pi / 2, atol=1e-12)
    np.testing.assert_allclose(edges.length[sharp], 2.0)
    np.testing.assert_allclose(edges.length[~sharp], np.sqrt(8.0))
    shared = (edges.ends == edges.twins).all(axis=1)
    assert shared.all() if not split else not shared.any()


@pytest.mark.parametrize("split", [False, True])
def test_both_sides_of_an_edge_are_at_one_place(split: bool) -> None:
    vertices, faces = cube(split)
    edges = adjacency(vertices, faces)
    np.testing.assert_array_equal(vertices[edges.ends], vertices[edges.twins])
    for e in range(len(edges.length)):
        a, b = edges.faces[edges.first[e] : edges.first[e + 1]]
        assert set(edges.ends[e]) <= set(faces[a]) and set(edges.twins[e]) <= set(faces[b])


def test_open_and_fanned_edges_are_silhouettes_from_everywhere() -> None:
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0.5], [0, 0, 1]]
    edges = adjacency(np.array(vertices), np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]]))
    assert sorted(edges.count) == [1] * 6 + [3]
    np.testing.assert_allclose(edges.wedge, np.pi)


def test_degenerate_triangles_are_left_out() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [0, 0, 0]], float)
    edges = adjacency(vertices, np.array([[0, 1, 2], [0, 1, 3], [0, 4, 1]]))
    assert len(edges.length) == 3 and (edges.count == 1).all() and (edges.faces == 0).all()


@pytest.mark.parametrize(("angle", "flat"), [(0.5 * COPLANAR, True), (2.0 * COPLANAR, False)])
def test_the_tolerance_of_flat_edges(angle: float, flat: bool) -> None:
    vertices = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [-np.cos(angle), 0, np.sin(angle)]])
    edges = adjacency(vertices, np.array([[0, 2, 1], [0, 1, 3]]))
    wedge = edges.wedge[edges.count == 2][0]
    assert wedge == 0.0 if flat else wedge == pytest.approx(angle, rel=1e-6)


def test_welding_takes_rounding_and_nothing_else() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [1 + 1e-7, 0, 0], [1, 1e-3, 0], [0, 0, 0]])
    group = weld(points, 1e-6)
    assert group[0] == group[4] and group[1] == group[2]
    assert len({*group}) == 3


def test_the_sampling_covers_all_edges_by_length_and_wedge() -> None:
    scene = scene_with(box=mesh(*cube(), face_normals=True), other=mesh(np.array(cube()[0]) + 5.0, cube()[1]))
    for moving, share in ((set(), 0.5), ({0}, 0.75)):
        edges = secondary_edges(scene, moving)
        p = np.diff(edges.cdf.numpy())
        assert len(p) == 24 and (p > 0.0).all()
        first = edges.ends.numpy().max(axis=1) < 8
        # Absorbs the rounding of probabilities to multiples of 2^-24.
        assert p[first].sum() == pytest.approx(share, abs=1e-5)
        np.testing.assert_allclose(p[first], share / 12, atol=1e-6)


def test_edges_that_cannot_jump_or_move_are_not_sampled_on_the_film() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    scene = scene_with(box=mesh(*cube(), face_normals=True), ball=mesh(0.5 * ball.vertices + [1.5, 0, 2], ball.faces))

    def seen(shapes: set[int], *, camera_moves: bool = False) -> tuple[int, int]:
        found = film_edges(scene, 0, shapes, camera_moves=camera_moves)
        edges = primary_edges(scene, found), flat_crease_edges(scene, found)
        assert (found.share > 0.0) == (edges[1] is not None)
        return tuple(0 if e is None else len(e.cdf) - 1 for e in edges)

    assert seen(set()) == (0, 0)
    assert seen({0}) == (12, 0)
    others, facets = seen({1})
    # Smooth: silhouettes only, the outline of a ball.
    assert 10 < others < len(ball.edges_unique) // 4 and facets == 0
    assert seen(set(), camera_moves=True) == (12 + others, 0)
    assert interpolated_faces(scene)[:12].sum() == 0 and interpolated_faces(scene)[12:].all()


def on_film(scene):
    return primary_edges(scene, film_edges(scene, 0, {0}, camera_moves=False))


def test_edges_are_clipped_to_the_film_and_the_near_plane() -> None:
    half = 6.0 * np.tan(np.radians(22.5))  # of the view at z = 0: no samples are drawn beyond the film
    triangle = np.array([[-100, 0, 0], [100, 0, 0], [0, 50, 0]])
    edges = on_film(scene_with(a=mesh(triangle, [[0, 1, 2]])))
    low, high = edges.low.numpy(), edges.high.numpy()
    assert len(low) == 1
    np.testing.assert_allclose(200.0 * np.array([low[0], high[0]]) - 100.0, [-half, half], rtol=1e-4)
    through = np.array([[0, 0, -2], [0, 0.5, 10], [50, 50, -2]])
    edges = on_film(scene_with(a=mesh(through, [[0, 1, 2]])))
    row = np.flatnonzero((edges.ends.numpy() <= 1).all(axis=1))[0]
    z = -2.0 + 12.0 * np.array([edges.low.numpy()[row], edges.high.numpy()[row]])
    assert z.min() >= -2.0 and z.max() < 6.0


def test_edges_follow_the_vertices() -> None:
    scene = scene_with(box=mesh(*cube(), face_normals=True))
    before = scene_adjacency(scene)
    assert scene_adjacency(scene) is before
    params = psdr.traverse(scene)
    params["box.vertex_positions"] = 2.0 * params["box.vertex_positions"].numpy()
    params.update()
    np.testing.assert_allclose(scene_adjacency(scene).length, 2.0 * before.length)
